"""Find runs outside the fit that deviate by more than chance, although the fitted runs show no missing effect."""

from __future__ import annotations

from abbe.models.discovery.answer import Agreement
from abbe.service.domain.finding import Finding

ALARM = 0.01
"""False alarm rate per campaign, over all its runs together."""
SHOWN = 4
"""Number of runs that are listed by name; the others are counted."""


def disagreeing(finding: Finding) -> list[Agreement]:
    """Return the runs outside the fit that deviate by more than noise and prediction allow, worst first."""
    return [a for a in finding.agreement if a.p < ALARM]


def nothing_missing(finding: Finding) -> str:
    """Return the verdict on a finding without missing effects; it names other runs that disagree or could not be judged."""
    off, open_ = disagreeing(finding), _unjudged(finding)
    if not off and not open_:
        return "the present model explains all runs to their noise"
    text = "the present model explains the fitted runs to their noise"
    if off:
        runs = _few([f"{a.run} {a.times:.2g} times" for a in off])
        text += (
            f"; runs that were never fitted deviate by more than noise and the uncertainty of the prediction allow: {runs} as much "
            f"(by chance this happens in a share of {off[0].p:.1g} of such campaigns)"
        )
    return text + open_


def _unjudged(finding: Finding) -> str:
    """List the runs outside the fit that could not be judged, grouped by reason; empty without any."""
    by_reason: dict[str, list[str]] = {}
    for u in finding.unjudged:
        by_reason.setdefault(u.why, []).append(u.run)
    return "".join(f"; not judged, for {why}: {_few(runs)}" for why, runs in by_reason.items())


def _few(runs: list[str]) -> str:
    """List the first `SHOWN` runs and the number of the others."""
    return ", ".join(runs[:SHOWN]) + (f" and {len(runs) - SHOWN} more" if len(runs) > SHOWN else "")
