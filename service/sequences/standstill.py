"""A ball-bar reading at standstill: the mean of a few samples that the box began after the axes had settled."""

from __future__ import annotations

from typing import Any

from abbe.drivers.api import BallBar, BarSample, ControllerStatus, Point
from abbe.service.errors import MeasurementFault
from abbe.service.sequences.paths import BAD_BITS, OUT_BITS, bar_trouble
from abbe.service.sequences.steps import ReadBar


async def read_bar(ballbar: BallBar, step: ReadBar, status: ControllerStatus, here: Point | None) -> dict[str, Any]:
    """One record of a point-by-point test, with every sample that it is the mean of.

    The stream is started after ``status`` said that the axes have settled, so no sample can be older than that: arrival times play no part.

    Raises
    ------
    BarOutOfRange, MeasurementFault
        The box itself says that a sample is none: out of range or no bar; samples lost.
    """
    samples: list[BarSample] = []
    host_s = status.host_s
    async with ballbar.stream(step.rate_hz) as batches:
        async for batch in batches:
            host_s = batch.host_s
            samples += batch.samples
            if len(samples) >= step.samples:
                break
    taken = samples[: step.samples]
    bad = [s for s in taken if s.status & BAD_BITS]
    if bad or len(taken) < step.samples:
        if bad and bad[0].status & OUT_BITS:
            raise bar_trouble(bad[0].status)
        what = f"status {bad[0].status:#06x}" if bad else f"{len(taken)} of {step.samples} samples came"
        raise MeasurementFault(f"the ball-bar's box loses samples ({what})", "look at its cable, then start the test again")
    return {
        "host_s": host_s,
        "ctrl_us": status.ctrl_us,
        "target_mm": list(here if here is not None else status.position_mm),
        "direction": step.direction,
        "feed_mm_min": 0.0,
        "device_us": [s.device_us for s in taken],
        "reading_nm": [s.reading_nm for s in taken],
        "status": [s.status for s in taken],
    }
