"""States of a discovery and their order: FITTED, SUSPICIOUS, PROPOSED, TESTING, EXPLAINED or UNEXPLAINED.

Pure functions from a finding to its steps. Every step states its reason and the rule of its decision.
If no effect is missing, `nothing_missing` gives the verdict, and names the runs outside the fit that disagree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from abbe.models.discovery.answer import Agreement
from abbe.service.domain.discovery import DiscoveryStep, Judgement, State
from abbe.service.domain.finding import EffectFound, Finding

FOLLOWS: dict[State | None, frozenset[State]] = {
    None: frozenset({"FITTED"}),
    "FITTED": frozenset({"SUSPICIOUS", "EXPLAINED"}),
    "SUSPICIOUS": frozenset({"PROPOSED", "UNEXPLAINED"}),
    "PROPOSED": frozenset({"TESTING"}),
    "TESTING": frozenset({"EXPLAINED", "UNEXPLAINED"}),
    "EXPLAINED": frozenset(),
    "UNEXPLAINED": frozenset(),
}
ENDS = frozenset({"EXPLAINED", "UNEXPLAINED"})
VISIBLE = 1.05
"""Smallest ratio of the gap without the effect to the noise floor at which holdout runs can judge; below it they do not show the effect."""
CLOSED = 0.5
"""Share of the gap (`GapUm.closed`) that must close on the holdout runs. A wrong effect closes it on the fitted runs only."""
SOME = 0.2
"""Smallest closed share of the gap that counts: a smaller share also closes by chance."""
LEFT = 1.5
"""Unproved effects explain a gap only if they leave less than this multiple of the noise. A smaller rest may be an error of the
prediction, so it does not refute an effect that makes the holdout runs agree better."""
FELT = 0.01
"""Smallest share by which one effect changes the rms of the holdout runs so that these runs can judge the effect."""
WORSE = 1.05
"""Largest ratio of the gap with the effect to the gap without it, in the runs of any role: a diverged solution is not a finding."""
NEAR = 3.0
"""Smallest lead in log evidence over every rival with which an effect enters the model book: twenty times as likely."""
NOT_CONFIRMED = "the holdout runs do not agree better with the effect than without it"


def after_fit(finding: Finding) -> Iterator[DiscoveryStep]:
    """Yield the steps after FITTED, to the end; the first one carries the finding."""
    if finding.verdict == "none":
        yield DiscoveryStep(state="EXPLAINED", why=nothing_missing(finding), finding=finding)
        return
    why = "readings disagree with the present model by more than noise"
    yield DiscoveryStep(state="SUSPICIOUS", why=why, finding=finding)
    if not _names(finding):
        yield DiscoveryStep(state="UNEXPLAINED", why=finding.doubt or "nothing in the catalogue explains the gap")
        return
    yield DiscoveryStep(state="PROPOSED", why="these effects have the best evidence, with all rivals refitted")
    judged = judge(finding)
    yield DiscoveryStep(state="TESTING", why=judged.rule, judged=judged)
    yield ending(finding, judged)


def ending(finding: Finding, judged: Judgement) -> DiscoveryStep:
    """Return the last step: whether the judged effects explain the gap."""
    if judged.proved is False:
        return DiscoveryStep(state="UNEXPLAINED", why=judged.against, judged=judged)
    if finding.verdict == "unknown":
        return DiscoveryStep(state="UNEXPLAINED", why="the named effects leave a gap that the catalogue does not explain")
    closes = "the gap closes" + (" on runs that were never fitted" if judged.proved else ", judged by evidence alone")
    kept_out = not_entered(finding, judged)
    why = closes if kept_out is None else f"{closes}; not added to the model book: {kept_out}"
    return DiscoveryStep(state="EXPLAINED", why=why, not_added=kept_out)


def not_entered(finding: Finding, judged: Judgement) -> str | None:
    """Return the reason to keep a finding out of the model book; None if it is proved, needed and without close rivals."""
    if judged.proved is not True:
        return f"it is not proved: {judged.rule}"
    if finding.beside:
        return f"part of the gap is closed by a structure that the catalogue does not name ({finding.beside[0].label.replace('_', ' ')})"
    for e in entering(finding):
        if e.needed is not None and e.needed <= 1.0:
            return f"the holdout runs do not need {e.label}"
        near = next((rival for rival in e.alternatives if rival.less_evidence < NEAR), None)
        if near is not None:
            return f"these runs hardly separate {e.label} from {near.label}"
    return None


def with_proof(finding: Finding) -> Finding:
    """Add the result of the holdout runs to a finding. Effects that they refute become suspects; the verdict is then "unknown"."""
    if not finding.effects:
        return finding
    judged = judge(finding)
    proved = judged.proved is True
    effects = tuple(replace(e, proved=proved and e.kind == "mean" and (e.needed is None or e.needed > 1.0)) for e in finding.effects)
    if judged.proved is not False:
        return replace(finding, proved=proved, proof=judged.rule, effects=effects)
    rejected = tuple((e.label, f"suspected only: {judged.against}") for e in effects)
    return replace(
        finding,
        verdict="unknown",
        confounded_with=(),
        proof=judged.against,
        effects=(),
        suspects=effects,
        rejected=(*rejected, *finding.rejected),
    )


def _names(finding: Finding) -> tuple[EffectFound, ...]:
    """Return the named effects, or those that `with_proof` turned into suspects."""
    return finding.effects or finding.suspects


def entering(finding: Finding) -> tuple[EffectFound, ...]:
    """Return the effects that can be proved because they shift readings; effects that only add scatter close no gap."""
    return tuple(e for e in finding.effects if e.kind == "mean")


def judge(finding: Finding) -> Judgement:
    """Judge by the holdout runs how much of the gap closes, and whether that proves the finding.

    If they cannot judge, effects that leave a gap above `LEFT` times the noise in the fitted runs are rejected.
    """
    moving = any(e.kind == "mean" for e in _names(finding))
    found = _judged(finding, moving=moving)
    fitted = finding.gaps.get("identify")
    if found.proved is None and moving and fitted is not None and fitted.after_um > LEFT * fitted.floor_um:
        times = fitted.after_um / fitted.floor_um
        against = f"{found.rule}, and even with the effect the fitted runs deviate by {times:.2g} times the noise"
        return replace(found, proved=False, against=against)
    return replace(found, against=NOT_CONFIRMED) if found.proved is False else found


def _judged(finding: Finding, *, moving: bool) -> Judgement:
    worse = [role for role, g in finding.gaps.items() if g.after_um > WORSE * max(g.before_um, g.floor_um)]
    if worse:
        return Judgement(rule=f"the {worse[0]} runs agree worse with the effect than without it", proved=False)
    gap = finding.gaps.get("holdout")
    if gap is None:
        return Judgement(rule="no holdout run of this campaign can judge", proved=None)
    share = gap.closed
    if gap.before_um <= VISIBLE * gap.floor_um or share is None:
        return Judgement(rule="the gap does not show in the holdout runs", proved=None, closed=share, gap=gap)
    if not moving:
        rule = "an effect that only adds scatter closes no gap: judged by evidence alone"
        return Judgement(rule=rule, proved=None, closed=share, gap=gap)
    needed = [e.needed for e in _names(finding) if e.kind == "mean" and e.needed is not None]
    unfelt = bool(needed) and max(abs(n - 1.0) for n in needed) < FELT
    if share < CLOSED and unfelt and gap.after_um < LEFT * gap.floor_um:
        return Judgement(rule="the effect hardly changes the readings of the holdout runs", proved=None, closed=share, gap=gap)
    if SOME <= share < CLOSED and gap.after_um < LEFT * gap.floor_um:
        return Judgement(
            rule="the holdout runs agree better with the effect, but show too little of the gap", proved=None, closed=share, gap=gap
        )
    rule = f"at least {CLOSED:.0%} of the gap closes on the holdout runs"
    return Judgement(rule=rule, proved=share >= CLOSED, closed=share, gap=gap)


ALARM = 0.01
"""False alarm rate per campaign, over all its runs together."""
SHOWN = 4
"""Number of runs that are listed by name; the others are counted."""


def disagreeing(finding: Finding) -> list[Agreement]:
    """Return the runs outside the fit that deviate by more than noise and prediction allow, worst first."""
    return [a for a in finding.agreement if a.p < ALARM]


def nothing_missing(finding: Finding) -> str:
    """Return the verdict on a finding without missing effects; it names the runs outside the fit that disagree or were not judged."""
    off, open_ = disagreeing(finding), _unjudged(finding)
    if not off and not open_:
        return "the present model explains all runs to their noise"
    text = "the present model explains the fitted runs to their noise"
    if off:
        runs = _few([f"{a.run} {a.times:.2g} times" for a in off])
        text += (
            f"; runs that were never fitted deviate by more than noise and the uncertainty of the prediction allow: {runs} the allowed rms "
            f"(by chance this happens in a share of {off[0].p:.1g} of such campaigns)"
        )
    return text + open_


def _unjudged(finding: Finding) -> str:
    """List the runs outside the fit that could not be judged, grouped by reason; empty if all were judged."""
    by_reason: dict[str, list[str]] = {}
    for u in finding.unjudged:
        by_reason.setdefault(u.why, []).append(u.run)
    return "".join(f"; not judged, for {why}: {_few(runs)}" for why, runs in by_reason.items())


def _few(runs: list[str]) -> str:
    """List the first `SHOWN` runs and the number of the others."""
    return ", ".join(runs[:SHOWN]) + (f" and {len(runs) - SHOWN} more" if len(runs) > SHOWN else "")
