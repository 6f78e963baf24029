"""Text about a drift: which scale or squareness of a machine has changed most since its last solution."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import stored_solution
from abbe.service.errors import Unusable
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
COVERAGE = 2.0


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
        return f"; largest linear error: {NAMES[first]} {_size(known[first].value, known[first].u)}"
    then = stored_solution(old.doc, old.id).mean_over_volume
    changes = {k: (v.value - then[k].value, math.hypot(v.u, then[k].u)) for k, v in known.items() if k in then}
    name = largest_sure(changes)
    if name is None:
        return f"; since solution {old.id} no scale and no squareness has changed by more than U"
    return f"; changed most since solution {old.id}: {NAMES[name]} {_size(*changes[name])}"


def largest_sure(changes: dict[str, tuple[float, float]]) -> str | None:
    """Return the name of the largest change above its U (k = 2), else None; ``changes``: change and standard uncertainty by name."""
    sure = {name: abs(change) for name, (change, u) in changes.items() if abs(change) > COVERAGE * u}
    return max(sure, key=lambda name: sure[name], default=None)


def _size(value: float, u: float) -> str:
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
