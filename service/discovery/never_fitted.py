"""Runs that were never fitted, where nothing is missing in the fitted ones: which of them disagree by more than chance."""

from __future__ import annotations

from typing import Any

ALARM = 0.01
"""Of campaigns in which nothing is missing so many give an alarm, over all their runs together."""
SHOWN = 4
"""Runs that are told by name."""


def disagreeing(finding: dict[str, Any]) -> list[dict[str, Any]]:
    """Never fitted runs that are farther off than noise and prediction allow, the worst first (`abbe.models.discovery.agreement`)."""
    return [a for a in finding.get("agreement", []) if a["p"] < ALARM]


def told_missing(finding: dict[str, Any]) -> str:
    """What is explained where nothing is missing in the fitted runs: the runs that were never fitted too, or which of them not."""
    off, open_ = disagreeing(finding), _unjudged(finding)
    if not off and not open_:
        return "the present model explains all runs to their noise"
    told = "the present model explains the fitted runs to their noise"
    if off:
        runs = _few([f"{a['run']} {a['times']:.2g} times" for a in off])
        told += (
            f"; of the runs that were never fitted {runs} what noise and the prediction's own uncertainty allow "
            f"(chance gives as much in {off[0]['p']:.1g} of such campaigns)"
        )
    return told + open_


def _unjudged(finding: dict[str, Any]) -> str:
    """Runs that were never fitted and that nothing could be said of, by the reason why; empty where there are none."""
    by_reason: dict[str, list[str]] = {}
    for u in finding.get("unjudged", []):
        by_reason.setdefault(u["why"], []).append(u["run"])
    return "".join(f"; not judged, for {why}: {_few(runs)}" for why, runs in by_reason.items())


def _few(told: list[str]) -> str:
    """The first of them, and how many more there are."""
    return ", ".join(told[:SHOWN]) + (f" and {len(told) - SHOWN} more" if len(told) > SHOWN else "")
