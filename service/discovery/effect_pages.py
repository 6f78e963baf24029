"""The catalogue of effects as a table, and the description of one effect."""

from __future__ import annotations

from typing import Any

from abbe.models.effects.effect import Effect
from abbe.service.effects.model_book import REMEDIES
from abbe.service.rendering.numbers import plain

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
    "judging_run": "a run of the role holdout: it is not fitted and only judges",
}

HEADINGS = ("name", "what it is", "sits at", "usual size", "taken out by")


def unit(text: str) -> str:
    """Return a unit of the discovery format in its usual spelling: ``um/m`` as ``µm/m``."""
    return UNITS.get(text, text)


def effect_row(effect: Effect) -> tuple[str, ...]:
    """Return the cells of one effect under `HEADINGS`."""
    return (effect.name, effect.title, _keys(effect), _usual(effect), REMEDIES[effect.remedy])


def _keys(effect: Effect) -> str:
    keys = [k for k in effect.keys if k]
    return ", ".join(keys) if len(keys) <= 6 else f"{', '.join(keys[:3])} … ({len(keys)})"


def _usual(effect: Effect) -> str:
    low, high = effect.typical
    return f"{plain(low)} to {plain(high)} {unit(effect.unit)}"


def effect_lines(effect: Effect) -> list[tuple[str, str]]:
    """Describe one effect by pairs of heading and text."""
    lines = [
        ("what it is", effect.title),
        ("name", effect.name),
        ("sits at", ", ".join(k for k in effect.keys if k) or "one place only"),
        ("usual size", _usual(effect)),
        ("how it looks", effect.signature),
        ("what shows it", effect.needs),
    ]
    if effect.blind:
        lines.append(("cannot be seen by", ", ".join(b.replace("_", " ") for b in effect.blind)))
    for p in effect.shape:
        lines.append((f"parameter {p.name}", f"{plain(p.low)} to {plain(p.high)} {unit(p.unit)}, usually {plain(p.typical)} ({p.source})"))
    if effect.forms:
        lines.append(("other forms", ", ".join(f.name for f in effect.forms)))
    lines += [("taken out by", REMEDIES[effect.remedy]), ("what to do", effect.remedy_text)]
    for rival, adds in effect.separated_by.items():
        lines.append((f"distinguished from {rival} by", "; or ".join(ADDS.get(a, a) for a in adds)))
    return [*lines, ("source", effect.source)]


def effect_doc(effect: Effect) -> dict[str, Any]:
    """Return one effect as JSON."""
    return {
        "name": effect.name,
        "title": effect.title,
        "family": effect.family,
        "keys": [k for k in effect.keys if k],
        "unit": effect.unit,
        "typical": list(effect.typical),
        "parameters": [
            {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "typical": p.typical, "source": p.source} for p in effect.shape
        ],
        "forms": [f.name for f in effect.forms],
        "kind": effect.kind,
        "needs": effect.needs,
        "blind": list(effect.blind),
        "signature": effect.signature,
        "remedy": effect.remedy,
        "remedy_text": effect.remedy_text,
        "separated_by": {rival: list(adds) for rival, adds in effect.separated_by.items()},
        "source": effect.source,
    }
