"""Rivals of a named effect: every other name in its place, refined, against the same readings (discovery.md 4.9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from abbe.models.arrays import F2
from abbe.models.discovery.candidates import Pick, gain_of
from abbe.models.discovery.refine import refined
from abbe.models.discovery.selection import FORM_LEAST, Contest, Selection, others

EXCLUDED = 12.0
"""A rival that explains less by this much chi-square, after its price, is excluded."""
TRIED = 8
KIN = 0.02
"""Rivals that explain all but this share of the evidence are not excluded: a curved form of one resembles the other."""


@dataclass(frozen=True)
class Rival:
    """A name that could replace another, and its lack of chi-square (after price)."""

    pick: Pick
    deficit: float
    share: float


def rivals_of(contest: Contest, found: Sequence[Selection], i: int) -> list[Rival]:
    """Names that the readings do not exclude in place of pick ``i``, the nearest first; variants of the same name are not rivals."""
    picks = [f.pick for f in found]
    rows = others(contest.problem, picks, i)
    own = found[i]
    without = [p.label for p in picks]
    out = []
    for candidate in contest.shortlist(rows, without, TRIED):
        if candidate.pick.unnamed or _nested(candidate.pick, own.pick) or candidate.gain < 0.3 * own.gain:
            continue
        pick, gain = refined(contest.problem, candidate.pick, rows)
        pick, gain, score = _formed(contest, pick, rows, gain)
        rival = Rival(pick, own.score - score, gain / own.gain)
        if rival.deficit < EXCLUDED or rival.share > 1.0 - KIN:
            out.append(rival)
    return sorted(out, key=lambda r: r.deficit)


def _nested(a: Pick, b: Pick) -> bool:
    """Whether one is a variant of the other: backlash and position-dependent backlash of one axis."""
    return a.key == b.key and (a.effect.name == b.effect.variant_of or b.effect.name == a.effect.variant_of)


def _formed(contest: Contest, pick: Pick, rows: F2, gain: float) -> tuple[Pick, float, float]:
    """A rival with the freedoms of form that are worth their price, as for the chosen name."""
    score = gain - contest.price(pick)
    for form in pick.effect.forms:
        more = replace(pick, forms=(*pick.forms, form))
        with_form = gain_of(contest.problem, more, rows)
        if with_form - gain < FORM_LEAST * gain:  # the same rule as for the chosen name
            continue
        if with_form - contest.price(more) > score:
            pick, gain, score = more, with_form, with_form - contest.price(more)
    return pick, gain, score
