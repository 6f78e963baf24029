"""Find runs that occur in a campaign twice. A measurement that counts twice makes the uncertainty look too small."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from abbe.service.campaign_data.campaign_issue import CampaignIssue
from abbe.service.domain.run import Run

COPIED_SHARE = 0.98
"""Share of equal readings, positions included, from which a run is a copy: noise differs every time."""
VISIBLE_STEPS = 2.0
"""Rms second difference of the readings, in sensor steps, above which they show noise: rounding alone gives 0.7."""
NOTHING_MM = 1e-9


def copy_issues(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Issues of runs whose readings occur in an earlier run, regardless of their labels.

    If the readings show noise, equal readings are a copy whatever their times. Repeats with a coarse sensor can be equal without noise:
    there a copy must also have the same times.
    """
    rows = [_rows(r) for r in runs]
    out = []
    for k, run in enumerate(runs):
        for j in range(k):
            if _copied(rows[j], rows[k]) and (_shows_noise(run) or _copied(_timed(runs[j], rows[j]), _timed(run, rows[k]))):
                what = f"its readings are those of run {runs[j].run_id}: one measurement would count twice"
                out.append(CampaignIssue(run.run_id, what, "leave it out (--without), or export it again", True))
                break
    return out


def _copied(one: Counter[Any], other: Counter[Any]) -> bool:
    """Whether nearly all rows of the shorter one occur in the other, equally often."""
    shorter = min(one.total(), other.total())
    return shorter > 0 and (one & other).total() >= COPIED_SHARE * shorter


def _rows(run: Run) -> Counter[Any]:
    """Position and deviation of every reading, in 10 nm and 0.01 nm; empty for a run with constant deviations."""
    y = run.columns.readings_mm
    if y.size == 0 or not np.isfinite(y).all() or float(np.ptp(y)) == 0.0:
        return Counter()
    steps = ((y, 1e8), *((along, 1e5) for along in run.columns.q_mm.T))
    return Counter(zip(*(np.rint(v * n).tolist() for v, n in steps), strict=True))


def _timed(run: Run, rows: Counter[Any]) -> Counter[Any]:
    """Time, ms, and deviation of every reading."""
    columns = run.columns
    return Counter(zip(np.rint(columns.t_s * 1e3).tolist(), columns.readings_mm.tolist(), strict=True)) if rows else rows


def _shows_noise(run: Run) -> bool:
    """Whether the readings show noise, so that a repeated measurement would differ: places visited again read differently, or, without
    repeated places, the second differences exceed those from rounding."""
    y, columns = run.columns.readings_mm, run.columns
    states = map(tuple, np.column_stack([columns.q_mm, columns.direction]).tolist())
    places: dict[Any, list[float]] = {}
    for state, v in zip(states, y.tolist(), strict=True):
        places.setdefault(state, []).append(v)
    again = np.concatenate([np.diff(v) for v in places.values()])
    if again.size >= max(4, y.size // 4):
        return bool(np.mean(np.abs(again) > NOTHING_MM) > 0.5)
    steps = np.diff(np.unique(y))
    steps = steps[steps > NOTHING_MM]
    return bool(y.size > 2 and steps.size and np.sqrt(np.mean(np.diff(y, 2) ** 2)) > VISIBLE_STEPS * steps.min())
