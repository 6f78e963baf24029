"""Text about the changes since a solution (`abbe.service.discovery.changed_since`), and about the scale or squareness that drifted most."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from abbe.service.discovery.discovery_states import CLOSED, NEAR, VISIBLE
from abbe.service.domain.finding import ChangedSince, GapUm, MotionChange
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.errors import Unusable
from abbe.service.rendering.numbers import COVERAGE, plain, with_uncertainty
from abbe.service.storage.store import Store

if TYPE_CHECKING:
    from abbe.service.compensation.proposals import StoredProposal

NAMES = {
    "EXX": "scale of X",
    "EYY": "scale of Y",
    "EZZ": "scale of Z",
    "C0Y": "squareness of X and Y",
    "B0Z": "squareness of X and Z",
    "A0Z": "squareness of Y and Z",
}
LEFT = 1.5
"""A remaining gap above this multiple of the noise counts as more than noise; not 1, because the solution itself is uncertain."""
HALVES = 2
UNITS = {"um/m": "µm/m", "urad": "µrad", "um": "µm"}


def changed_text(changed: ChangedSince | None) -> str:
    """Return one sentence with the changes, their U (k = 2) and whether they are proved; empty without a comparison."""
    if changed is None:
        return ""
    since = f"since solution {changed.since}"
    if changed.trouble:
        return f"the changes {since} could not be determined: {changed.trouble}"
    if not changed.changes:
        return f"these runs show no change {since}"
    names = ", ".join(_size(c) for c in changed.changes)
    return f"changed {since}: {names}{'' if changed.proved else ' (not proved)'}"


def changed_lines(changed: ChangedSince | None) -> list[str]:
    """Return `changed_text` and lines about rivals, proof, and changes that these runs could have missed; empty without a comparison."""
    if changed is None:
        return []
    out = [changed_text(changed)]
    if changed.trouble:
        return out
    for c in changed.changes:
        name = _name(c.motion, c.part)
        if c.rivals:
            out.append(f"  {name}: these runs cannot tell it from {', '.join(_rival(r.name) for r in c.rivals)}")
        if not _sure(c):
            out.append(f"  {name}: zero is within its uncertainty, so another scale or squareness may have changed instead")
    if changed.changes and changed.beside:
        out.append(f"  {', '.join(changed.beside)} was found in the same runs and may look like a change here")
    return out + (_proof(changed) if changed.changes else []) + _hidden(changed)


def proved(changed: ChangedSince) -> bool:
    """Check whether the changes are confirmed by runs that were not used to choose them.

    Each half of the set-ups must be more likely with the changes that the other half chose. A visible gap must close. Both halves must have
    chosen every change, and each change must exceed its own U and have no close rival. No other finding in these runs may be the cause.
    """
    sure = all(c.halves == HALVES and not c.rivals and _sure(c) for c in changed.changes)
    if not changed.changes or not sure or changed.beside or changed.judged is None or changed.judged < NEAR:
        return False
    return changed.gap is not None and (not _shows(changed.gap) or (changed.gap.closed or 0.0) >= CLOSED)


def _shows(gap: GapUm) -> bool:
    return gap.before_um > VISIBLE * gap.floor_um


def _sure(change: MotionChange) -> bool:
    return abs(change.value) > COVERAGE * change.u


def _proof(changed: ChangedSince) -> list[str]:
    gap, judged = changed.gap, changed.judged
    if gap is None or judged is None:
        return ["  there are too few set-ups to choose the changes in one half and test them on the other: judged by evidence alone"]
    before, after, floor = plain(gap.before_um), plain(gap.after_um), plain(gap.floor_um)
    if _shows(gap):
        share = gap.closed or 0.0
        goes, part = ("shrinks", f", {share:.0%} closed") if share > 0.0 else ("goes", "")
        gap_text = f"the gap {goes} from {before} to {after} µm rms (noise alone: {floor} µm{part})"
        out = [f"  on runs that were not used to find the change, {gap_text}"]
    else:
        out = [
            f"  the fitted set-ups absorb nearly all of the change: "
            f"the gap is {before} µm rms without it and {after} µm rms with it (noise alone: {floor} µm)"
        ]
    if judged < NEAR:
        out.append("  the change does not explain the runs that were kept out of the search for it")
    unconfirmed = [_name(c.motion, c.part) for c in changed.changes if c.halves < HALVES]
    if unconfirmed:
        out.append(f"  not chosen by each half of the runs alone: {', '.join(unconfirmed)}")
    if gap.after_um > LEFT * gap.floor_um:
        out.append("  more than noise is left: an error that the solution did not contain, or another kind of change")
    return out


def _hidden(changed: ChangedSince) -> list[str]:
    """Return the changes that these runs could have missed."""
    hidden = changed.hidden_um_m
    named = {c.motion for c in changed.changes if c.part == "linear"}
    each = [f"{NAMES[n]} {plain(v, 2)} {'µm/m' if n[0] == 'E' else 'µrad'}" for n, v in hidden.items()]
    unseen = [name for n, name in NAMES.items() if n not in hidden and n not in named]
    out = [f"  these runs could have missed changes of at most (k = 2): {', '.join(each)}"] if each else []
    return out + ([f"  not seen by these runs: {', '.join(unseen)}"] if unseen else [])


def _size(change: MotionChange) -> str:
    value, expanded = with_uncertainty(change.value, change.u)
    sign = "+" if change.part == "linear" and change.value > 0.0 else ""
    return f"{_name(change.motion, change.part)} {sign}{value} ± {expanded} {UNITS[change.unit]}"


def _rival(name: str) -> str:
    motion, _, part = name.partition(" ")
    return _name(motion, part or "linear")


def _name(motion: str, part: str) -> str:
    return NAMES[motion] if part == "linear" else f"shape of {motion} (rms)"


def drift_text(store: Store, made: StoredProposal) -> str:
    """Return the linear error that changed most since the previous solution, with U; without a previous one, the largest.

    ``made``: proposal with the new solution. The text is empty if no linear error is known. Only solutions measured with the same
    compensation table are compared. Uncertainty that both solutions share (the laser's wavelength) is included twice in U.
    """
    new = store.solutions.get(made.proposed.solution_id)
    known = {k: v for k, v in stored_solution(new.doc, new.id).mean_over_volume.items() if k in NAMES}
    if not known:
        return ""
    old = _before(store, new)
    if old is None:
        first = max(known, key=lambda k: abs(known[k].value))
        return f"; largest linear error: {NAMES[first]} {_linear(known[first].value, known[first].u)}"
    then = stored_solution(old.doc, old.id).mean_over_volume
    changes = {k: (v.value - then[k].value, math.hypot(v.u, then[k].u)) for k, v in known.items() if k in then}
    name = largest_sure(changes)
    if name is None:
        return f"; since solution {old.id} no scale and no squareness has changed by more than U"
    return f"; changed most since solution {old.id}: {NAMES[name]} {_linear(*changes[name])}"


def largest_sure(changes: dict[str, tuple[float, float]]) -> str | None:
    """Return the name of the largest change above its U (k = 2), else None; ``changes``: change and standard uncertainty by name."""
    sure = {name: abs(change) for name, (change, u) in changes.items() if abs(change) > COVERAGE * u}
    return max(sure, key=lambda name: sure[name], default=None)


def _linear(value: float, u: float) -> str:
    return f"{value * 1e6:+.1f} ± {COVERAGE * u * 1e6:.1f} µm/m (U, k = 2)"


def _before(store: Store, new: SolutionRecord) -> SolutionRecord | None:
    """Return the last solution of the same machine with the same geometry and compensation table."""
    inputs = stored_solution(new.doc, new.id).inputs
    same = [c.id for c in store.campaigns.all() if c.machine_id == store.campaigns.find(new.campaign_id).machine_id]
    earlier = [s for number in same for s in store.solutions.all(number) if s.id < new.id and s.kind == new.kind]
    for one in sorted(earlier, key=lambda s: s.id, reverse=True):
        try:
            old = stored_solution(one.doc, one.id)
        except Unusable:  # an older version stored fewer fields
            continue
        if old.mean_over_volume and old.inputs.machine == inputs.machine and old.inputs.tables == inputs.tables:
            return one
    return None
