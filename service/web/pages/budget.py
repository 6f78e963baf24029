"""The uncertainty budget of a solution for the screen: sources, coverage intervals, and what the trials said of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from abbe.service.domain.results import SolutionRecord
from abbe.service.rendering.model import Contribution
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, finite, fixed, placed, plain
from abbe.service.rendering.plots.bars import contribution_bars
from abbe.service.storage.store import Store
from abbe.service.web.frame import current

Say = Callable[..., str]
NOTHING = Markup("")
UM = 1e6
"""From mm/mm and rad to µm/m and µrad."""


@dataclass(frozen=True, slots=True)
class SourceLine:
    """One source: u and share; type of its evaluation and degrees of freedom, a dash where the solution does not hold them."""

    name: str
    words: str
    u: str
    share: str
    evaluation: str
    dof: str


@dataclass(frozen=True, slots=True)
class IntervalLine:
    """One result: estimate, U, the interval's ends, unit."""

    name: str
    value: str
    expanded: str
    low: str
    high: str
    unit: str


@dataclass(frozen=True, slots=True)
class BudgetScreen:
    """The budget in the reader's units. ``total``: u of all sources together; ``worst``: results at the worst known place; ``old``: without
    types and freedom.
    """

    number: int
    campaign: str
    sources: Sequence[SourceLine] = ()
    total: str = ""
    picture: Markup = NOTHING
    worst: Sequence[IntervalLine] = ()
    place: str = ""
    vector: str = ""
    means: Sequence[IntervalLine] = ()
    trials: Sequence[tuple[str, str, str, str]] = ()
    trials_text: str = ""
    old: bool = False


def budget_screen(store: Store, record: SolutionRecord, say: Say) -> BudgetScreen:
    """The budget as the store has it; nothing is computed anew but the ends of intervals."""
    doc = record.doc
    campaign = store.campaigns.find(record.campaign_id).name
    known: Mapping[str, Any] = doc.get("uncertainty") or {}
    lines = known.get("budget") or []
    if not lines:
        return BudgetScreen(record.id, campaign)
    bars = [Contribution(_name(b), float(b["u_um"])) for b in lines]
    total = float(np.sqrt(sum(float(b["u_um"]) ** 2 for b in lines)))
    worst = known["worst_point"]
    trials = doc.get("monte_carlo") or {}
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    picture = Markup(contribution_bars(bars, key="budget", heading=say("budget.bars"), unit=current().drawn()))  # noqa: S704
    return BudgetScreen(
        record.id, campaign, [_source(b) for b in lines], _size(total, 2), picture, _worst(worst),
        ", ".join(placed(float(v), current().drawn("mm")) for v in worst["at_mm"]), _size(float(worst["expanded_vector_um"]), 2),
        [_mean(name, m) for name, m in (doc.get("mean_over_volume") or {}).items()], _trials(trials), str(trials.get("text", "")),
        any("type" not in b for b in lines),
    )  # fmt: skip


def _name(b: Mapping[str, Any]) -> str:
    """Short name of a source; as it is where it has no translation."""
    return current().state("source", str(b["source"]))


def _size(value_um: float, digits: int) -> str:
    return plain(value_um / current().drawn().size, digits)


def _source(b: Mapping[str, Any]) -> SourceLine:
    dof = "–" if "type" not in b else "∞" if b.get("dof") is None else plain(float(b["dof"]), 3)
    return SourceLine(_name(b), str(b["words"]), _size(float(b["u_um"]), 2), f"{b['share']:.1%}", str(b.get("type") or "–"), dof)


def _worst(worst: Mapping[str, Any]) -> list[IntervalLine]:
    """Components of the deviation with the interval of 95 % as it was stored (k from its degrees of freedom)."""
    rows = zip(("dX", "dY", "dZ"), worst["deviation_um"], worst["expanded_um"], strict=True)
    return [_interval(name, float(value), float(expanded), "µm") for name, value, expanded in rows]


def _mean(name: str, m: Mapping[str, Any]) -> IntervalLine:
    return _interval(name, float(m["value"]) * UM, COVERAGE * float(m["u"]) * UM, "µm/m" if name[0] == "E" else "µrad")


def _interval(name: str, value: float, expanded: float, unit: str) -> IntervalLine:
    frame = current()
    shown, half = frame.with_u(value, expanded / COVERAGE, unit)
    if not (finite(value) and finite(expanded)):
        return IntervalLine(name, shown, half, NOT_AVAILABLE, NOT_AVAILABLE, frame.unit(unit))
    # The ends are rounded as U is: 470 to tens.
    decimals = 1 - math.floor(math.log10(float(half))) if expanded > 0.0 else 0
    low, high = (fixed(end / frame.drawn(unit).size, decimals) for end in (value - expanded, value + expanded))
    return IntervalLine(name, shown, half, low, high, frame.unit(unit))


def _trials(trials: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    if not trials:
        return []
    rows = zip(("dX", "dY", "dZ"), trials["stated_um"], trials["found_um"], trials["valid"], strict=True)
    return [(name, _size(float(a), 3), _size(float(b), 3), current().say("yes" if ok else "compare.no")) for name, a, b, ok in rows]
