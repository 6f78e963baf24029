"""The uncertainty budget of a solution for the screen: sources, coverage intervals, and Monte Carlo trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import BudgetLineValue, MeanValue, MonteCarloCheck, WorstPoint, stored_solution
from abbe.service.rendering.model import Contribution
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, finite, fixed, placed, plain
from abbe.service.rendering.plots.bars import contribution_bars
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.language import Translate

NOTHING = Markup("")
UM = 1e6
"""Factor from mm/mm and rad to µm/m and µrad."""


@dataclass(frozen=True, slots=True)
class SourceLine:
    """One source: u, share, type of evaluation and degrees of freedom; a dash if the solution lacks them."""

    name: str
    text: str
    u: str
    share: str
    evaluation: str
    dof: str


@dataclass(frozen=True, slots=True)
class IntervalLine:
    """One result: estimate and U, the interval's ends, unit."""

    name: str
    shown: tuple[str, str]
    ends: tuple[str, str]
    unit: str


@dataclass(frozen=True, slots=True)
class BudgetScreen:
    """The budget in the reader's units.

    ``total``: combined u; ``worst``: results at the worst point; ``old``: the solution lacks evaluation types and degrees of freedom.
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


def budget_screen(store: Store, record: SolutionRecord, translate: Translate) -> BudgetScreen:
    """The stored budget. Computed here: the combined u, U of the linear errors (means over the volume), and the ends of intervals."""
    solution = stored_solution(record.doc, record.id)
    campaign = store.campaigns.find(record.campaign_id).name
    lines, worst, trials = solution.uncertainty.budget, solution.uncertainty.worst_point, solution.monte_carlo
    if not lines:
        return BudgetScreen(record.id, campaign)
    bars = [Contribution(_name(b), b.u_um) for b in lines]
    total = float(np.sqrt(sum(b.u_um**2 for b in lines)))
    # The SVG writer has already escaped every text.
    picture = Markup(contribution_bars(bars, key="budget", heading=translate("budget.bars"), unit=current().drawn()))  # noqa: S704
    return BudgetScreen(
        record.id, campaign, [_source(b) for b in lines], _size(total, 2), picture, _worst(worst),
        ", ".join(placed(v, current().drawn("mm")) for v in worst.at_mm), _size(worst.expanded_vector_um, 2),
        [_mean(name, m) for name, m in solution.mean_over_volume.items()], _trials(trials), "" if trials is None else trials.text,
        any(b.type is None for b in lines),
    )  # fmt: skip


def _name(b: BudgetLineValue) -> str:
    """Short name of a source, unchanged without a translation."""
    return current().state("source", b.source)


def _size(value_um: float, digits: int) -> str:
    return plain(value_um / current().drawn().size, digits)


def _source(b: BudgetLineValue) -> SourceLine:
    dof = "–" if b.type is None else "∞" if b.dof is None else plain(b.dof, 3)
    return SourceLine(_name(b), b.text, _size(b.u_um, 2), f"{b.share:.1%}", b.type or "–", dof)


def _worst(worst: WorstPoint) -> list[IntervalLine]:
    """Components of the deviation at the worst point, with the stored 95 % interval (k from the degrees of freedom)."""
    rows = zip(("dX", "dY", "dZ"), worst.deviation_um, worst.expanded_um, strict=True)
    return [_interval(name, value, expanded, "µm") for name, value, expanded in rows]


def _mean(name: str, m: MeanValue) -> IntervalLine:
    return _interval(name, m.value * UM, COVERAGE * m.u * UM, "µm/m" if name[0] == "E" else "µrad")


def _interval(name: str, value: float, expanded: float, unit: str) -> IntervalLine:
    frame = current()
    shown = frame.with_u(value, expanded / COVERAGE, unit)
    if not (finite(value) and finite(expanded)):
        return IntervalLine(name, shown, (NOT_AVAILABLE, NOT_AVAILABLE), frame.unit(unit))
    # The ends have the resolution of U: with U = 470, tens.
    decimals = 1 - math.floor(math.log10(float(shown[1]))) if expanded > 0.0 else 0
    low, high = (fixed(end / frame.drawn(unit).size, decimals) for end in (value - expanded, value + expanded))
    return IntervalLine(name, shown, (low, high), frame.unit(unit))


def _trials(trials: MonteCarloCheck | None) -> list[tuple[str, str, str, str]]:
    if trials is None:
        return []
    rows = zip(("dX", "dY", "dZ"), trials.stated_um, trials.found_um, trials.valid, strict=True)
    return [(name, _size(a, 3), _size(b, 3), current().translate("yes" if ok else "compare.no")) for name, a, b, ok in rows]
