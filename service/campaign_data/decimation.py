"""Decimate long campaigns to means of neighbouring ball-bar readings, so that a search takes seconds instead of minutes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.discovery_file import FoundThinning
from abbe.service.domain.run import Run

MOST_READINGS = 20000
"""Largest number of ball-bar readings that a search takes unchanged; more are averaged in blocks until about this many remain."""
FEWEST = 3
"""A run of fewer blocks stays unchanged: one or two values would not describe its path."""
GAP = 1.5
"""A block that lasts longer than this multiple of the median duration lacks readings."""
STILL_MM = 1e-6
"""An axis that moves less than this from one reading to the next stands still."""


def lines_of(made: FoundThinning) -> tuple[str, ...]:
    """Describe the decimation: its size, the effects that it hides, and the remedy."""
    each, means = made.readings_per_value, made.how == "means"
    became = f"every {each} of them were averaged" if means else f"one of every {each} was used, unaveraged"
    done = f"{made.readings} ball-bar readings are too many to search one by one: {became}, {made.kept} values in all"
    hidden = f"effects hidden by this reduction may still be present: {'; '.join(made.unobservable)}"
    return (done, hidden, REMEDY) if means else (done, hidden)


def _unobservable(*, each: int, means: bool, interval_s: float, turning: int) -> list[str]:
    """Describe what the decimated runs cannot show, one sentence each."""
    highest_hz = 0.5 / interval_s  # Nyquist
    if means:
        # A spike as long as one interval usually spans two values; one as long as two intervals fills a value wherever it begins.
        spikes = (
            f"a spike at a reversal keeps its height if it lasts {2.0 * interval_s:.2g} s, "
            f"a spike of a single reading shrinks to 1/{each} of its height"
        )
        sides = f"{turning} averages span a reversal of an axis and mix both sides of its lost motion"
        fast = f"vibration above {highest_hz:.2g} Hz is averaged down, or looks like a slower vibration"
    else:
        spikes = f"a spike at a reversal that lasts less than {interval_s:.2g} s may lie between two values"
        sides = f"{turning} values replace readings in which an axis reverses; the lost motion there is not seen"
        fast = f"vibration above {highest_hz:.2g} Hz looks like a slower vibration, or like noise"
    return [spikes, sides, fast]


REMEDY = f"to see them, search fewer runs (--without RUN): up to {MOST_READINGS} ball-bar readings are searched without averaging"


def thinning(before: list[Run], after: list[Run]) -> FoundThinning | None:
    """Describe the effect of `thinned` or `picked`, given the same runs in the same order before and after; None if unchanged."""
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if _measured_bar(b)]
    changed = [(b, a) for b, a in pairs if len(a.columns) < len(b.columns)]
    if not changed:
        return None
    readings, kept = (sum(len(r.columns) for r in some) for some in zip(*pairs, strict=True))
    interval = float(np.median(np.concatenate([np.diff(a.columns.t_s) for _, a in changed])))
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
        not_seen=_unobservable(each=each, means=means, interval_s=interval, turning=turning),
    )


def _step(before: Run, after: Run) -> int:
    """Return the number of readings from one picked value to the next."""
    first, second = np.searchsorted(before.columns.t_s, after.columns.t_s[:2])
    return int(second - first)


def _finite(run: Run) -> F1:
    """Return the finite readings; a flagged reading may be NaN."""
    values = run.columns.readings_mm
    return np.asarray(values[np.isfinite(values)])


def _turning(run: Run, each: int) -> int:
    """Return the number of blocks of ``each`` readings inside which an axis reverses."""
    inside: set[int] = set()
    for step in np.diff(run.columns.q_mm, axis=0).T:
        moving = np.flatnonzero(np.abs(step) > STILL_MM)
        turns = np.flatnonzero(np.diff(np.sign(step[moving])) != 0)
        inside |= {int(k) // each for k in moving[turns + 1]}
    return len(inside)


def thinned(runs: list[Run]) -> list[Run]:
    """Average the runs so that a search can process their ball-bar readings.

    Every measured ball-bar run is averaged over the same number of neighbours, so that the noise of a value is the same in all of them.
    Laser runs have one reading per position and stay unchanged. So do sealed runs, because each of their readings is predicted. An
    incomplete block at the end of a run is dropped.
    """
    long = [r for r in runs if _measured_bar(r)]
    total = sum(len(r.columns) for r in long)
    block = -(-total // MOST_READINGS)
    return runs if block <= 1 else [_means(r, block) if _measured_bar(r) else r for r in runs]


def picked(runs: list[Run], most: int) -> list[Run]:
    """Pick about ``most`` measured ball-bar readings: the middle one of every block, unchanged.

    Means have less noise, but a mean over a reversal mixes both sides. Lost motion or friction well above the noise then matches no
    formula. A run shorter than `FEWEST` blocks stays unchanged.
    """
    total = sum(len(r.columns) for r in runs if _measured_bar(r))
    block = -(-total // most)
    return runs if block <= 1 else [_picks(r, block) if _measured_bar(r) else r for r in runs]


def _picks(run: Run, block: int) -> Run:
    if len(run.columns) < FEWEST * block:
        return run
    return replace(run, columns=run.columns.rows(slice(block // 2, None, block)))


def _measured_bar(run: Run) -> bool:
    return run.is_bar and not run.is_sealed


def _means(run: Run, block: int) -> Run:
    """Average each block to one value at its middle reading: the mean deviation from the nominal readings, plus the nominal reading there.

    A plain mean of points on a sphere would lie inside the sphere. A block with a gap in time is dropped.
    """
    columns = run.columns
    count = len(columns) // block
    if count < FEWEST:
        return run
    rows = np.arange(count * block).reshape(count, block)
    t = columns.t_s[rows]
    span = t[:, -1] - t[:, 0]
    rows = rows[span <= GAP * np.median(span)]
    middle = rows[:, block // 2]
    valid = columns.valid.astype(np.float64)[rows]
    some = valid.sum(axis=1) > 0
    weight = np.where(some[:, None], valid, 1.0)
    nominal = _nominal_mm(run)
    off = (columns.readings_mm - nominal)[rows]
    off = np.where(weight > 0.0, off, 0.0)  # a flagged reading may be NaN
    means = (off * weight).sum(axis=1) / weight.sum(axis=1) + nominal[middle]
    return replace(run, columns=replace(columns.rows(middle), deviation_mm=means, valid=some))


def _nominal_mm(run: Run) -> F1:
    """Return the readings of the bar on a perfect machine, mm: not zero, because a path of chords runs slightly inside its sphere."""
    away = np.linalg.norm(run.columns.q_mm - run.bar.centre_mm, axis=1)
    return np.asarray(away - run.bar.radius_mm)
