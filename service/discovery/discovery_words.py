"""A finding in words: what is missing, how large it is, what to do at the machine, what else it could be, what to measure next."""

from __future__ import annotations

import math
from typing import Any

from abbe.service.discovery.changed_words import changed_lines
from abbe.service.discovery.discovery_states import LEFT, closed, entering, judge, not_entered
from abbe.service.discovery.never_fitted import disagreeing, told_missing
from abbe.service.effects.model_book import REMEDIES, name_of
from abbe.service.rendering.numbers import NOT_AVAILABLE, plain, with_uncertainty

UNITS = {"um": "µm", "urad": "µrad", "": "", "1": "", "um/m": "µm/m"}
ADDS = {
    "second_feed": "the same path at a second feed",
    "opposite_direction": "the same path in the other direction",
    "second_radius": "a ball-bar of another length, or another centre",
    "planar_circles": "ball-bar circles in the three planes",
    "laser_diagonals": "laser step diagonals",
    "ballbar": "ball-bar runs",
    "single_axis_laser": "the laser along each axis",
    "angular_interferometer": "an angular interferometer on the axis",
    "second_tool_length": "the same runs with a second tool length",
    "longer_session": "a repeat late in the session",
    "reference_length": "a calibrated reference length",
}
AXES = "XYZ"
MANY = 6
CLEAR = 7.0
"""Evidence (natural logarithm) from which on a rival's chances are told as a power of ten: one in a thousand."""
ROLES = {
    "identify": "fitted",
    "holdout": "never fitted, only judge",
    "sealed": "predicted only",
}


def unit(text: str) -> str:
    """A unit of run-format.md 5 as people write it."""
    return UNITS.get(text, text)


def size(effect: dict[str, Any]) -> tuple[str, str, str]:
    """Strength, U (k = 2) and unit of an effect or a model's entry."""
    value, expanded = with_uncertainty(effect["strength"], effect["u_strength"])
    return value, expanded, unit(effect["unit"])


def size_text(effect: dict[str, Any]) -> str:
    """The same in one piece, ``6.1 ± 0.2 µm``."""
    return _plus_minus(effect["strength"], effect["u_strength"], unit(effect["unit"]))


def verdict_of(finding: dict[str, Any]) -> tuple[str, str, str]:
    """Sign, word and sentence of a finding."""
    sign, word, text = _verdict_of(finding)
    fitted = "; ".join(f"{f['name']} of {f['key']} {_plus_minus(f['value'], f['u'], unit(f['unit']))}" for f in finding.get("fitted", []))
    return sign, word, f"{text} In the present model, as fitted: {fitted}." if fitted else text


def _verdict_of(finding: dict[str, Any]) -> tuple[str, str, str]:
    gap = _gap_words(finding)
    judged = judge(finding)
    if finding["verdict"] == "none" and set(finding["where"]) == {"tests", "table"}:
        return "ok", "No common drift", _repeat_words(finding)
    if finding["verdict"] == "none":
        told = told_missing(finding)
        word = "Nothing is missing in the fitted runs, but the others do not agree" if disagreeing(finding) else "Nothing is missing"
        return "open" if disagreeing(finding) else "ok", word, f"{told[:1].upper()}{told[1:]}: {gap}."
    names = " and ".join(f"{name_of(e)} {size_text(e)}" for e in finding["effects"])
    if finding["verdict"] == "unknown":
        beside = f" Beside it: {names}." if names else _suspect_words(finding)
        there = "; ".join(where_lines(finding["where"])) or "it could not be located"
        return "bad", "Something is missing that the catalogue does not explain", f"{gap[0].upper()}{gap[1:]}. {there}.{beside}"
    proof = _proof_words(judged) if judged["proved"] else judged["rule"]
    word = "Found" if not finding["confounded_with"] else "Found, but these runs cannot tell it from something else"
    left = _left_words(finding)
    sign = "ok" if word == "Found" and not left else "open"
    return sign, word, f"{names}. {gap[0].upper()}{gap[1:]}; {proof}.{left}"


def _left_words(finding: dict[str, Any]) -> str:
    """That more than noise is left beside what was found; empty where it is not, or where readings scatter and no model takes it out."""
    gap = finding["gaps"].get("identify")
    more = gap is not None and entering(finding) and gap["after_um"] > LEFT * gap["floor_um"]
    return " More than noise is left: something else is missing, too." if more else ""


def _proof_words(judged: dict[str, Any]) -> str:
    """What closed on the runs that only judge: their own figures, not those of the fitted runs."""
    before, after = (plain(judged["gap"][k]) for k in ("before_um", "after_um"))
    return f"also on runs that were never fitted, from {before} to {after} µm rms ({judged['closed']:.0%} closed)"


def _suspect_words(finding: dict[str, Any]) -> str:
    """Names that were taken back; empty where there are none."""
    names = " and ".join(f"{name_of(e)} {size_text(e)}" for e in finding.get("suspects", []))
    return f" Suspected: {names}; but {finding['proof']}." if names else ""


def _repeat_words(finding: dict[str, Any]) -> str:
    """A positioning test whose repeats share no drift: their scatter is the axis's or the sensor's repeatability, whatever causes it."""
    told, gap = finding["where"]["table"][0], finding["gaps"]["identify"]
    p = f"noise with the same memory gives as much in {told['p']:.1%} of tests"
    scatter = f"They scatter by {plain(gap['before_um'])} µm: that is repeatability, which no model takes out"
    return f"In these repeats a {told['value']}; {p}. {scatter}."


def _gap_words(finding: dict[str, Any]) -> str:
    gap = finding["gaps"].get("identify") or next(iter(finding["gaps"].values()), None)
    if gap is None:
        return "no run could be judged"
    before, after, floor = (plain(gap[k]) for k in ("before_um", "after_um", "floor_um"))
    if finding["effects"] and not entering(finding):
        return f"readings scatter more than the noise of {floor} µm; {before} µm rms in all, and no model takes scatter out"
    if not finding["effects"]:
        return f"the gap between measured and simulated is {before} µm rms where {floor} µm is noise"
    share = closed(gap)
    return f"the gap shrinks from {before} to {after} µm rms where {floor} µm is noise" + (
        "" if share is None else f" ({share:.0%} closed)"
    )


def lines_of(finding: dict[str, Any]) -> list[str]:
    """The verdict for the terminal: one line a thing to know."""
    _, word, text = verdict_of(finding)
    out = [f"{word}. {text}"]
    for e in finding["effects"]:
        out += effect_lines(e)
    if finding["confounded_with"]:
        out.append("these runs cannot tell it from: " + ", ".join(finding["confounded_with"]))
    return out + changed_lines(finding) + book_lines(finding) + next_of(finding)


def book_lines(finding: dict[str, Any]) -> list[str]:
    """Why what was named does not enter the model book, where it does not."""
    why = not_entered(finding, judge(finding)) if finding["effects"] else None
    return [] if why is None else [f"not added to the model book: {why}"]


def effect_lines(effect: dict[str, Any]) -> list[str]:
    """One named effect: size, remedy, place, rivals."""
    told = [f"{name_of(effect)}: {size_text(effect)}"]
    told += [f"  {name}: {parameter_text(p)}" for name, p in effect["parameters"].items()]
    told.append(f"  what to do: {effect['remedy_text']} ({REMEDIES[effect['remedy']]})")
    there = where_lines(effect["where"])
    if there:
        told.append("  where: " + "; ".join(there))
    told.append("  what else it could be: " + "; ".join(rival_lines(effect)))
    return told


def parameter_text(parameter: dict[str, Any]) -> str:
    """A further parameter with its U."""
    return _plus_minus(parameter["value"], parameter.get("u"), unit(parameter["unit"])).rstrip()


def _plus_minus(value: float, u: float | None, what: str) -> str:
    """Value and U (k = 2) where one is known; a threshold that only the place in a list tells has none."""
    told, expanded = with_uncertainty(value, u)
    return f"{told} {what}" if expanded == NOT_AVAILABLE else f"{told} ± {expanded} {what}"


def rival_lines(effect: dict[str, Any]) -> list[str]:
    """What else it could be, each with how much less evidence it has; where nothing, why."""
    if not effect["alternatives"]:
        moves = effect["kind"] == "mean"
        return ["nothing else in the catalogue fits these runs as well" if moves else "no rival was tried: scatter has no shape to compare"]
    return [f"{a['title']} ({_times(a['less_evidence'])})" for a in effect["alternatives"]]


def _times(less: float) -> str:
    """A rival's chances. Where evidence is large, one that explains nearly all of it is formally hopeless, and yet a bent form would do."""
    if less < 0.7:
        return "just as likely"
    if less < CLEAR:
        return f"{plain(math.exp(less), 2)} times less likely"
    return f"10^{less / math.log(10.0):.0f} times less likely, but slightly bent it would look the same"


def next_lines(test: dict[str, Any] | None) -> list[str]:
    """What to measure next, why, how long and how well it will tell."""
    if test is None:
        return []
    what = " and ".join(ADDS.get(a, a) for a in test["adds"]) or "nothing on offer"
    sigma = test["expected_separation_sigma"]
    told = "" if sigma is None else f", should tell them apart by {plain(sigma, 2)} sigma"
    between = f" to tell {' from '.join(test['separates'])}" if test["separates"] else ""
    return [f"measure next: {what}{between} (about {test['minutes']:.0f} min{told})"] + ([f"  {test['why']}"] if test["why"] else [])


def next_of(finding: dict[str, Any]) -> list[str]:
    """What to measure next after a finding; without a test that tells suspects apart, what helps anyway. Empty: nothing is missing."""
    if finding["next_test"] is not None:
        return next_lines(finding["next_test"])
    if finding["verdict"] == "unknown":
        there = "; ".join(where_lines(finding["where"]))
        what = f"repeat it where it lives ({there})" if there else "repeat the whole campaign: it could not be located"
        return [f"measure next: {what}, and once more later: what comes back belongs to the machine, what does not to that session"]
    if finding["verdict"] == "none":
        again = "measure next: repeat the runs that were never fitted and do not agree, some of them with the role identify"
        return ([again] if disagreeing(finding) else []) + unseen_lines(finding)
    return [f"no test on offer tells it from {', '.join(finding['confounded_with'])}"] if finding["confounded_with"] else []


def unseen_lines(finding: dict[str, Any]) -> list[str]:
    """What these runs could not have shown, whether it is there or not, and what would; empty: nothing of the kind is known."""
    return [
        f"could not be seen: {u['what']}, because {u['because']}; what would show it: {ADDS.get(u['adds'], u['adds'])}"
        for u in finding.get("unseen", [])
    ]


def where_lines(where: dict[str, Any]) -> list[str]:
    """Where something lives, in words."""
    out = []
    for key, word in (("tests", "seen in"), ("axes", "axis"), ("runs", "run"), ("depends_on", "depends on")):
        found = [str(v).replace("_", " ") for v in where.get(key, [])]
        if found and not (key == "axes" and len(found) == len(AXES)):  # all three: it tells nothing
            out.append(f"{word} {', '.join(found[:MANY])}" + (f" and {len(found) - MANY} more" if len(found) > MANY else ""))
    if len(where.get("directions", [])) == 1:
        out.append("only " + ("forward" if where["directions"][0] > 0 else "backward"))
    if "time_s" in where:
        out.append("from {:.0f} to {:.0f} s of the session".format(*where["time_s"]))
    if "position_mm" in where:
        near = f", within {plain(where['radius_mm'])} mm" if "radius_mm" in where else ""
        out.append("about X {:.0f}, Y {:.0f}, Z {:.0f} mm".format(*where["position_mm"]) + near)
    if where.get("shape"):
        out.append(str(where["shape"]))
    for key, text in (("period_s", "every {} s"), ("period_mm", "every {} mm"), ("angular_lobes", "{} lobes a turn")):
        if key in where:
            out.append(text.format(plain(where[key])))
    return out
