"""Text of a finding: what is missing, its size, the remedy, the alternatives, and what to measure next."""

from __future__ import annotations

import math

from abbe.models.discovery.answer import Localization, NextTest
from abbe.service.discovery.changed_text import changed_lines
from abbe.service.discovery.discovery_states import LEFT, disagreeing, entering, judge, not_entered, nothing_missing
from abbe.service.discovery.effect_pages import ADDS, unit
from abbe.service.domain.discovery import Judgement
from abbe.service.domain.finding import EffectFound, EffectSize, Finding, GapUm, ParameterFound
from abbe.service.effects.model_book import REMEDIES
from abbe.service.rendering.numbers import NOT_AVAILABLE, plain, with_uncertainty

AXES = "XYZ"
MANY = 6
CLEAR = 7.0
"""Difference in evidence (natural logarithm) above which a rival's odds are stated as a power of ten; 7 means one in a thousand."""
ROLES = {
    "identify": "fitted",
    "holdout": "never fitted, only judge",
    "sealed": "predicted only",
}


def size(effect: EffectSize) -> tuple[str, str, str]:
    """Return strength, U (k = 2) and unit of an effect as text."""
    value, expanded = with_uncertainty(effect.strength, effect.u_strength)
    return value, expanded, unit(effect.unit)


def size_text(effect: EffectSize) -> str:
    """Return strength, U (k = 2) and unit in one string: ``6.1 ± 0.2 µm``."""
    return _plus_minus(effect.strength, effect.u_strength, unit(effect.unit))


def verdict_of(finding: Finding) -> tuple[str, str, str]:
    """Return sign (ok, open or bad), headline and text of a finding."""
    sign, word, text = _verdict_of(finding)
    fitted = "; ".join(f"{f.name} of {f.key} {_plus_minus(f.value, f.u, unit(f.unit))}" for f in finding.fitted)
    return sign, word, f"{text} In the present model, as fitted: {fitted}." if fitted else text


def _verdict_of(finding: Finding) -> tuple[str, str, str]:
    gap = _gap_text(finding)
    if finding.verdict == "none":
        return _nothing_missing_verdict(finding, gap)
    if finding.doubt:
        return "bad", "The data look wrong", f"{_capital(finding.doubt)}. {_capital(gap)}. No effect was searched for."
    names = " and ".join(f"{e.full_title} {size_text(e)}" for e in finding.effects)
    if finding.verdict == "unknown":
        beside = f" Beside it: {names}." if names else _suspect_text(finding)
        there = "; ".join(location_lines(finding.location)) or "it could not be located"
        return "bad", "Something is missing that the catalogue does not explain", f"{_capital(gap)}. {there}.{beside}"
    judged = judge(finding)
    proof = _proof_text(judged) if judged.proved else f"{judged.rule}{_left_out_text(finding)}"
    word = "Found"
    if judged.proved is None and entering(finding):
        word = "Found, not proved"
    elif finding.beside:
        word = "Found, but a part has no name"
    if finding.confounded_with:
        word = "Found, but these runs cannot tell it from something else"
    left = _beside_text(finding) + _remainder_text(finding)
    sign = "ok" if word == "Found" and not left else "open"
    return sign, word, f"{names}. {_capital(gap)}; {proof}.{left}"


def _nothing_missing_verdict(finding: Finding, gap: str) -> tuple[str, str, str]:
    location = finding.location
    if location.tests and location.table and location == Localization(tests=location.tests, table=location.table):
        return "ok", "No common drift", _repeatability_text(finding)
    if disagreeing(finding):
        sign, word = "open", "Nothing is missing in the fitted runs, but other runs disagree"
    else:
        sign, word = "ok", "Nothing is missing"
    return sign, word, f"{_capital(nothing_missing(finding))}: {gap}."


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _beside_text(finding: Finding) -> str:
    """Warn that a name beside a structure without a name may belong to it; empty without such a structure."""
    if not finding.beside:
        return ""
    label = finding.beside[0].label.replace("_", " ")
    return f" The catalogue has no name for a part of the gap ({label}): what is named here may be a part of the same effect."


def _remainder_text(finding: Finding) -> str:
    """Return a note if the effects leave more than noise, else an empty text. Effects that only add scatter get no note."""
    gap = finding.gaps.get("identify")
    more = gap is not None and entering(finding) and gap.after_um > LEFT * gap.floor_um
    return " More than noise is left: something else is missing, too." if more else ""


def _proof_text(judged: Judgement) -> str:
    """Return how far the gap closed on the holdout runs, as text."""
    assert judged.gap is not None  # a proof needs a gap
    return f"also on runs that were never fitted, {_judging_text(judged.gap)}"


def _judging_text(gap: GapUm) -> str:
    """Return the gap before and after as text; ``gap``: of runs outside the fit, because a fit reduces the residuals of its own runs."""
    before, after, floor = _gap_values(gap)
    share = "" if gap.closed is None else f", {max(gap.closed, 0.0):.0%} closed"
    return f"from {before} to {after} µm rms (noise alone: {floor} µm{share})"


def _left_out_text(finding: Finding) -> str:
    """Tell how far the gap closed on blocks of runs that were left out in turn; empty where holdout runs judge."""
    if finding.left_out is None:
        return ""
    return f"; on blocks of runs left out of the fit in turn, but not of the choice of names, {_judging_text(finding.left_out)}"


def _suspect_text(finding: Finding) -> str:
    """List the effects that the holdout runs do not confirm; empty if there is no such effect."""
    names = " and ".join(f"{e.full_title} {size_text(e)}" for e in finding.suspects)
    judging = finding.gaps.get("holdout")
    figures = "" if judging is None else f" ({_judging_text(judging)})"
    return f" Suspected: {names}; but {finding.proof}{figures}{_left_out_text(finding)}." if names else ""


def _repeatability_text(finding: Finding) -> str:
    """Describe a positioning test without a common drift of its repeats: their scatter is the repeatability of axis and sensor."""
    test, gap = finding.location.table[0], finding.gaps["identify"]
    p = f"noise with the same correlation gives as much in {test.p:.1%} of tests"
    scatter = f"The repeats scatter by {plain(gap.before_um)} µm: that is repeatability, which no model can remove"
    return f"In these repeats a {test.value}; {p}. {scatter}."


def _gap_values(gap: GapUm) -> tuple[str, str, str]:
    return plain(gap.before_um), plain(gap.after_um), plain(gap.floor_um)


def _gap_text(finding: Finding) -> str:
    gap = finding.gaps.get("identify") or next(iter(finding.gaps.values()), None)
    if gap is None:
        return "no run could be judged"
    before, after, floor = _gap_values(gap)
    if finding.effects and not entering(finding):
        return f"readings scatter by {before} µm rms, more than the noise of {floor} µm, and no model can remove scatter"
    if not finding.effects:
        return f"the gap between measured and simulated is {before} µm rms (noise alone: {floor} µm)"
    return f"in the fitted runs the gap shrinks from {before} to {after} µm rms (noise alone: {floor} µm)"


def lines_of(finding: Finding) -> list[str]:
    """Return the verdict for the terminal, one fact per line."""
    _, word, text = verdict_of(finding)
    out = [f"{word}. {text}"]
    for e in finding.effects:
        out += effect_lines(e)
    if finding.confounded_with:
        out.append("these runs cannot tell the finding from: " + ", ".join(finding.confounded_with))
    return out + changed_lines(finding.changed) + book_lines(finding) + next_of(finding)


def book_lines(finding: Finding) -> list[str]:
    """Return why the named effects stay out of the model book; empty if they enter it."""
    why = not_entered(finding, judge(finding)) if finding.effects else None
    return [] if why is None else [f"not added to the model book: {why}"]


def effect_lines(effect: EffectFound) -> list[str]:
    """Describe one named effect: size, remedy, location, rivals."""
    lines = [f"{effect.full_title}: {size_text(effect)}"]
    lines += [f"  {name}: {parameter_text(p)}" for name, p in effect.parameters.items()]
    lines.append(f"  what to do: {effect.remedy_text} ({REMEDIES[effect.remedy]})")
    there = location_lines(effect.location)
    if there:
        lines.append("  where: " + "; ".join(there))
    if effect.sensor_doubt:
        lines.append(f"  look at the data: {effect.sensor_doubt}")
    lines.append("  what else it could be: " + "; ".join(rival_lines(effect)))
    return lines


def parameter_text(parameter: ParameterFound) -> str:
    """Return a non-linear parameter with its U (k = 2) and unit as text."""
    return _plus_minus(parameter.value, parameter.u, unit(parameter.unit)).rstrip()


def _plus_minus(value: float, u: float | None, what: str) -> str:
    """Return value and U (k = 2) as text; without U if it is unknown, as for a threshold picked from a grid."""
    text, expanded = with_uncertainty(value, u)
    return f"{text} {what}" if expanded == NOT_AVAILABLE else f"{text} ± {expanded} {what}"


def rival_lines(effect: EffectFound) -> list[str]:
    """List the alternatives with their odds; if there are none, say why."""
    if not effect.alternatives:
        moves = effect.kind == "mean"
        return ["nothing else in the catalogue fits these runs as well" if moves else "no rival was tried: scatter has no shape to compare"]
    return [f"{rival.title} ({_times(rival.less_evidence)})" for rival in effect.alternatives]


def _times(less: float) -> str:
    """Return the odds of a rival. Above `CLEAR` it is formally ruled out, but a slightly different form could explain the readings."""
    if less < 0.7:
        return "just as likely"
    if less < CLEAR:
        return f"{plain(math.exp(less), 2)} times less likely"
    return f"10^{less / math.log(10.0):.0f} times less likely, but a slightly different form of it would look the same"


def next_of(finding: Finding) -> list[str]:
    """Return the next measurement as text: a test that separates the suspects, else general advice."""
    if finding.doubt:
        without = " ".join(f"--without {run}" for run in finding.location.runs)
        return [f"do next: correct the files, or search without these runs: abbe discover {finding.case} {without}"]
    if finding.next_test is not None:
        return _next_lines(finding.next_test)
    if finding.verdict == "unknown":
        there = "; ".join(location_lines(finding.location))
        what = f"repeat the measurement where the gap appears ({there})" if there else "repeat the whole campaign: the gap was not located"
        return [
            f"measure next: {what}, and again later: a gap that recurs belongs to the machine, one that vanishes belongs to that session"
        ]
    if finding.verdict == "none":
        again = "measure next: repeat the runs that were never fitted and disagree, some of them with the role identify"
        return ([again] if disagreeing(finding) else []) + unseen_lines(finding)
    return [f"no available test tells the named effects from {', '.join(finding.confounded_with)}"] if finding.confounded_with else []


def _next_lines(test: NextTest) -> list[str]:
    """Describe the next test: purpose, duration and expected separation."""
    what = " and ".join(ADDS.get(a, a) for a in test.adds) or "no test is available"
    sigma = test.expected_separation_sigma
    well = "" if sigma is None else f", should tell them apart by {plain(sigma, 2)} sigma"
    between = f" to tell {' from '.join(test.separates)}" if test.separates else ""
    return [f"measure next: {what}{between} (about {test.minutes:.0f} min{well})"] + ([f"  {test.why}"] if test.why else [])


def unseen_lines(finding: Finding) -> list[str]:
    """List the effects that these runs could not show, and the measurement that would."""
    return [f"could not be seen: {u.what}, because {u.because}; what would show it: {ADDS.get(u.adds, u.adds)}" for u in finding.unseen]


def location_lines(location: Localization) -> list[str]:
    """Describe the location of an effect, one line per known property."""
    axes = () if len(location.axes) == len(AXES) else location.axes  # all three axes locate nothing
    out = [
        f"{label} {', '.join(found[:MANY])}" + (f" and {len(found) - MANY} more" if len(found) > MANY else "")
        for label, some in (("seen in", location.tests), ("axis", axes), ("run", location.runs), ("depends on", location.depends_on))
        if (found := [str(v).replace("_", " ") for v in some])
    ]
    if len(location.directions) == 1:
        out.append("only " + ("forward" if location.directions[0] > 0 else "backward"))
    if location.time_s is not None:
        out.append("from {:.0f} to {:.0f} s of the session".format(*location.time_s))
    if location.position_mm is not None:
        near = "" if location.radius_mm is None else f", within {plain(location.radius_mm)} mm"
        out.append("about X {:.0f}, Y {:.0f}, Z {:.0f} mm".format(*location.position_mm) + near)
    if location.shape:
        out.append(location.shape)
    every = ((location.period_s, "every {} s"), (location.period_mm, "every {} mm"), (location.angular_lobes, "{} lobes a turn"))
    return out + [text.format(plain(value)) for value, text in every if value is not None]
