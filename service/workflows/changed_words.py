"""What has changed since a solution (`service.workflows.changed_since`), in words."""

from __future__ import annotations

from typing import Any

from service.report.numbers import plain, with_uncertainty
from service.workflows.discovery_states import CLOSED, VISIBLE, closed
from service.workflows.linear_change import NAMES

UNITS = {"um/m": "µm/m", "urad": "µrad", "um": "µm"}
Doc = dict[str, Any]


def changed_words(finding: Doc) -> str:
    """In one sentence, empty where nothing could be compared: what has changed, with U (k = 2), and whether that is proved."""
    told = finding.get("changed")
    if told is None:
        return ""
    since = f"since solution {told['since']}"
    if not told["changes"]:
        return f"nothing has changed {since} that these runs can tell"
    names = ", ".join(_size(c) for c in told["changes"])
    return f"changed {since}: {names}{'' if proved(told) else ' (not proved)'}"


def changed_lines(finding: Doc) -> list[str]:
    """The same with what proves it, what else it could be, and what would not have been seen; empty where nothing could be compared."""
    told = finding.get("changed")
    if told is None:
        return []
    out = [changed_words(finding)]
    for c in told["changes"]:
        if c["rivals"]:
            rivals = ", ".join(_rival(r["name"]) for r in c["rivals"])
            out.append(f"  {_name(c['motion'], c['part'])}: these runs cannot tell it from {rivals}")
    return out + (_proof(told) if told["changes"] else [_hidden(told)])


def proved(told: Doc) -> bool:
    """Whether runs that did not choose the changes agree better with them, and each was chosen by both halves without the other."""
    gap = told["gap"]
    if gap is None or any(c["halves"] < 2 for c in told["changes"]):
        return False
    return (closed(gap) or 0.0) >= CLOSED


def _proof(told: Doc) -> list[str]:
    gap = told["gap"]
    if gap is None:
        return ["  there are too few set-ups for one half of them to judge what the other chooses: judged by evidence alone"]
    before, after, floor = (plain(gap[k]) for k in ("before_um", "after_um", "floor_um"))
    share = closed(gap)
    part = "" if share is None else f" ({share:.0%} closed)"
    out = [f"  on runs that did not choose it the gap shrinks from {before} to {after} µm rms where {floor} µm is noise{part}"]
    alone = [_name(c["motion"], c["part"]) for c in told["changes"] if c["halves"] < 2]
    if alone:
        out.append(f"  not chosen by each half of the runs alone: {', '.join(alone)}")
    if gap["after_um"] > VISIBLE * gap["floor_um"]:
        out.append("  what is left is more than noise: what the solution did not know, or a change that has no name here")
    return out


def _hidden(told: Doc) -> str:
    seen = ", ".join(f"{NAMES[name]} {plain(value, 2)} {'µm/m' if name[0] == 'E' else 'µrad'}" for name, value in told["seen_um_m"].items())
    return f"  what may be there all the same (U, k = 2): {seen}"


def _size(change: Doc) -> str:
    value, expanded = with_uncertainty(change["value"], change["u"])
    sign = "+" if change["part"] == "linear" and change["value"] > 0.0 else ""
    return f"{_name(change['motion'], change['part'])} {sign}{value} ± {expanded} {UNITS[change['unit']]}"


def _rival(name: str) -> str:
    motion, _, part = name.partition(" ")
    return _name(motion, part or "linear")


def _name(motion: str, part: str) -> str:
    return NAMES[motion] if part == "linear" else f"shape of {motion} (rms)"
