"""Runs that were never fitted, where nothing is missing in the fitted ones: which of them disagree by more than chance."""

from __future__ import annotations

from typing import Any

ALARM = 0.01
"""Of campaigns in which nothing is missing so many give an alarm, over all their runs together."""
SHOWN = 4
"""Runs that are told by name."""


def disagreeing(finding: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs that were never fitted and are farther off than noise and prediction allow, the worst first (`models.discovery.agreement`)."""
    return [a for a in finding.get("agreement", []) if a["p"] < ALARM]


def unjudged(finding: dict[str, Any]) -> list[str]:
    """Runs that were never fitted and that nothing could be said of: the noise of their instrument is not known."""
    judged = {a["run"] for a in finding.get("agreement", [])}
    return [
        label for label, r in finding.get("runs", {}).items() if r["role"] == "holdout" and "rms_before_um" in r and label not in judged
    ]


def told_missing(finding: dict[str, Any]) -> str:
    """What is explained where nothing is missing in the fitted runs: the runs that were never fitted too, or which of them not."""
    off, open_ = disagreeing(finding), unjudged(finding)
    if not off and open_:
        more = f" and {len(open_) - SHOWN} more" if len(open_) > SHOWN else ""
        names = ", ".join(open_[:SHOWN]) + more
        return f"the present model explains the fitted runs to their noise; not judged, for their noise is not known: {names}"
    if not off:
        return "the present model explains all runs to their noise"
    runs = ", ".join(f"{a['run']} {a['times']:.2g} times" for a in off[:SHOWN]) + (
        f" and {len(off) - SHOWN} more" if len(off) > SHOWN else ""
    )
    return (
        f"the present model explains the fitted runs to their noise; of the runs that were never fitted {runs} what noise and the "
        f"prediction's own uncertainty allow (chance gives as much in {off[0]['p']:.1g} of such campaigns)"
    )
