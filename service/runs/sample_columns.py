"""Turn samples into columns: every reading of ball-bar or laser gets the commanded position at which it was taken.

For a ball-bar in motion, the controller's "path running" output (the sync line) is wired to the bar's box, which samples it together with
the reading. The first sample with this input set was taken within one period after the path began. No reading is placed by the arrival time
of its sample.

The two edges of the sync line tie the box's clock to the controller's (`run_clock`). The device stamps and arrival times of both
devices' messages are an independent check by way of this computer's clock, and a disagreement is reported. If the stamps give the ratio
of the two clock rates with less uncertainty than the edges, the stamps are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from abbe.drivers.api import bar_is_valid, beam_is_gone, on_path
from abbe.models.alignment.clock import LEAST_PAIRS, ClockFit, across, breaks, fit_clock, relative_rate
from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import BarRecord, ChunkRecord, CommandedPath, LaserRecord, RunEnd, RunStart, StandstillRecord
from abbe.service.domain.run import Columns
from abbe.service.errors import MeasurementFault

U_DELAY_S = 2e-3
"""Standard uncertainty of a link's least delay, which arrivals do not show: 0 to 7 ms in the adapter and the operating system."""
COLLECTS_MS = 16
"""Time for which a serial adapter collects bytes, possibly in step with the samples."""
SURE = 3.0
"""A drift or a disagreement is significant from this multiple of its standard uncertainty."""


@dataclass(frozen=True, slots=True)
class RunClock:
    """Seconds of the controller per second of the box, its standard uncertainty, and the ``timing`` document of the run."""

    rate: float
    u_rate: float
    doc: Doc


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of the sync line: box time of the first and last sample with the line set, and the sample period.

    ``whole``: the samples next to both edges exist; otherwise an edge fell into a gap of the stream and cannot be used.
    """

    first_us: int
    last_us: int
    period_s: float
    whole: bool = True


def run_clock(chunks: Sequence[ChunkRecord], end: RunEnd, edges: Edges) -> RunClock:
    """Return the rate of the box's clock against the controller's, from the sync line or the arrivals, whichever is less uncertain.

    A drift below `SURE` standard uncertainties is not corrected; ``u_rate`` covers it.
    """
    found = _fits(chunks, end, edges.period_s)
    doc: Doc = {}
    tries: list[tuple[float, float, str]] = []
    path_us = end.path_us
    if edges.whole and path_us is not None and edges.last_us > edges.first_us:
        recorded_s = (edges.last_us - edges.first_us) * 1e-6 + edges.period_s
        run_s = (path_us[1] - path_us[0]) * 1e-6
        tries.append((run_s / recorded_s, float(np.sqrt(1.0 / 6.0)) * edges.period_s / recorded_s, "sync line"))
    if isinstance(found, tuple):
        tries.append((*relative_rate(*found), "arrivals"))
        doc |= _compared(found, end, edges)
    elif found:
        doc["trouble"] = found
    if not tries:
        return RunClock(1.0, 0.0, doc | {"rate_from": "nothing: both clocks are taken to be equal"})
    rate, u, source = min(tries, key=lambda one: one[1])
    doc |= {"box_slower_ppm": (rate - 1.0) * 1e6, "u_box_slower_ppm": u * 1e6, "rate_from": source}
    used = rate if abs(rate - 1.0) > SURE * u else 1.0
    return RunClock(used, u, doc | {"corrected_ppm": (used - 1.0) * 1e6})


def _fits(chunks: Sequence[ChunkRecord], end: RunEnd, period_s: float) -> tuple[ClockFit, ClockFit] | str:
    """Fit the clocks of the box and of the controller to the clock of this computer.

    Without a fit, returns the reason: a sentence if a clock jumped, an empty text if there are too few pairs.
    """
    box = np.array([(c.last_device_us * 1e-6, c.last_host_s) for c in chunks], dtype=np.float64).reshape(-1, 2)
    cnc = np.array(end.clock_pairs, dtype=np.float64).reshape(-1, 2) * [1e-6, 1.0]
    for name, pairs in (("ball-bar's box", box), ("controller", cnc)):
        if len(pairs) < LEAST_PAIRS:
            return ""
        for one in breaks(pairs[:, 0], pairs[:, 1]):
            what = "started anew" if one.kind == "restart" else f"was set by {one.step_s * 1e3:.0f} ms"
            return f"the clock of the {name} {what} during the run"
    return _fit(box, 1e-3 * math.gcd(round(period_s * 1e3), COLLECTS_MS)), _fit(cnc, 0.0)


def _fit(pairs: Any, grid_s: float) -> ClockFit:
    return fit_clock(pairs[:, 0], pairs[:, 1], u_delay_s=U_DELAY_S, grid_s=grid_s)


def _compared(fits: tuple[ClockFit, ClockFit], end: RunEnd, edges: Edges) -> Doc:
    """Return the times of the edges by the arrivals minus those by the controller, ms of controller time.

    Positive: by the arrivals, the path began (or ended) before the sync line shows it.
    """
    doc: Doc = {"box_drift_ppm": fits[0].drift_ppm, "controller_drift_ppm": fits[1].drift_ppm}
    path_us = end.path_us
    if path_us is None or not edges.whole:
        return doc
    half = 0.5 * edges.period_s
    at: F1 = np.array([edges.first_us * 1e-6 - half, edges.last_us * 1e-6 + half])
    there, u = across(*fits, at)
    off = there - np.array(path_us) * 1e-6
    u = np.hypot(u, edges.period_s / np.sqrt(12.0))
    doc |= {"sync_start_ms": float(off[0]) * 1e3, "sync_end_ms": float(off[1]) * 1e3, "u_sync_ms": float(u.max()) * 1e3}
    if (np.abs(off) > SURE * u).any():
        worst = int(np.argmax(np.abs(off) / u))
        edge = ("begins", "ends")[worst]
        later = "earlier" if off[worst] > 0.0 else "later"
        by, u_ms = abs(off[worst]) * 1e3, u[worst] * 1e3
        doc["trouble"] = (
            f"by time stamps and arrival times, the path {edge} {by:.0f} ms {later} than the sync line shows (u = {u_ms:.0f} ms)"
        )
    return doc


Array = npt.NDArray[np.float64]

DURATION_TOLERANCE = 0.01


BAR_SAMPLE = np.dtype([("seq", "<u4"), ("device_us", "<u8"), ("reading_nm", "<i4"), ("status", "<u2")])
"""A ball-bar sample as its chunk holds it; fields of `abbe.drivers.api.BarSample`."""
BarSamples = npt.NDArray[np.void]


BLOCK = 2**15
"""Number of samples examined together: their status words fit into a processor's cache and are mostly equal."""
Rows = slice | npt.NDArray[np.intp]


def _holds(samples: BarSamples, what: Callable[[int], bool]) -> npt.NDArray[np.bool_]:
    """Return the mask of the samples whose status fulfils ``what``, which is called once for each different status of a block."""
    holds = np.empty(len(samples), dtype=np.bool_)
    kinds = np.zeros(2**16, dtype=np.bool_)
    for begin in range(0, len(samples), BLOCK):
        status = np.ascontiguousarray(samples["status"][begin : begin + BLOCK])
        if status.min() == status.max():
            holds[begin : begin + BLOCK] = what(int(status[0]))
            continue
        for kind in np.flatnonzero(np.bincount(status)):
            kinds[kind] = what(int(kind))
        holds[begin : begin + BLOCK] = kinds[status]
    return holds


def _ends(holds: npt.NDArray[np.bool_]) -> tuple[int, int] | None:
    """Return the first and the last row for which a mask holds; None if there is none."""
    first = int(np.argmax(holds)) if holds.size else 0
    return (first, holds.size - 1 - int(np.argmax(holds[::-1]))) if holds.any() else None


def _rows(holds: npt.NDArray[np.bool_]) -> Rows:
    """Return the index of the rows for which a mask holds; a slice, which copies nothing, if they follow one another."""
    first, last = _ends(holds) or (0, -1)
    return slice(first, last + 1) if holds[first : last + 1].all() else np.flatnonzero(holds)


def _follows(samples: BarSamples, k: int) -> bool:
    """Whether sample ``k`` came directly after the one before it."""
    return 0 < k < len(samples) and int(samples["seq"][k - 1]) + 1 == int(samples["seq"][k])


def sync_edges(samples: BarSamples, start: RunStart) -> Edges | None:
    """Return the edges of the sync line in a run; None if no sample has the line set."""
    ends = _ends(_holds(samples, on_path))
    if ends is None:
        return None
    first, last = ends
    device_us, whole = samples["device_us"], _follows(samples, first) and _follows(samples, last + 1)
    return Edges(int(device_us[first]), int(device_us[last]), 1.0 / start.rate_hz, whole)


def starts_in_stream(samples: BarSamples) -> bool:
    """Whether the stream contains the sample just before the path. Then the path's start is known to one sample period."""
    first, _ = _ends(_holds(samples, on_path)) or (0, 0)
    return first > 0 and (int(samples["seq"][first - 1]) + 1) % 2**32 == int(samples["seq"][first])


_FURTHER = {"device_seq": "seq", "device_us": "device_us", "status": "status"}


def bar_columns(
    samples: BarSamples, start: RunStart, end: RunEnd, *, complete: bool = True, rate: float = 1.0, full: bool = True
) -> Columns:
    """Turn the samples of one path into columns.

    Parameters
    ----------
    samples : array of `BAR_SAMPLE`, shape (n,)
        All samples of the run, also those before and after the path.
    start : RunStart
        Its start document, with the path.
    end : RunEnd
        Its end document; empty for an interrupted run.
    complete : bool
        Whether the path ran to its end, so that durations can be checked.
    rate : float
        Seconds of the controller per second of the box (`abbe.service.runs.sample_columns`).
    full : bool
        Whether to give all columns. Otherwise positions are NaN and further columns are missing, which halves the time.

    Returns
    -------
    Columns
        With ``device_seq``, ``device_us``, ``status``.

    Raises
    ------
    MeasurementFault
        No sample lies on the path, or feed, path and duration contradict each other.
    """
    path, rate_hz = start.commanded, start.rate_hz
    feed_mm_s = path.feed_mm_s
    rows = _rows(_holds(samples, on_path))
    along, first = samples[rows], rows.start if isinstance(rows, slice) else int(rows[0])
    device_us = along["device_us"].astype(np.int64)
    path_us = end.path_us if complete else None
    if path_us is not None:
        _check_durations(device_us, path_us, float(path.arc_mm[-1]) / feed_mm_s, rate_hz)
    along_s = _time_along_path(samples, first, device_us, path_us, (rate_hz, rate))
    counts = _rows(_counts(path, feed_mm_s * along_s))
    along, along_s = along[counts], along_s[counts]
    count = len(along)
    further = {name: along[field].astype(np.int64) for name, field in _FURTHER.items()} if full else {}
    return Columns(
        t_s=_start_s(start, end) + along_s,
        q_mm=_position(path.points_mm, feed_mm_s * along_s) if full else np.broadcast_to(np.nan, (count, 3)),
        feed_mm_min=np.broadcast_to(path.feed_mm_min, count),
        direction=np.broadcast_to(float(path.direction), count),
        deviation_mm=along["reading_nm"] * 1e-6,
        valid=_holds(along, bar_is_valid),
        further=further,
    )


def _start_s(start: RunStart, end: RunEnd) -> float:
    """Return the start of the path on the campaign's clock, s, from the best entry of the documents."""
    for stated_us in (end.path_start_us, start.path_start_us, start.clock_us):
        if stated_us is not None:
            return start.since_zero_s(stated_us)
    return start.set_s


def _time_along_path(
    samples: BarSamples,
    first: int,
    device_us: npt.NDArray[np.int64],
    path_us: tuple[int, int] | None,
    rates: tuple[float, float],
) -> Array:
    if not device_us.size:
        return np.zeros(0)
    half_period_s = 0.5 / rates[0]
    since_first_s = (device_us - device_us[0]) * 1e-6 * rates[1]
    seq, before = int(samples["seq"][first]), int(samples["seq"][first - 1])
    start_was_lost = seq != (before + 1) % 2**32 if first else seq != 0
    if start_was_lost and path_us is not None:
        # The first edge fell into a gap of the stream: use the other edge of the path.
        duration_s = (path_us[1] - path_us[0]) * 1e-6
        return np.asarray(duration_s - half_period_s - since_first_s[-1] + since_first_s)
    return np.asarray(since_first_s + half_period_s)


def _check_durations(device_us: npt.NDArray[np.int64], path_us: tuple[int, int], planned_s: float, rate_hz: float) -> None:
    controller_s = (path_us[1] - path_us[0]) * 1e-6
    if device_us.size == 0:
        raise MeasurementFault("no ball-bar sample has the sync input set", "check the cable from the controller's path output to the bar")
    device_s = float(device_us[-1] - device_us[0]) * 1e-6 + 1.0 / rate_hz
    tolerance_s = DURATION_TOLERANCE * controller_s + 2.0 / rate_hz
    if abs(device_s - controller_s) > tolerance_s:
        raise MeasurementFault(
            "feed changed during the run, or its first or last samples were lost: "
            f"the path took {device_s:.3f} s by the ball-bar, {controller_s:.3f} s by the controller",
            "measure the run again with a steady connection and the feed override at 100 %",
        )
    if abs(device_s - planned_s) > tolerance_s:
        raise MeasurementFault(
            f"feed changed during the run: the path takes {planned_s:.3f} s at the commanded feed, but took {device_s:.3f} s",
            "set the feed override to 100 %, avoid feed hold, and measure the run again",
        )


def _counts(path: CommandedPath, arc_mm: Array) -> npt.NDArray[np.bool_]:
    """Return a mask of the readings between the first and last measured point; feed-in and feed-out stay in the raw samples only."""
    if path.measured is None:
        return np.ones(arc_mm.size, dtype=np.bool_)
    first_mm, last_mm = path.counted_mm
    return np.asarray((arc_mm >= first_mm) & (arc_mm <= last_mm), dtype=np.bool_)


def _position(points: Array, arc_mm: Array) -> Array:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    corners = points[np.concatenate(([True], steps > 0.0))]  # repeated points would make the arc length ambiguous
    arc = np.concatenate(([0.0], np.cumsum(steps[steps > 0.0])))
    out = np.empty((arc_mm.size, 3))
    for axis in range(3):
        out[:, axis] = np.interp(arc_mm, arc, corners[:, axis])
    return out


def bar_point_columns(records: Sequence[BarRecord], start: RunStart) -> Columns:
    """Convert the records of a point-by-point ball-bar test to columns: one row per point, the mean of its samples.

    Parameters
    ----------
    records : sequence of BarRecord
        In order.
    start : RunStart
        The zero of the clock.

    Returns
    -------
    Columns
        With ``reading_u_mm`` (standard uncertainty of each mean), ``samples_count``, ``device_us`` of the first
        sample.
    """
    return Columns(
        **_standstills(records, start),
        deviation_mm=np.array([np.mean(one.reading_nm) * 1e-6 for one in records], dtype=np.float64),
        valid=np.array([all(bar_is_valid(s) for s in one.status) for one in records], dtype=np.bool_),
        further={
            "reading_u_mm": np.array([_u_mm(one.reading_nm) for one in records], dtype=np.float64),
            "samples_count": np.array([len(one.reading_nm) for one in records], dtype=np.int64),
            "device_us": np.array([one.device_us[0] for one in records], dtype=np.int64),
        },
    )


def _u_mm(reading_nm: Sequence[int]) -> float:
    n = len(reading_nm)
    return float(np.std(reading_nm, ddof=1) * 1e-6 / np.sqrt(n)) if n > 1 else 0.0


_AIR = {"temp_air_C": "air_temp_c", "pressure_air_Pa": "air_pressure_pa"}
MM_PER_COUNT = 1e-7
"""The displacement counts tenths of a nanometre."""


def laser_columns(records: Sequence[LaserRecord], start: RunStart, beam: F1) -> Columns:
    """Convert laser records to columns.

    Parameters
    ----------
    records : sequence of LaserRecord
        One for each standstill, in order.
    start : RunStart
        The zero of the clock.
    beam : array, shape (3,)
        Nominal beam, unit vector.

    Returns
    -------
    Columns
        With ``status``, ``signal_permille``, and ``temp_air_C``, ``pressure_air_Pa`` if every record has them. Deviations are relative to
        the first record, or to the laser's zero if that record is missing. A missing reading is a row with the commanded position,
        deviation 0 and ``valid`` 0, so that rows still match standstills.
    """
    air = {column: np.array([getattr(one, key) for one in records], dtype=np.float64) for column, key in _AIR.items()}
    return Columns(
        **_standstills(records, start),
        deviation_mm=np.array([_deviation_mm(one, records[0], beam) for one in records], dtype=np.float64),
        valid=np.array([not (one.missing or beam_is_gone(one.status)) for one in records], dtype=np.bool_),
        further={
            **{column: values for column, values in air.items() if not np.isnan(values).any()},
            "status": np.array([one.status for one in records], dtype=np.int64),
            "signal_permille": np.array([one.signal_permille for one in records], dtype=np.int64),
        },
    )


def _standstills(records: Sequence[StandstillRecord], start: RunStart) -> dict[str, Any]:
    """Return the columns that every run at standstills has."""
    return {
        "t_s": np.array([start.since_zero_s(one.ctrl_us) for one in records], dtype=np.float64),
        "q_mm": np.array([one.target_mm for one in records], dtype=np.float64).reshape(-1, 3),
        "feed_mm_min": np.array([one.feed_mm_min for one in records], dtype=np.float64),
        "direction": np.array([one.direction for one in records], dtype=np.float64),
    }


def _deviation_mm(one: LaserRecord, first: LaserRecord, beam: F1) -> float:
    if one.missing:
        return 0.0
    nominal_mm = sum(b * (now - before) for b, now, before in zip(beam.tolist(), one.target_mm, first.target_mm, strict=True))
    return float((one.displacement_tenth_nm - first.displacement_tenth_nm) * MM_PER_COUNT - nominal_mm)
