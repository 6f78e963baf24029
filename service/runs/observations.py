"""Convert runs to arrays for the solvers: the only place where measured columns become `RunData`.

Rows of a positioning test state where the axis stood, not how it got there. An axis at one place with ``direction`` +1 and then -1 either
never moved, or overran the place and came back between the rows (ISO 230-2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import REST_MM, travel_sign
from abbe.models.solvers.observations import RunData, Test, block_average, reading_noise_mm
from abbe.service.domain.run import ArtefactSetup, LaserSetup, Run
from abbe.service.errors import MeasurementFault
from abbe.service.runs.artefact_points import artefact_data

BEYOND_MM = 5.0
"""Assumed overrun beyond a place: more than any lost motion."""
NEAR_MM = 0.05
"""Positions closer than this are the same place."""
FEWEST = 3
"""Number of places approached from both sides that are needed to estimate how readings from the two sides differ."""


def with_reversals(run: Run, q_mm: F2) -> tuple[F2, np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Insert the reversals that the rows of a ``laser_linear`` run omit; other tests are returned unchanged.

    Parameters
    ----------
    run : Run
        As measured.
    q_mm : array, shape (n, 3)
        Its positions.

    Returns
    -------
    path, rows
        Positions with the reversals, shape (m, 3), and the index of every row in them, shape (n,).
    """
    rows = np.arange(len(q_mm))
    if run.test != "laser_linear" or not np.isfinite(q_mm).all() or run.laser.end_mm is None:
        return q_mm, rows
    moved = np.abs(np.diff(q_mm, axis=0)).max(axis=1, initial=0.0) > REST_MM
    way = np.sign(run.columns.direction)
    turned = np.flatnonzero(~moved & (way[1:] * way[:-1] < 0)) + 1
    if not turned.size:
        return q_mm, rows
    if not moved.any():
        turned = np.concatenate([[0], turned])
    elif not _went_beyond(run, q_mm, way, turned):
        return q_mm, rows
    beyond = q_mm[turned] - BEYOND_MM * way[turned, None] * _along(run)
    return np.insert(q_mm, turned, beyond, axis=0), rows + np.searchsorted(turned, rows, side="right")


def _along(run: Run) -> F1:
    """Return the unit vector from start to end of a test."""
    way = run.laser.span_mm
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))


def _went_beyond(run: Run, q_mm: F2, way: F1, turned: np.ndarray[tuple[int], np.dtype[np.intp]]) -> bool:
    """Whether the two readings at a reversal differ like readings from opposite sides elsewhere, rather than like repeats."""
    if run.is_sealed:
        return False
    y = run.columns.readings_mm
    good = np.isfinite(y) & run.columns.valid
    pairs = turned[good[turned] & good[turned - 1]]
    good[np.concatenate([turned, turned - 1])] = False
    place = np.round(q_mm @ _along(run) / NEAR_MM)
    sides = [[y[good & (place == p) & (way == s)] for s in (1, -1)] for p in np.unique(place[good])]
    differ = np.array([a.mean() - b.mean() for a, b in sides if a.size and b.size])
    if differ.size < FEWEST or not pairs.size:
        return False
    jump = way[pairs] * (y[pairs] - y[pairs - 1])
    return bool(np.median(np.abs(jump - np.median(differ))) < np.median(np.abs(jump)))


BLOCKS = 400
"""Largest number of values per ball-bar run in a solution: averaging reduces noise and keeps smooth errors."""
LEAST = 10
"""Minimum number of valid readings of a run."""
TESTS: dict[str, Test] = {"ballbar_helix": "helix", "ballbar_circle": "circle", "laser_diagonal": "diagonal", "laser_linear": "linear"}
"""Solver test for the ``test`` of a run; a plain diagonal is a laser_diagonal without an order of axes."""


def run_data(run: Run, *, blocks: int = BLOCKS) -> RunData:
    """Return the valid readings of a run as arrays. Long ball-bar runs are averaged in blocks; single outliers are left out and counted.

    Raises
    ------
    MeasurementFault
        The run has fewer than 10 valid readings, is sealed, has a test unknown to the solver, or contains an invalid number, length or
        direction.
    """
    try:
        return _run_data(run, blocks)
    except ValueError as exc:
        raise MeasurementFault(str(exc), "correct the run or leave it out") from exc


def _run_data(run: Run, blocks: int) -> RunData:
    columns, setup, label = run.columns, run.setup, run.run_id
    if isinstance(setup, ArtefactSetup):
        return artefact_data(run, setup)
    if run.test not in TESTS:
        raise MeasurementFault(f"run {label}: the solver does not know the test {run.test!r}", "leave it out")
    if run.is_sealed:
        raise MeasurementFault(f"run {label}: it is sealed, so it has no readings", "Abbe can only predict this run")
    valid = columns.valid
    if int(valid.sum()) < LEAST:
        raise MeasurementFault(f"run {label}: only {int(valid.sum())} valid readings of {len(columns)}", "measure it again")
    common: dict[str, Any] = {
        "label": label,
        "setup": setup.setup_id,
        "axes_mm": columns.q_mm[valid],
        "sign": _signs(run)[valid],
        "t_s": columns.t_s[valid],
        "weight_n": np.ones(int(valid.sum())),
        "tool_mm": setup.tool_mm,
        "test": TESTS[run.test],
    }
    read = columns.readings_mm[valid]
    if isinstance(setup, LaserSetup):
        start = columns.q_mm[0] if np.isfinite(columns.q_mm[0]).all() else None  # the zero was taken there, valid record or not
        read = _since_first(read, first_valid=bool(valid[0]))
        return RunData(kind="laser", **common, deviation_mm=read, beam=run.beam, start_mm=start)
    common |= {"u_length_mm": setup.u_length_mm, "length_calibrated": setup.length_calibrated}
    return block_average(RunData(kind="bar", **common, deviation_mm=read, centre_mm=setup.centre_mm, radius_mm=setup.radius_mm), blocks)


def _signs(run: Run) -> F2:
    """Return the direction of each axis' last move, shape (n, 3), from rows with finite positions; NaN in other rows, which are invalid."""
    axes_mm = run.columns.q_mm
    known = np.isfinite(axes_mm).all(axis=1)
    out = np.full(axes_mm.shape, np.nan)
    path, rows = with_reversals(run, axes_mm) if known.all() else (axes_mm[known], np.arange(int(known.sum())))
    out[known] = travel_sign(path)[rows]
    return out


def _since_first(deviation_mm: F1, *, first_valid: bool) -> F1:
    """Return laser deviations relative to the first valid record.

    A laser run counts from its first record. If that record is invalid, the deviations are shifted to be zero at the first valid one;
    otherwise the common offset would look like an error of the zero.
    """
    return deviation_mm if first_valid else deviation_mm - deviation_mm[0]


def bar_noise_mm(run: Run) -> float:
    """Return the standard deviation of one valid ball-bar reading, mm (`abbe.models.solvers.observations.reading_noise_mm`)."""
    return reading_noise_mm(run.columns.readings_mm[run.columns.valid])


def with_earliest_mounting(runs: list[Run]) -> list[Run]:
    """Give all runs of a set-up its earliest ``t_set_s``: the set-up was mounted once, and later values are only starts of runs.

    Call this with all runs of a campaign before leaving any out, because an omitted run may hold the only mounting time.
    """
    earliest: dict[str, float] = {}
    for run in runs:
        setup = run.setup
        if setup.t_set_s is not None:
            earliest[setup.setup_id] = min(setup.t_set_s, earliest.get(setup.setup_id, np.inf))
    times = [earliest.get(run.setup.setup_id) for run in runs]
    return [run if t is None else run.mounted(t) for run, t in zip(runs, times, strict=True)]
