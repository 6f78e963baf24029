"""States of a discovery and how one follows from the other: FITTED, SUSPICIOUS, PROPOSED, TESTING, EXPLAINED or UNEXPLAINED.

Pure: from a finding (`abbe.service.discovery.discovery_doc`) to the documents of its states. Every document says who decided and by which
rule.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from abbe.service.discovery.never_fitted import told_missing

State = Literal["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED", "UNEXPLAINED"]
FOLLOWS: dict[str | None, frozenset[str]] = {
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
"""Runs that judge must miss the floor by this factor before, else the effect does not show in them and they cannot judge."""
CLOSED = 0.5
"""Share of the gap (`closed`) that must close on runs that judge. A wrong name closes it where it was fitted, not elsewhere."""
LEFT = 1.5
"""Names that nothing proves explain a gap only if they leave less than so many times the noise."""
WORSE = 1.05
"""No runs may have a larger gap after than before by this factor: a solution that has run away is no finding."""
NEAR = 3.0
"""Evidence (natural logarithm) by which a name must be ahead of every rival to enter the model book: twenty times as likely."""
PROGRAM = "abbe discover"
NOT_CONFIRMED = "runs that judge do not agree better with the effect than without it"


def after_fit(finding: dict[str, Any]) -> Iterator[tuple[State, dict[str, Any]]]:
    """The states that follow FITTED, each with its document, to the end."""
    if finding["verdict"] == "none":
        yield "EXPLAINED", _decided(told_missing(finding), p_value=finding["p_value"], gaps=finding["gaps"])
        return
    yield (
        "SUSPICIOUS",
        _decided(
            "readings disagree with the present model by more than noise", p_value=finding["p_value"], gaps=finding["gaps"],
            where=finding["where"],
        ),
    )  # fmt: skip
    if not _names(finding):
        yield "UNEXPLAINED", _decided("nothing in the catalogue explains the gap", where=finding["where"], rejected=finding["rejected"])
        return
    proposed = {k: finding[k] for k in ("rejected", "confounded_with", "next_test")}
    names = [{k: e[k] for k in ("label", "strength", "u_strength", "unit", "evidence", "alternatives")} for e in _names(finding)]
    yield "PROPOSED", _decided("best evidence after its price, rivals refitted", effects=names, **proposed)
    judged = judge(finding)
    yield "TESTING", _decided(judged["rule"], **{k: v for k, v in judged.items() if k != "rule"})
    yield ending(finding, judged)


def ending(finding: dict[str, Any], judged: dict[str, Any]) -> tuple[State, dict[str, Any]]:
    """Whether names that were judged so explain the gap."""
    if judged["proved"] is False:
        return "UNEXPLAINED", _decided(judged["against"], judged=judged)
    if finding["verdict"] == "unknown":
        return "UNEXPLAINED", _decided("the named effects leave a gap that the catalogue does not explain", where=finding["where"])
    closes = "the gap closes" + (" on runs that were never fitted" if judged["proved"] else ", judged by evidence alone")
    kept_out = not_entered(finding, judged)
    return "EXPLAINED", _decided(closes if kept_out is None else f"{closes}; not added to the model book: {kept_out}", not_added=kept_out)


def not_entered(finding: dict[str, Any], judged: dict[str, Any]) -> str | None:
    """Why nothing of a finding enters the model book. None: it was proved, and no rival is nearly as likely; then `entering` does."""
    if judged["proved"] is not True:
        return f"it is not proved, {judged['rule']}"
    unnamed = finding.get("answer", {}).get("beside", [])
    if unnamed:
        return f"what closes the gap is in part a structure without a name ({unnamed[0]['label'].replace('_', ' ')})"
    for e in entering(finding):
        if e.get("needed") is not None and e["needed"] <= 1.0:
            return f"the runs that judge do not need {e['label']}"
        near = next((a for a in e["alternatives"] if a["less_evidence"] < NEAR), None)
        if near is not None:
            return f"these runs hardly tell {e['label']} from {near['label']}"
    return None


def taken_back(finding: dict[str, Any]) -> dict[str, Any]:
    """A finding with its proof: a name that the runs that judge do not confirm is a suspect, and the verdict "unknown".

    ``proved``: whether runs that were never fitted confirm the names; ``proof``: by which rule; each effect has its own ``proved``. So has
    ``answer``. Findings that older versions stored come out alike.
    """
    if "proof" in finding:
        return finding
    if not finding["effects"]:
        unproved = {"proved": False, "proof": ""}
        return finding | unproved | ({"answer": finding["answer"] | unproved} if "answer" in finding else {})
    judged = judge(finding)
    proved, proof = judged["proved"] is True, str(judged["rule"])
    confirmed = {e["label"]: proved and e["kind"] == "mean" and (e.get("needed") is None or e["needed"] > 1.0) for e in finding["effects"]}
    told = {"proved": proved, "proof": proof}
    effects = [e | {"proved": confirmed[e["label"]]} for e in finding["effects"]]
    answer = finding.get("answer", {"effects": []})
    named = [e | {"proved": confirmed[f"{e['name']}:{e['key']}" if e["key"] else e["name"]]} for e in answer["effects"]]
    if judged["proved"] is not False:
        return finding | told | {"effects": effects, "answer": answer | told | {"effects": named}}
    told |= {"verdict": "unknown", "confounded_with": [], "proof": judged["against"]}
    rejected = [[e["label"], f"suspected only: {judged['against']}"] for e in effects]
    return (
        finding
        | told
        | {
            "effects": [],
            "suspects": effects,
            "rejected": [*rejected, *finding["rejected"]],
            "answer": answer | told | {"effects": [], "suspects": named},
        }
    )


def _names(finding: dict[str, Any]) -> list[dict[str, Any]]:
    """Effects that were named, or that were and are suspects now (`taken_back`)."""
    return list(finding.get("effects") or finding.get("suspects") or ())


def entering(finding: dict[str, Any]) -> list[dict[str, Any]]:
    """Effects that a proof is about: those that move readings. What makes them noisier closes no gap, here or in the next campaign."""
    return [e for e in finding["effects"] if e["kind"] == "mean"]


def judge(finding: dict[str, Any]) -> dict[str, Any]:
    """What the runs say that only judge: how much of the gap closes on them, and whether that proves the finding (None: they cannot).

    Where they cannot, names that leave the fitted runs a gap of `LEFT` times the noise are not believed either. ``against``: why not.
    """
    moving = [e for e in _names(finding) if e["kind"] == "mean"]
    found = _judged(finding, moving)
    fitted = finding["gaps"].get("identify")
    if found["proved"] is None and moving and fitted is not None and fitted["after_um"] > LEFT * fitted["floor_um"]:
        times = fitted["after_um"] / fitted["floor_um"]
        return found | {
            "proved": False,
            "against": f"{found['rule']}, and with it the fitted runs are still off by {times:.2g} times the noise",
        }
    return found | ({"against": NOT_CONFIRMED} if found["proved"] is False else {})


def _judged(finding: dict[str, Any], moving: list[dict[str, Any]]) -> dict[str, Any]:
    worse = [role for role, g in finding["gaps"].items() if g["after_um"] > WORSE * max(g["before_um"], g["floor_um"])]
    if worse:
        return {"rule": f"the {worse[0]} runs agree worse with the effect than without it", "proved": False, "closed": None}
    gap = finding["gaps"].get("holdout")
    if gap is None:
        return {"rule": "no run of this campaign only judges", "proved": None, "closed": None}
    share = closed(gap)
    if gap["before_um"] <= VISIBLE * gap["floor_um"] or share is None:
        return {"rule": "the gap does not show in the runs that judge", "proved": None, "closed": share, "gap": gap}
    if not moving:
        return {"rule": "what makes readings noisier closes no gap: judged by evidence alone", "proved": None, "closed": share, "gap": gap}
    rule = f"at least {CLOSED:.0%} of the gap closes on the runs that judge"
    return {"rule": rule, "proved": share >= CLOSED, "closed": share, "gap": gap}


def closed(gap: dict[str, float]) -> float | None:
    """Share of the gap above the noise that is gone, of rms: 1 to the noise, 0 nothing, below 0 worse; None where there was no gap."""
    before, after, floor = gap["before_um"], gap["after_um"], gap["floor_um"]
    if before <= floor:
        return None
    return float(1.0 - max(after - floor, 0.0) / (before - floor)) if after > floor else 1.0


def _decided(why: str, **numbers: Any) -> dict[str, Any]:
    return {"decided_by": PROGRAM, "why": why} | numbers
