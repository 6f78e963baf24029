"""Convert runs to arrays for the solvers: the only place where measured columns become `RunData`."""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import travel_sign
from abbe.models.solvers.observations import RunData, Test, block_average, reading_noise_mm
from abbe.service.errors import MeasurementFault
from abbe.service.runs.approached import with_reversals

BLOCKS = 400
"""Largest number of values per ball-bar run in a solution: averaging reduces noise and keeps smooth errors."""
LEAST = 10
"""Least number of valid readings of a run."""
TESTS: dict[str, Test] = {"ballbar_helix": "helix", "ballbar_circle": "circle", "laser_diagonal": "diagonal", "laser_linear": "linear"}
"""Tests of run-format.md 3; plain diagonals are laser_diagonal without an order."""


def run_data(run: dict[str, Any], *, blocks: int = BLOCKS) -> RunData:
    """Valid readings of an ``abbe-run/1`` object as arrays; long ball-bar runs are block-averaged, single outliers left out and counted.

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


def _run_data(run: dict[str, Any], blocks: int) -> RunData:
    columns, setup, label = run["columns"], run["setup"], run["run_id"]
    if run["test"] not in TESTS:
        raise MeasurementFault(f"run {label}: test {run['test']!r} is not one this solver knows")
    if columns["deviation_mm"] is None:
        raise MeasurementFault(f"run {label}: it is sealed, its readings are not there", "it can only be predicted")
    axes = np.column_stack([np.asarray(columns[f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    valid = np.asarray(columns.get("valid", np.ones(len(axes)))).astype(bool)
    if int(valid.sum()) < LEAST:
        raise MeasurementFault(f"run {label}: only {int(valid.sum())} valid readings of {len(axes)}", "measure it again")
    common: dict[str, Any] = {
        "label": label,
        "setup": setup["setup_id"],
        "axes_mm": axes[valid],
        "deviation_mm": np.asarray(columns["deviation_mm"], dtype=np.float64)[valid],
        "sign": _signs(run, axes)[valid],
        "t_s": np.asarray(columns["t_s"], dtype=np.float64)[valid],
        "weight_n": np.ones(int(valid.sum())),
        "tool_mm": _tool(setup),
        "test": TESTS[run["test"]],
    }
    if run["test"].startswith("laser"):
        common["deviation_mm"] = _since_first(common["deviation_mm"], first_valid=bool(valid[0]))
        return RunData(kind="laser", **common, beam=beam_of(setup, label))
    centre = np.asarray(setup["centre_mm"], dtype=np.float64)
    common |= {"u_length_mm": setup.get("u_length_mm"), "length_calibrated": setup.get("length_calibrated")}
    return block_average(RunData(kind="bar", **common, centre_mm=centre, radius_mm=float(setup["radius_mm"])), blocks)


def _signs(run: dict[str, Any], axes_mm: F2) -> F2:
    """Direction of each axis' last move, shape (n, 3), from the rows with finite positions; NaN for the others, which are invalid."""
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


def _tool(setup: dict[str, Any]) -> F1 | None:
    """Tool of this run if its set-up states one, else None (the machine's own)."""
    tool = setup.get("tool_mm")
    return None if tool is None else np.asarray(tool, dtype=np.float64)


def beam_of(setup: dict[str, Any], label: str) -> F1:
    """Nominal beam as a unit vector: as stated, else from start to end of the test (of a ``laser_linear`` along its axis)."""
    if setup.get("nominal_beam") is not None:
        beam = np.asarray(setup["nominal_beam"], dtype=np.float64)
    else:
        beam = np.subtract(setup["end_mm"], setup["start_mm"]).astype(np.float64)
        if setup.get("axis") is not None:
            beam = beam * np.eye(3)["XYZ".index(setup["axis"])]
    length = float(np.linalg.norm(beam))
    if not (np.isfinite(length) and length > 0.0):
        raise ValueError(f"run {label}: a laser run needs a beam: nominal_beam, or start and end apart")
    return np.asarray(beam / length)


def bar_noise_mm(run: dict[str, Any]) -> float:
    """Standard deviation of one valid ball-bar reading, mm (`abbe.models.solvers.observations.reading_noise_mm`)."""
    columns = run["columns"]
    values = np.asarray(columns["deviation_mm"], dtype=np.float64)
    return reading_noise_mm(values[np.asarray(columns.get("valid", np.ones(values.size))).astype(bool)])
