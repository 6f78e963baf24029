"""Runs that were never fitted, where nothing is missing in the fitted ones: which of them disagree by more than chance."""

from __future__ import annotations

from abbe.models.discovery.answer import Agreement
from abbe.service.domain.finding import Finding

ALARM = 0.01
"""Of campaigns in which nothing is missing so many give an alarm, over all their runs together."""
SHOWN = 4
"""Runs that are named; the others are counted."""


def disagreeing(finding: Finding) -> list[Agreement]:
    """Never fitted runs that are farther off than noise and prediction allow, the worst first (`abbe.models.discovery.agreement`)."""
    return [a for a in finding.agreement if a.p < ALARM]


def nothing_missing(finding: Finding) -> str:
    """What is explained where nothing is missing in the fitted runs: the runs that were never fitted too, or which of them not."""
    off, open_ = disagreeing(finding), _unjudged(finding)
    if not off and not open_:
        return "the present model explains all runs to their noise"
    text = "the present model explains the fitted runs to their noise"
    if off:
        runs = _few([f"{a.run} {a.times:.2g} times" for a in off])
        text += (
            f"; of the runs that were never fitted {runs} what noise and the prediction's own uncertainty allow "
            f"(chance gives as much in {off[0].p:.1g} of such campaigns)"
        )
    return text + open_


def _unjudged(finding: Finding) -> str:
    """Runs that were never fitted and that nothing could be said of, by the reason why; empty where there are none."""
    by_reason: dict[str, list[str]] = {}
    for u in finding.unjudged:
        by_reason.setdefault(u.why, []).append(u.run)
    return "".join(f"; not judged, for {why}: {_few(runs)}" for why, runs in by_reason.items())


def _few(runs: list[str]) -> str:
    """The first of them, and how many more there are."""
    return ", ".join(runs[:SHOWN]) + (f" and {len(runs) - SHOWN} more" if len(runs) > SHOWN else "")
