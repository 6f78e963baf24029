"""Long campaigns become shorter ones: means of neighbouring ball-bar readings, so that a search takes seconds and not minutes."""

from __future__ import annotations

from typing import Any

import numpy as np

MOST_READINGS = 20000
"""Ball-bar readings of a campaign that are searched one by one; more become means of so many neighbours that about as many are left."""
GAP = 1.5
"""A block that takes this much longer than usual has lost readings."""


def thinned(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Runs with as many ball-bar readings as a search can hold.

    Every measured ball-bar run is averaged over the same number of neighbours, so that one reading's noise is alike in all of them. Laser
    runs have one reading a position and stay, sealed runs too: each of their readings is predicted. What is left at a run's end, less
    than a block, is not used.
    """
    long = [r for r in runs if _measured_bar(r)]
    total = sum(len(r["columns"]["t_s"]) for r in long)
    block = -(-total // MOST_READINGS)
    return runs if block <= 1 else [_means(r, block) if _measured_bar(r) else r for r in runs]


def picked(runs: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Runs with about ``most`` measured ball-bar readings, each as it was read: the middle one of every block.

    Means have less noise. But a mean over a turn of an axis is half of either side, and lost motion or friction that is large against
    the noise then looks like nothing that has a formula.
    """
    total = sum(len(r["columns"]["t_s"]) for r in runs if _measured_bar(r))
    block = -(-total // most)
    return runs if block <= 1 else [_picks(r, block) if _measured_bar(r) else r for r in runs]


def _picks(run: dict[str, Any], block: int) -> dict[str, Any]:
    return run | {"columns": {k: v if v is None else v[block // 2 :: block] for k, v in run["columns"].items()}}


def _measured_bar(run: dict[str, Any]) -> bool:
    return run["test"].startswith("ballbar") and run["columns"]["deviation_mm"] is not None


def _means(run: dict[str, Any], block: int) -> dict[str, Any]:
    """One value a block, at its middle reading: the mean of what the readings are off the commanded points, put back there.

    The mean of points on a sphere lies inside it; a block with a gap in time is left out.
    """
    columns = run["columns"]
    count = len(columns["t_s"]) // block
    if count < 3:
        return run
    rows = np.arange(count * block).reshape(count, block)
    t = np.asarray(columns["t_s"], dtype=np.float64)[rows]
    span = t[:, -1] - t[:, 0]
    rows = rows[span <= GAP * np.median(span)]
    middle = rows[:, block // 2]
    out = {name: np.asarray(values)[middle].tolist() for name, values in columns.items() if values is not None}
    valid = np.asarray(columns.get("valid", np.ones(len(columns["t_s"]))), dtype=np.float64)[rows]
    some = valid.sum(axis=1) > 0
    weight = np.where(some[:, None], valid, 1.0)
    nominal = _nominal_mm(run)
    off = (np.asarray(columns["deviation_mm"], dtype=np.float64) - nominal)[rows]
    out["deviation_mm"] = ((off * weight).sum(axis=1) / weight.sum(axis=1) + nominal[middle]).tolist()
    if "valid" in columns:
        out["valid"] = some.astype(int).tolist()
    return run | {"columns": out}


def _nominal_mm(run: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """What a perfect machine's bar would read at the commanded points, mm: a path of straight pieces runs a little inside its sphere."""
    q = np.column_stack([np.asarray(run["columns"][f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    away = np.linalg.norm(q - np.asarray(run["setup"]["centre_mm"], dtype=np.float64), axis=1)
    return np.asarray(away - float(run["setup"]["radius_mm"]))
