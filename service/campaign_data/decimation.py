"""Long campaigns become shorter ones: means of neighbouring ball-bar readings, so that a search takes seconds and not minutes."""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.service.domain.discovery_file import FoundThinning

MOST_READINGS = 20000
"""Ball-bar readings of a campaign that are searched one by one; more become means of so many neighbours that about as many are left."""
FEWEST = 3
"""A run of fewer blocks stays as it is: one or two values would say nothing of its path."""
GAP = 1.5
"""A block that takes this much longer than usual has lost readings."""
STILL_MM = 1e-6
"""An axis that moves less than this from reading to reading stands."""


def lines_of(made: FoundThinning) -> tuple[str, ...]:
    """For people: what was done to long runs, what therefore could not be seen, what to do about it."""
    each, means = made.readings_per_value, made.how == "means"
    became = f"every {each} of them became one mean" if means else f"of every {each} one was looked at, as it was read"
    done = f"{made.readings} ball-bar readings are more than are searched one by one: {became}, {made.kept} values in all"
    hidden = f"what that hides could not be seen, which does not say that it is absent: {'; '.join(made.not_seen)}"
    return (done, hidden, REMEDY) if means else (done, hidden)


def _not_seen(*, each: int, means: bool, interval_s: float, turning: int) -> list[str]:
    """What the shorter runs cannot show, one sentence each.

    ``each``: readings that one value stands for; ``interval_s``: from value to value; ``turning``: values in whose readings an axis turns.
    """
    highest_hz = 0.5 / interval_s  # Nyquist
    if means:
        # A spike of one interval lies across two values as a rule; one of two fills a value wherever it begins.
        spikes = f"a spike at a reversal keeps its height from {2.0 * interval_s:.2g} s on, one of a single reading is 1/{each} as high"
        sides = f"in {turning} means an axis turns round, and both sides of its lost motion are mixed there"
        fast = f"vibration above {highest_hz:.2g} Hz is averaged down, or looks like a slower one"
    else:
        spikes = f"a spike at a reversal that lasts less than {interval_s:.2g} s may lie between two values"
        sides = f"{turning} values stand for readings in which an axis turns round; how it loses motion there is not seen"
        fast = f"vibration above {highest_hz:.2g} Hz looks like a slower one, or like noise"
    return [spikes, sides, fast]


REMEDY = f"to see it, search fewer runs (--without RUN): up to {MOST_READINGS} ball-bar readings are searched as they were read"


def thinning(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> FoundThinning | None:
    """What `thinned` or `picked` did to runs; None if nothing.

    Parameters
    ----------
    before, after : list of dict
        The same runs in the same order.
    """
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if _measured_bar(b)]
    changed = [(b, a) for b, a in pairs if len(a["columns"]["t_s"]) < len(b["columns"]["t_s"])]
    if not changed:
        return None
    readings, kept = (sum(len(r["columns"]["t_s"]) for r in some) for some in zip(*pairs, strict=True))
    interval = float(np.median(np.concatenate([np.diff(a["columns"]["t_s"]) for _, a in changed])))
    means = any(not np.isin(_finite(a), _finite(b)).all() for b, a in changed)
    each = -(-readings // MOST_READINGS) if means else _step(*changed[0])
    turning = sum(_turning(b, each) for b, _ in changed)
    return FoundThinning(
        readings=readings,
        kept=kept,
        readings_per_value=each,
        how="means" if means else "picked",
        interval_s=interval,
        highest_hz=0.5 / interval,
        values_with_reversal=turning,
        not_seen=_not_seen(each=each, means=means, interval_s=interval, turning=turning),
    )


def _step(before: dict[str, Any], after: dict[str, Any]) -> int:
    """Readings from one value that was picked to the next."""
    first, second = np.searchsorted(before["columns"]["t_s"], after["columns"]["t_s"][:2])
    return int(second - first)


def _finite(run: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Readings that are numbers; a flagged one need not be."""
    values = np.asarray(run["columns"]["deviation_mm"], dtype=np.float64)
    return np.asarray(values[np.isfinite(values)])


def _turning(run: dict[str, Any], each: int) -> int:
    """Blocks of so many readings inside which an axis turns round."""
    inside: set[int] = set()
    for axis in "xyz":
        step = np.diff(np.asarray(run["columns"][f"{axis}_mm"], dtype=np.float64))
        moving = np.flatnonzero(np.abs(step) > STILL_MM)
        turns = np.flatnonzero(np.diff(np.sign(step[moving])) != 0)
        inside |= {int(k) // each for k in moving[turns + 1]}
    return len(inside)


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
    the noise then looks like nothing that has a formula. A run shorter than `FEWEST` blocks stays as it is.
    """
    total = sum(len(r["columns"]["t_s"]) for r in runs if _measured_bar(r))
    block = -(-total // most)
    return runs if block <= 1 else [_picks(r, block) if _measured_bar(r) else r for r in runs]


def _picks(run: dict[str, Any], block: int) -> dict[str, Any]:
    if len(run["columns"]["t_s"]) < FEWEST * block:
        return run
    return run | {"columns": {k: v if v is None else v[block // 2 :: block] for k, v in run["columns"].items()}}


def _measured_bar(run: dict[str, Any]) -> bool:
    return run["test"].startswith("ballbar") and run["columns"]["deviation_mm"] is not None


def _means(run: dict[str, Any], block: int) -> dict[str, Any]:
    """One value a block, at its middle reading: the mean of what the readings are off the commanded points, put back there.

    The mean of points on a sphere lies inside it; a block with a gap in time is left out.
    """
    columns = run["columns"]
    count = len(columns["t_s"]) // block
    if count < FEWEST:
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
    off = np.where(weight > 0.0, off, 0.0)  # a flagged reading need not be a number
    out["deviation_mm"] = ((off * weight).sum(axis=1) / weight.sum(axis=1) + nominal[middle]).tolist()
    if "valid" in columns:
        out["valid"] = some.astype(int).tolist()
    return run | {"columns": out}


def _nominal_mm(run: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """What a perfect machine's bar would read at the commanded points, mm: a path of straight pieces runs a little inside its sphere."""
    q = np.column_stack([np.asarray(run["columns"][f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    away = np.linalg.norm(q - np.asarray(run["setup"]["centre_mm"], dtype=np.float64), axis=1)
    return np.asarray(away - float(run["setup"]["radius_mm"]))
