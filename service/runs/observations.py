"""Convert runs to arrays for the solvers: the only place where measured columns become `RunData`."""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import travel_sign
from abbe.models.solvers.observations import RunData, Test, block_average, reading_noise_mm
from abbe.service.domain.run import LaserSetup, Run
from abbe.service.errors import MeasurementFault
from abbe.service.runs.approached import with_reversals

BLOCKS = 400
"""Largest number of values per ball-bar run in a solution: averaging reduces noise and keeps smooth errors."""
LEAST = 10
"""Least number of valid readings of a run."""
TESTS: dict[str, Test] = {"ballbar_helix": "helix", "ballbar_circle": "circle", "laser_diagonal": "diagonal", "laser_linear": "linear"}
"""Tests of run-format.md 3; plain diagonals are laser_diagonal without an order."""


def run_data(run: Run, *, blocks: int = BLOCKS) -> RunData:
    """Valid readings of a run as arrays; long ball-bar runs are block-averaged, single outliers left out and counted.

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
    if run.test not in TESTS:
        raise MeasurementFault(f"run {label}: test {run.test!r} is not one this solver knows")
    if run.is_sealed:
        raise MeasurementFault(f"run {label}: it is sealed, its readings are not there", "it can only be predicted")
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
        return RunData(kind="laser", **common, deviation_mm=_since_first(read, first_valid=bool(valid[0])), beam=run.beam)
    common |= {"u_length_mm": setup.u_length_mm, "length_calibrated": setup.length_calibrated}
    return block_average(RunData(kind="bar", **common, deviation_mm=read, centre_mm=setup.centre_mm, radius_mm=setup.radius_mm), blocks)


def _signs(run: Run) -> F2:
    """Direction of each axis' last move, shape (n, 3), from the rows with finite positions; NaN for the others, which are invalid."""
    axes_mm = run.columns.q_mm
    known = np.isfinite(axes_mm).all(axis=1)
    out = np.full(axes_mm.shape, np.nan)
    path, rows = with_reversals(run, axes_mm) if known.all() else (axes_mm[known], np.arange(int(known.sum())))
    out[known] = travel_sign(path)[rows]
    return out


def _since_first(deviation_mm: F1, *, first_valid: bool) -> F1:
    """Laser deviations relative to the first valid record.

    A laser run counts from its first record. If that one is invalid, the deviations are shifted to the first valid one; otherwise the
    common offset would look like an error of the zero.
    """
    return deviation_mm if first_valid else deviation_mm - deviation_mm[0]


def bar_noise_mm(run: Run) -> float:
    """Standard deviation of one valid ball-bar reading, mm (`abbe.models.solvers.observations.reading_noise_mm`)."""
    return reading_noise_mm(run.columns.readings_mm[run.columns.valid])
