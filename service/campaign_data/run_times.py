"""Check that the times of a run are seconds of the campaign's clock, against its own feed and against the other runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.service.campaign_data.campaign_issue import CampaignIssue
from abbe.service.domain.run import Run

FASTEST = 0.2
"""Least ratio of a run's duration to path length over feed: the programmed feed is the upper limit."""
SLOWEST = {"ballbar": 10.0, "laser": 200.0}
"""Largest ratio of a run's duration to path length over feed: a ball-bar run moves steadily, a laser run stops at every point."""
OVERLAP = 0.1
"""Largest allowed overlap of two runs as a share of the shorter one: clocks are not set to the second."""
UNITS = {1e3: "t_s holds ms", 1.0 / 60.0: "t_s holds minutes"}


def time_issues(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Flags of runs whose clocks disagree, whose t_s does not fit their feed, or which overlap other runs."""
    out = [f for run in runs for f in (*_clocks(run), *_against_feed(run))]
    known = {f.run for f in out}
    return out + _overlaps([r for r in runs if r.run_id not in known])


def _clocks(run: Run) -> list[CampaignIssue]:
    """The disagreement of a run's clocks, if any (`abbe.service.runs.clocks`)."""
    trouble = run.timing.trouble
    return [CampaignIssue(run.run_id, trouble, "look at the sync cable and the links, then measure it again", False)] if trouble else []


def _against_feed(run: Run) -> list[CampaignIssue]:
    points, t, feed = run.columns.q_mm, run.columns.t_s, run.columns.feed_mm_min
    if len(points) < 2 or not all(np.isfinite(v).all() for v in (points, t, feed)) or feed.min() <= 0.0:
        return []
    wanted = float((np.linalg.norm(np.diff(points, axis=0), axis=1) * 60.0 / feed[1:]).sum())
    if wanted <= 0.0:
        return []
    waited = np.sort(np.diff(t))[::-1][: len(run.timing.pieces)].sum()  # pauses between the pieces of a path
    ratio, slowest = float(t[-1] - t[0] - waited) / wanted, SLOWEST["ballbar" if run.is_bar else "laser"]
    if FASTEST <= ratio <= slowest:
        return []
    unit = next((text for factor, text in UNITS.items() if FASTEST <= ratio / factor <= slowest), "t_s or feed_mm_min is not what it says")
    what = f"it took {ratio:.2g} times as long as its path at its feed_mm_min: {unit}"
    return [
        CampaignIssue(run.run_id, what, "write t_s in s of the campaign's clock and feed_mm_min in mm/min: drift is judged by them", False)
    ]


def _overlaps(runs: Sequence[Run]) -> list[CampaignIssue]:
    """Runs whose times overlap; the run with the most overlaps is flagged and removed until none remains."""
    spans = {r.run_id: (float(r.columns.t_s[0]), float(r.columns.t_s[-1])) for r in runs if len(r.columns)}
    spans = {k: v for k, v in spans.items() if np.isfinite(v).all()}
    meets = {k: [m for m in spans if m != k and _share(spans[k], spans[m]) > OVERLAP] for k in spans}
    out = []
    while any(meets.values()):
        worst = max(meets, key=lambda k: len(meets[k]))
        others = meets.pop(worst)
        meets = {k: [m for m in v if m != worst] for k, v in meets.items()}
        what = f"its t_s lies within that of {_named(others)}: one machine cannot measure two runs at a time"
        out.append(CampaignIssue(worst, what, "write t_s in s of one clock for the whole campaign: drift is judged by it", False))
    if len(out) > 1 and 2 * len(out) >= len(spans):
        what = f"its t_s and those of {len(out)} other runs overlap: every run seems to have a clock of its own"
        return [CampaignIssue(next(iter(spans)), what, out[0].remedy, False)]
    return out


def _share(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Common time of two spans as a share of the shorter one."""
    shorter = min(a[1] - a[0], b[1] - b[0])
    return (min(a[1], b[1]) - max(a[0], b[0])) / shorter if shorter > 0.0 else 0.0


def _named(others: list[str]) -> str:
    return f"run {others[0]}" if len(others) == 1 else f"{len(others)} other runs ({others[0]}, ...)"
