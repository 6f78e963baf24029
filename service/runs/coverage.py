"""Share of its commanded path that a run has read, and whether the run is judged: one rule for results, reports, pages and comparisons.

A run gives no result if it was stopped, aborted, interrupted or failed, or has read less than `LEAST` of its path. A complete run with a
few counted gaps is judged. A run that was measured in pieces is judged with all its pieces.

The module also gives the range of positions of runs (beyond it a map is assumed), and axis and angle of a ball-bar path: coverage counts
turns about this axis; pages and the live view draw the angle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.service.domain.measured import RunRecord, RunStart
from abbe.service.domain.run import BarSetup, Run, RunState
from abbe.service.errors import AbbeError, MeasurementFault

STRAIGHT = 0.8
"""Smallest ratio of net to total travel along the axis of a helix."""
ROUND = 0.5
"""Largest ratio of net to total travel across the axis of a helix, which goes round. Less than a turn is not a helix."""


def reached_mm(runs: Sequence[Run]) -> tuple[tuple[float, float], ...]:
    """Return the lowest and highest position of each axis in the valid readings of these runs, mm; empty if there are none."""
    places = [r.columns.q_mm[r.columns.valid] for r in runs]
    if not sum(map(len, places)):
        return ()
    ends = np.concatenate(places)
    return tuple((float(low), float(high)) for low, high in zip(ends.min(axis=0), ends.max(axis=0), strict=True))


def reached_text(reached: Mapping[str, tuple[float, float]]) -> str:
    """Return the positions that runs reach as text; empty if they are not known."""
    ends = ", ".join(f"{axis} {low:.0f} to {high:.0f}" for axis, (low, high) in reached.items())
    return f"{ends} mm; the map beyond is assumed" if ends else ""


def helix_axis(stated: str, at_mm: F2) -> int | None:
    """Return the axis of a helix, 0 to 2: as the set-up states it, else the axis along which the commanded path advances.

    None if the set-up states no axis, and the path advances along none or along several.

    Parameters
    ----------
    stated : str
        Letter of the axis in the set-up, or empty.
    at_mm : array, shape (n, 3)
        Commanded positions in chronological order, mm.
    """
    if stated:
        return AXES.index(stated)
    if len(at_mm) < 3:
        return None
    way = np.abs(np.diff(at_mm, axis=0)).sum(axis=0)
    forth = np.divide(np.abs(at_mm[-1] - at_mm[0]), way, out=np.ones(3), where=way > 0.0)
    forth[way <= 0.0] = 0.0
    along = int(np.argmax(forth))
    across = np.delete(forth, along)
    return along if forth[along] >= STRAIGHT and (across <= ROUND).all() else None


def about_axis(at_mm: F2, axis: int) -> F1:
    """Return the angle of points about an axis, rad, shape (n,), from the next axis towards the one after it (about Z: from X to Y)."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return np.asarray(np.arctan2(at_mm[:, b], at_mm[:, a]), dtype=np.float64)


def circle_axis(plane: str) -> int:
    """Return the axis normal to a plane given by two letters, 0 to 2. Raises MeasurementFault for anything else."""
    if len(plane) != 2:
        raise MeasurementFault(f"a circle lies in a plane of two axes, not in {plane!r}", "state the plane in its set-up, for example XY")
    return 3 - sum(AXES.index(letter) for letter in plane)


def path_axis(run: Run, at_mm: F2) -> int:
    """Return the axis of a ball-bar run, 0 to 2: the normal of a circle's plane, or `helix_axis`.

    Raises
    ------
    MeasurementFault
        Neither set-up nor path determines the axis of a helix.
    """
    if run.test == "ballbar_circle":
        return circle_axis(run.bar.plane)
    found = helix_axis(run.bar.axis, at_mm)
    if found is None:
        raise MeasurementFault(
            f"run {run.run_id}: its set-up states no axis of the helix, and its path advances along none",
            'state it in the set-up: "axis": "X", "Y" or "Z"',
        )
    return found


LEAST = 0.9
"""Smallest share of the commanded path that a judged run must have read: the missing part may contain the largest deviation."""
COMPLETE = "complete"
GAP_MM, GAP_SAMPLES = 5.0, 10.0
"""Two valid readings farther apart than both limits leave the path between them unread."""
LEAST_A_TURN = 8
"""Minimum number of readings per turn; in a run with fewer, each group of this many counts as one turn."""
GAP_STEPS, GAP_SHARE = 3.0, 0.15
"""For a run from a file, whose commanded path is unknown: the path between two neighbouring readings is unread if their distance exceeds
this many median steps and this share of a laser run or of a turn."""


def with_state(run: Run, record: RunRecord, begun: RunStart | None = None) -> Run:
    """Add the ``state`` of a stored run that is incomplete or has not read enough of its path.

    ``begun``: start of the run that began the path, if this one resumed it.
    """
    share = _of_path(run, begun or record.start)
    status = record.visible_status
    if status == COMPLETE and (share is None or share >= LEAST):
        return run
    return replace(run, state=RunState(status=status, covered=None if share is None else round(share, 4)))


def covered_share(run: Run) -> float | None:
    """Return the share of its commanded path that a run has read, 0 to 1.

    None if neither the store nor the set-up states a path; NaN for a helix that is too short to determine its axis.
    """
    return _of_setup(run) if run.state is None else run.state.covered


def not_judged(run: Run) -> str:
    """Return why a run gives no result, e.g. ``stopped: 4.5 % of the path; not judged``; empty if it is judged."""
    status = COMPLETE if run.state is None else run.state.status
    share = covered_share(run)
    if status == COMPLETE and (share is None or share >= LEAST):
        return ""
    state = "incomplete" if status == COMPLETE else status.replace("_", " ")
    part = "" if share is None else "its share of the path is unknown; " if np.isnan(share) else f"{100 * share:.1f} % of the path; "
    return f"{state}: {part}not judged"


def check_judged(run: Run) -> None:
    """Refuse a run that gives no result.

    Raises
    ------
    MeasurementFault
        The run did not reach its end, or has read less than `LEAST` of its path.
    """
    why = not_judged(run)
    if why:
        raise MeasurementFault(f"run {run.run_id}: {why}", "measure it again, or resume it: abbe measure -m MACHINE.toml --resume")


def _of_path(run: Run, start: RunStart) -> float | None:
    """Return the share of the commanded path length, or of the planned standstills."""
    if run.is_sealed:
        return None
    valid, path = run.columns.valid, start.path
    if path is None:
        return _share(float(valid.sum()), float(start.standstills)) if start.standstills else None
    first_mm, last_mm = path.counted_mm
    return _share(_read_mm(run.columns.q_mm[valid], path.feed_mm_s / start.rate_hz), path.offset_mm + last_mm - first_mm)


def _of_setup(run: Run) -> float | None:
    """Return the share according to the set-up of a run from a file: turns of a helix, angle of a circle, outward path of a laser run."""
    if run.is_sealed:
        return None
    at, setup = run.columns.q_mm[run.columns.valid], run.setup
    if len(at) < 3 or not np.isfinite(at).all():
        return None
    try:
        if isinstance(setup, BarSetup):
            return _turned(setup, at - setup.centre_mm, circle=run.test == "ballbar_circle")
        span = run.laser.span_mm
        along, whole = at @ span, float(span @ span)
        return _share(_read(np.sort(along), GAP_SHARE * whole), whole)
    except (AbbeError, ValueError):
        return None


def _turned(setup: BarSetup, at: F2, *, circle: bool) -> float | None:
    """Return the share of the turns about the axis of a ball-bar path."""
    axis = circle_axis(setup.plane) if circle else helix_axis(setup.axis, at)
    whole = setup.span_deg / 360.0 if circle else setup.turns
    if whole is None or not whole > 0.0:
        return None
    if axis is None:
        return np.nan
    if len(at) < LEAST_A_TURN * whole:
        return _share(float(len(at)), LEAST_A_TURN * whole)
    return _share(_read(np.unwrap(about_axis(at, axis)), GAP_SHARE * 2.0 * np.pi) / (2.0 * np.pi), whole)


def _read(x: F1, least: float) -> float:
    """Return the range of the positions ``x`` minus the gaps that are much wider than the usual step."""
    steps = np.abs(np.diff(x))
    moved = steps[steps > 0.0]
    wide = steps[steps > max(least, GAP_STEPS * float(np.median(moved)))] if moved.size else steps
    return float(np.ptp(x)) - float(wide.sum())


def _share(part: float, whole: float) -> float | None:
    return float(np.clip(part / whole, 0.0, 1.0)) if np.isfinite(part) and np.isfinite(whole) and whole > 0.0 else None


def _read_mm(at: F2, step_mm: float) -> float:
    """Return the path length between consecutive valid readings, without gaps, mm."""
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1)
    return float(steps[steps <= max(GAP_MM, GAP_SAMPLES * step_mm)].sum()) + step_mm
