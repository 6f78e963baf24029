"""Figures before and after as pairs of bars with whiskers of U."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.numbers import COVERAGE, UM, Unit, finite, with_uncertainty
from abbe.service.rendering.svg import Svg

WIDTH, ROW, TOP, BOTTOM, LABELS, FIGURES = 640.0, 46.0, 58.0, 46.0, 170.0, 130.0
STYLES = ("f-c1", "f-c2")


@dataclass(frozen=True, slots=True)
class Pair:
    """One figure: two values with their standard uncertainties, µm; None: no value on that side."""

    name: str
    first: tuple[float, float] | None
    second: tuple[float, float] | None


def paired_bars(pairs: Sequence[Pair], names: tuple[str, str], *, key: str, heading: str, unit: Unit = UM) -> str:
    """Pairs from top to bottom. ``names``: of the first and the second bar of each pair; ``unit``: display unit."""
    pairs = [Pair(p.name, _in_unit(p.first, unit), _in_unit(p.second, unit)) for p in pairs]
    sides = [side for p in pairs for side in (p.first, p.second) if side is not None]
    summary = "; ".join(f"{p.name}: {_words(p.first, unit)}, {_words(p.second, unit)}" for p in pairs)
    svg = Svg(WIDTH, TOP + ROW * len(pairs) + BOTTOM, key, heading, f"{heading}; {names[0]}, {names[1]}: {summary}.")
    svg.text((10.0, 18.0), heading, "t-head")
    for k, name in enumerate(names):
        svg.rect((LABELS + k * 200.0, 30.0), (14.0, 12.0), STYLES[k])
        svg.text((LABELS + k * 200.0 + 20.0, 41.0), name[:28], "t-small")
    top = data_range([abs(v) + COVERAGE * u for v, u in sides], zero=True)[1]
    panel = Panel(LABELS, TOP, WIDTH - LABELS - FIGURES, ROW * max(len(pairs), 1), (0.0, top), (0.0, 1.0))
    panel.draw_x(svg, unit.sign, count=4)
    for i, pair in enumerate(pairs):
        y = TOP + ROW * (i + 0.5)
        svg.text((LABELS - 8.0, y + 4.0), pair.name[:24], anchor="end")
        for side, shift, style in ((pair.first, -10.0, STYLES[0]), (pair.second, 10.0, STYLES[1])):
            svg.text((WIDTH - FIGURES + 14.0, y + shift + 4.0), _words(side, unit), "t-soft")
            if side is not None and finite(side[0]):
                _bar(svg, panel, side, y + shift, style)
    return svg.render()


def _bar(svg: Svg, panel: Panel, side: tuple[float, float], y: float, style: str) -> None:
    value, u = abs(side[0]), COVERAGE * side[1]
    svg.rect((panel.left, y - 6.0), (panel.x(value) - panel.left, 12.0), style)
    if finite(u) and u > 0.0:
        low, high = panel.x(max(value - u, 0.0)), panel.x(value + u)
        svg.error_bar((0.5 * (low + high), y), 0.5 * (high - low), horizontal=True)


def _in_unit(side: tuple[float, float] | None, unit: Unit) -> tuple[float, float] | None:
    return None if side is None else (side[0] / unit.size, side[1] / unit.size)


def _words(side: tuple[float, float] | None, unit: Unit) -> str:
    return "–" if side is None else "{} ± {} {}".format(*with_uncertainty(*side), unit.sign)
