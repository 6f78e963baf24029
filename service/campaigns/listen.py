"""Listens while the operator runs a program: reads the laser continuously and turns each standstill into a reading of the recipe.

This is for controllers that Abbe does not move. Abbe writes nothing to the controller and uses only its clock, its position and the status
"NC program running"; it also works without a connected controller. Sample times come from the laser's own clock, converted to the
controller's.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from abbe.drivers.api import ControllerStatus, LaserReading, Point, air_doc, air_is_compensated, resolution_mm
from abbe.drivers.errors import DriverError, run_to_end
from abbe.models.alignment.clock import ClockFit, fit_clock
from abbe.models.alignment.dwell import DwellReading, Dwells, PlannedDwell, detect, merged, named
from abbe.models.alignment.lag import Lag, fit_lag
from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.service.campaigns.device_checks import check_devices
from abbe.service.campaigns.measure import OpenCampaign, start_campaign, start_document
from abbe.service.capture.recorder import CaptureRecorder, close_run, recording
from abbe.service.clock import Clock, SystemClock
from abbe.service.devices.session import Session
from abbe.service.domain.run import LaserSetup
from abbe.service.errors import AbbeError, MeasurementFault
from abbe.service.runs.sample_columns import MM_PER_COUNT
from abbe.service.sequences.check import dry_run_campaign
from abbe.service.sequences.nc.blocks import LASER_DWELL_S
from abbe.service.sequences.paths import Recorder
from abbe.service.sequences.steps import CampaignPlan, MountLaser, MoveTo, ReadLaser, TestPlan, Unmount
from abbe.service.site import Site
from abbe.service.storage.store import Store

Report = Callable[[str], None]
STATUS_EVERY = 3
"""Number of laser readings between two controller statuses."""
QUIET = 4.0
"""Without a "program running" status, a test has ended when the axes have rested for this multiple of its longest dwell."""
MOVED_MM = 0.05
START_MM = 0.05
POLL_S = 0.05
U_DELAY_S = 2e-3


@dataclass(frozen=True, slots=True)
class ListenRequest:
    """One reading of the recipe: position, direction, distance along the beam from the first reading, and settling time."""

    target_mm: Point
    direction: int
    along_mm: float
    settle_s: float


@dataclass
class Heard:
    """Laser readings and controller statuses of one test."""

    readings: list[LaserReading] = field(default_factory=list)
    statuses: list[ControllerStatus] = field(default_factory=list)


def planned_readings(test: TestPlan) -> list[ListenRequest]:
    """Return the readings of a laser test in order. Raises MeasurementFault for a test without laser readings at standstills."""
    here, out = None, list[ListenRequest]()
    stated = test.setup.nominal_beam if isinstance(test.setup, LaserSetup) else None
    beam = np.array(next((s.beam for s in test.steps if isinstance(s, MountLaser)), np.zeros(3) if stated is None else stated))
    for step in test.steps:
        if isinstance(step, MoveTo):
            here = step.target_mm
        elif isinstance(step, ReadLaser) and here is not None:
            first = out[0].target_mm if out else here
            out.append(ListenRequest(here, step.direction, float(beam @ np.subtract(here, first)), step.settle_s))
    if len(out) < 2:
        raise MeasurementFault(
            f"test {test.label} has no laser readings at standstills", "listen to laser tests only; measure the others separately"
        )
    return out


async def listen_to(session: Session, recorder: Recorder, test: TestPlan, report: Report) -> dict[str, Any]:
    """Mount, zero, listen until the program has ended, and store a reading for each standstill; return the end document.

    Raises
    ------
    MeasurementFault
        The record does not match this test, or the beam was lost.
    """
    plan = planned_readings(test)
    await _at_start(session, test, plan[0].target_mm, report)
    for step in test.steps:
        if isinstance(step, MountLaser):
            await session.need_fixture().mount_laser(step.beam)
    mounted_us = (await session.controller.status()).ctrl_us
    laser = session.need_laser()
    await laser.clear_beam()
    await laser.set_environment_compensation(True)
    await laser.zero()
    report(f"{test.label}: listening, start the program")
    heard = await _hear(session, (QUIET * (LASER_DWELL_S + plan[0].settle_s)))
    if not all(air_is_compensated(r.status) for r in heard.readings):
        raise MeasurementFault(
            f"test {test.label}: the laser's environmental compensation was switched off",
            "switch the compensation on, then start the program again",
        )
    found, planned = _detected(test, heard, plan, resolution_mm(laser))
    lines = named(found, planned)
    times, lag = _controller_times(heard)
    middles = row_times(found.readings, heard.readings[0].device_us * 1e-6, plan[0].settle_s + LASER_DWELL_S)
    for one, reading, middle_s in zip(plan, found.readings, middles, strict=True):
        await recorder.add_record(_record(one, reading, middle_s, heard, times))
    for line in lines:
        report(f"{test.label}: {line}")
    doc = {"standstills": {"trouble": list(lines), "missing": list(found.missing), "noise_mm": found.noise}, "mounted_us": mounted_us}
    if lag is not None and lag.determined:
        doc["lag"] = {"laser_behind_position_ms": lag.lag_s * 1e3, "u_ms": lag.u_s * 1e3}
    return doc | {"heard": [[r.device_us, r.displacement_tenth_nm] for r in heard.readings]}


async def _at_start(session: Session, test: TestPlan, start_mm: Point, report: Report) -> None:
    """Wait until the machine stands at the start of the test; if its position is unknown, the person who mounts the mirror vouches for
    it."""
    before, reported = None, False
    if not math.isfinite(sum((await session.controller.status()).position_mm)):
        return
    while True:
        status = await session.controller.status()
        if math.dist(status.position_mm, start_mm) < START_MM and status.position_mm == before:
            return
        if not reported:
            reported = True
            at = " ".join(f"{a}{v:.3f}" for a, v in zip(AXES, start_mm, strict=True))
            report(f"{test.label}: waiting until the program has moved the machine to {at}")
        before = status.position_mm
        await asyncio.sleep(POLL_S)


async def _hear(session: Session, quiet_s: float) -> Heard:
    """Read the laser from before the program moves the machine until the program has ended.

    Without a "program running" status, the program has ended after ``quiet_s`` seconds without motion.
    """
    heard, laser = Heard(), session.need_laser()
    last, ran, moved_us, level = None, False, 0, None
    while True:
        reading = await laser.read(after_count=last)
        last = reading.sample_count
        heard.readings.append(reading)
        if len(heard.readings) % STATUS_EVERY == 0:
            status = await session.controller.status()
            heard.statuses.append(status)
            running = status.program_runs
            if ran and not running and moved_us:  # without motion, the operator only resumed from one halt to the next
                return heard
            ran = running or (ran and bool(moved_us))
        level = reading.displacement_tenth_nm if level is None else level
        if abs(reading.displacement_tenth_nm - level) * MM_PER_COUNT > MOVED_MM:
            moved_us, level = reading.device_us, reading.displacement_tenth_nm
        if not ran and moved_us and (reading.device_us - moved_us) * 1e-6 > quiet_s:
            return heard


def _detected(test: TestPlan, heard: Heard, plan: list[ListenRequest], step_mm: float) -> tuple[Dwells, tuple[PlannedDwell, ...]]:
    t, y = _stream(heard)
    planned = merged([PlannedDwell(one.along_mm, one.settle_s + LASER_DWELL_S) for one in plan])
    try:
        return detect(t, y, planned, settle_s=plan[0].settle_s, zero=0.0, step=step_mm), planned
    except ValueError as error:
        raise MeasurementFault(f"test {test.label}: {error}", "start the program of this recipe, then listen again") from None


def _stream(heard: Heard) -> tuple[F1, F1]:
    t = np.array([r.device_us for r in heard.readings]) * 1e-6
    return t, np.array([r.displacement_tenth_nm for r in heard.readings]) * MM_PER_COUNT


def _controller_times(heard: Heard) -> tuple[Callable[[F1], F1], Lag | None]:
    """Return the function that converts laser time to controller time, s, and the laser's lag; None if the positions do not show the lag.

    Both clocks are fitted to the host clock.
    """
    laser = _fit([(r.device_us, r.host_s) for r in heard.readings])
    cnc = _fit([(s.ctrl_us, s.host_s) for s in heard.statuses])

    def to_controller(laser_s: F1) -> F1:
        return cnc.device_s(laser.host_s(laser_s))

    t, y = _stream(heard)
    at = np.array([s.ctrl_us for s in heard.statuses]) * 1e-6
    keep = np.concatenate([[True], np.diff(at) > 0.0])
    places: F2 = np.array([s.position_mm for s in heard.statuses])[keep]
    line = places[int(np.argmax(np.linalg.norm(places - places[0], axis=1)))] - places[0]
    if at[keep].size < 20 or not line.any() or not np.isfinite(places).all():
        return to_controller, None
    along = (places - places[0]) @ (line / np.linalg.norm(line))
    inside = (to_controller(t) > at[0]) & (to_controller(t) < at[-1])
    return to_controller, fit_lag(to_controller(t)[inside], y[inside], at[keep], along)


def _fit(pairs: list[tuple[int, float]]) -> ClockFit:
    stamps, arrived = np.array(pairs, dtype=np.float64).T
    keep = np.concatenate([[True], np.diff(stamps) > 0.0])
    try:
        return fit_clock(stamps[keep] * 1e-6, arrived[keep], u_delay_s=U_DELAY_S)
    except ValueError as error:
        raise MeasurementFault(f"too few readings to compare the clocks ({error})", "start listening before the program") from None


def row_times(readings: Sequence[DwellReading | None], start_s: float, apart_s: float) -> list[float]:
    """Return the laser time of every planned reading, s, in rising order: the middle of its window.

    Missing readings get interpolated times: from ``start_s`` on before the first found reading, and every ``apart_s`` after the last one.
    """
    found = [(k, 0.5 * (one.start_s + one.end_s)) for k, one in enumerate(readings) if one is not None]
    at, times = [float(k) for k, _ in found], [t for _, t in found]
    last = len(readings) - 1
    if found[0][0] > 0:
        at, times = [-1.0, *at], [min(start_s, times[0] - 1e-3), *times]
    if found[-1][0] < last:
        at, times = [*at, float(last)], [*times, times[-1] + apart_s * (last - found[-1][0])]
    return [float(t) for t in np.interp(np.arange(last + 1.0), at, times)]


def _record(one: ListenRequest, reading: DwellReading | None, middle_s: float, heard: Heard, times: Callable[[F1], F1]) -> dict[str, Any]:
    """Return the record of one standstill in the sequencer's form; a missing reading gets the nominal position and is marked as missing."""
    near = min(heard.readings, key=lambda r: abs(r.device_us * 1e-6 - middle_s))
    value: dict[str, Any] = {"displacement_tenth_nm": round(one.along_mm / MM_PER_COUNT), "missing": True}
    if reading is not None:
        window = {"u_mm": reading.u, "window_s": [reading.start_s, reading.end_s], "samples": reading.samples}
        value = {"displacement_tenth_nm": round(reading.value / MM_PER_COUNT)} | window
    return value | {
        "host_s": near.host_s,
        "ctrl_us": int(times(np.array([middle_s]))[0] * 1e6),
        "target_mm": list(one.target_mm),
        "direction": one.direction,
        "status": near.status,
        "signal_permille": near.signal_permille,
        "feed_mm_min": 0.0,
        **air_doc(near),
    }


async def listen_campaign(
    session: Session, store: Store, site: Site, plan: CampaignPlan, report: Report, clock: Clock | None = None
) -> list[int]:
    """Listen to the program of a plan, test by test; return the numbers of the runs.

    Raises
    ------
    StrokeError, MeasurementFault
        Before any prompt: the plan does not fit the machine, or a test is not suited for listening.
    MeasurementFault, DriverError
        The current run is closed as failed, with the reason; earlier runs stay.
    """
    clock = clock or SystemClock()
    dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    for test in plan.tests:
        planned_readings(test)
    await check_devices(session, plan)
    under_way = OpenCampaign(*await start_campaign(session, store, site, plan.name, {"listened": True}))
    run_ids = []
    for test in plan.tests:
        doc = await start_document(session, site, under_way, test, clock)
        run_id = await store.write(store.runs.start, under_way.id, test.label, test.test, test.role, doc)
        status, reason, end = "aborted", "stopped", dict[str, Any]()
        about = {"label": test.label, "test": test.test, "machine": site.name}
        recorder: CaptureRecorder | None = None
        try:
            async with recording(store, run_id, site.capture, clock, about) as recorder:
                end = await listen_to(session, recorder, test, report)
            under_way.mounted_us[test.setup_id] = end["mounted_us"]
            status, reason = "complete", ""
            if any(isinstance(step, Unmount) for step in test.steps):
                await session.need_fixture().unmount()
        except (AbbeError, DriverError) as error:
            status, reason = "failed", f"{error.code}: {error}"
            raise
        finally:
            end |= {"ended_utc": clock.utc().isoformat()} | ({} if recorder is None else recorder.doc())
            await run_to_end(close_run(store, run_id, recorder, status, reason, end))
        run_ids.append(run_id)
    return run_ids
