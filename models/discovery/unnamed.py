"""Structures without a name that a search found: evidence, location, description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.models.discovery.answer import Localization
from abbe.models.discovery.case import Case
from abbe.models.discovery.generic.unnamed_structures import PREFIX, is_unnamed, where_of
from abbe.models.discovery.selection import Selection
from abbe.models.discovery.variance.scatter_effects import VarianceFinding

TITLES = {"unnamed_burst": "short disturbance of the reading", "unnamed_place": "readings of the laser off near one place"}
"""Titles of the variance structures."""


@dataclass(frozen=True)
class Structure:
    """A structure without a name; ``title`` for people."""

    label: str
    title: str
    evidence: float
    where: Localization


def structures(case: Case, found: Sequence[Selection], loud: Sequence[VarianceFinding]) -> tuple[Structure, ...]:
    """Structures among the effects of the mean (``found``) and of the variance (``loud``), by evidence."""
    out = [
        Structure(f.pick.label, f.pick.effect.title, f.score / 2.0, where_of(f.pick.effect, f.pick.key, f.pick.values, case))
        for f in found
        if f.pick.unnamed
    ]
    out += [Structure(f.label, TITLES[f.name], f.evidence, f.where) for f in loud if is_unnamed(f.name)]
    return tuple(sorted(out, key=lambda s: (-s.evidence, s.label)))


def lacking(where: Localization) -> Structure:
    """A lack of fit as a structure."""
    axis = f":{where.axes[0]}" if len(where.axes) == 1 else ""
    if where.shape:
        return Structure(f"{PREFIX}smooth{axis}", where.shape, 0.0, where)
    return Structure(f"{PREFIX}place{axis}", "more is left than noise", 0.0, where)


def describe_structure(structure: Structure, *, beside: bool) -> str:
    """``144 nats, without a name: step of one axis, at 870 to 930 s``; ``beside``: names were found too."""
    parts = [f"{structure.evidence:.0f} nats, without a name: {structure.title}", *_place(structure.where)]
    return ", ".join(parts) + ("; what it closes of the gap is not the names'" if beside else "")


def _place(where: Localization) -> list[str]:
    out = []
    if where.time_s is not None:
        out.append(f"at {where.time_s[0]:.0f} to {where.time_s[1]:.0f} s")
    if where.position_mm is not None:
        x, y, z = where.position_mm
        out.append(f"around X {x:.0f} Y {y:.0f} Z {z:.0f} mm")
    if where.period_s is not None:
        out.append(f"period {where.period_s:.1f} s")
    if where.period_mm is not None:
        out.append(f"pitch {where.period_mm:.1f} mm")
    if where.angular_lobes is not None:
        out.append(f"{where.angular_lobes} lobes")
    return out
