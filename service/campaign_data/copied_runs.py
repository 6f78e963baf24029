"""Does a run stand in a campaign twice? One measurement that counts twice makes everything look better known than it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.service.campaign_data.campaign_issue import CampaignIssue

Doc = dict[str, Any]
COPIED_SHARE = 0.98
"""Runs share no more readings than this, positions included, unless one is a copy: noise differs every time."""
VISIBLE_STEPS = 2.0
"""Noise shows where neighbours bend by more of the sensor's steps than this, rms: rounding alone makes them bend by 0.7."""
NOTHING_MM = 1e-9
STATE = ("x_mm", "y_mm", "z_mm", "direction")


def copies(runs: Sequence[Doc]) -> list[CampaignIssue]:
    """Runs whose readings stand in another run already, whatever they are called.

    Where the readings show noise, alike readings are a copy whenever they are said to be measured. A coarse sensor shows none, and repeats
    of it are alike: there a copy has the same times, too.
    """
    rows = [_rows(r) for r in runs]
    out = []
    for k, run in enumerate(runs):
        for j in range(k):
            if _copied(rows[j], rows[k]) and (_shows_noise(run) or _copied(_timed(runs[j], rows[j]), _timed(run, rows[k]))):
                what = f"its readings are those of run {runs[j]['run_id']}: one measurement would count twice"
                out.append(CampaignIssue(run["run_id"], what, "leave it out (--without), or export it again", True))
                break
    return out


def _copied(one: Counter[Any], other: Counter[Any]) -> bool:
    """Whether nearly all rows of the shorter one stand in the other, each as often."""
    shorter = min(one.total(), other.total())
    return shorter > 0 and (one & other).total() >= COPIED_SHARE * shorter


def _rows(run: Doc) -> Counter[Any]:
    """Position and deviation of every reading, 10 nm and 0.01 nm; none for a run whose deviations are all the same."""
    y = _column(run, "deviation_mm")
    if y.size == 0 or not np.isfinite(y).all() or float(np.ptp(y)) == 0.0:
        return Counter()
    steps = ((y, 1e8), *((_column(run, c), 1e5) for c in ("x_mm", "y_mm", "z_mm")))
    return Counter(zip(*(np.rint(v * n).tolist() for v, n in steps), strict=True))


def _timed(run: Doc, rows: Counter[Any]) -> Counter[Any]:
    """The same with the time of every reading, ms."""
    return Counter(zip(np.rint(_column(run, "t_s") * 1e3).tolist(), _column(run, "deviation_mm").tolist(), strict=True)) if rows else rows


def _shows_noise(run: Doc) -> bool:
    """Whether two measurements of this run could be told apart by their noise: places that it visits again read otherwise, or, where it
    visits none again, neighbouring readings bend by more than rounding makes them."""
    y, states = _column(run, "deviation_mm"), zip(*(_column(run, c).tolist() for c in STATE), strict=True)
    places: dict[Any, list[float]] = {}
    for state, v in zip(states, y.tolist(), strict=True):
        places.setdefault(state, []).append(v)
    again = np.concatenate([np.diff(v) for v in places.values()])
    if again.size >= max(4, y.size // 4):
        return bool(np.mean(np.abs(again) > NOTHING_MM) > 0.5)
    steps = np.diff(np.unique(y))
    steps = steps[steps > NOTHING_MM]
    return bool(y.size > 2 and steps.size and np.sqrt(np.mean(np.diff(y, 2) ** 2)) > VISIBLE_STEPS * steps.min())


def _column(run: Doc, name: str) -> F1:
    return np.asarray(run["columns"][name], dtype=np.float64)
