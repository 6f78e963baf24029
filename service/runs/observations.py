"""Runs as arrays for the solvers: the only place where measured columns become `RunData`."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.geometry.chain import travel_sign
from models.solvers.observations import RunData, block_average
from service.errors import MeasurementFault

BLOCKS = 400
"""Values per ball-bar run that enter a solution: noise averages down, smooth errors stay."""


def run_data(run: dict[str, Any], *, blocks: int = BLOCKS) -> RunData:
    """Valid readings of an ``abbe-run/1`` object as arrays; long ball-bar runs are block-averaged.

    Raises
    ------
    MeasurementFault
        The run holds fewer than 10 valid readings, or its test is none that this solver knows.
    """
    columns, setup, label = run["columns"], run["setup"], run["run_id"]
    axes = np.column_stack([np.asarray(columns[f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    sign = travel_sign(axes)
    valid = np.asarray(columns.get("valid", np.ones(len(axes)))).astype(bool)
    if int(valid.sum()) < 10:
        raise MeasurementFault(f"run {label}: only {int(valid.sum())} valid readings of {len(axes)}", "measure it again")
    deviation = np.asarray(columns["deviation_mm"], dtype=np.float64)[valid]
    common: dict[str, Any] = {
        "axes_mm": axes[valid],
        "deviation_mm": deviation,
        "sign": sign[valid],
        "t_s": np.asarray(columns["t_s"], dtype=np.float64)[valid],
        "weight_n": np.ones(int(valid.sum())),
        "tool_mm": _tool(setup),
    }
    if run["test"] in ("ballbar_helix", "ballbar_circle"):
        centre = np.asarray(setup["centre_mm"], dtype=np.float64)
        common |= {"u_length_mm": setup.get("u_length_mm"), "length_calibrated": setup.get("length_calibrated")}
        bar = RunData(label, setup["setup_id"], "bar", **common, centre_mm=centre, radius_mm=float(setup["radius_mm"]))
        return block_average(bar, blocks)
    if run["test"] in ("laser_diagonal", "laser_linear"):
        return RunData(label, setup["setup_id"], "laser", **common, beam=_beam(run))
    raise MeasurementFault(f"run {label}: test {run['test']!r} is not one this solver knows")


def _tool(setup: dict[str, Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None:
    """Tool of this run if its set-up names one, else None (the machine's own)."""
    tool = setup.get("tool_mm")
    return None if tool is None else np.asarray(tool, dtype=np.float64)


def _beam(run: dict[str, Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    setup = run["setup"]
    if "nominal_beam" in setup:
        beam = np.asarray(setup["nominal_beam"], dtype=np.float64)
    else:
        beam = np.eye(3)["XYZ".index(setup["axis"])] * np.sign(float(np.sum(np.subtract(setup["end_mm"], setup["start_mm"]))))
    return np.asarray(beam / np.linalg.norm(beam))


def bar_noise_mm(run: dict[str, Any]) -> float:
    """Standard deviation of one ball-bar reading, from second differences of neighbours (robust; smooth motion cancels)."""
    values = np.asarray(run["columns"]["deviation_mm"], dtype=np.float64)
    second = values[2:] - 2 * values[1:-1] + values[:-2]
    if second.size == 0:
        return 0.0
    return float(np.median(np.abs(second - np.median(second))) * 1.4826 / np.sqrt(6.0))
