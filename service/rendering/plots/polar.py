"""Radial deviation around a circle or a helix, drawn as deviation from a reference circle."""

from __future__ import annotations

import math
from collections.abc import Sequence

from abbe.service.rendering.axes import data_range, nice_step, tick_text, ticks
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.numbers import UM, Unit, plain
from abbe.service.rendering.svg import XY, Svg

SIZE = 470.0
CENTRE, INNER, OUTER = (SIZE / 2.0, SIZE / 2.0 + 14.0), 52.0, 188.0
STYLES = ("s-c1 dash", "s-c2", "s-c3", "s-c4", "s-c5")


def polar_plot(traces: Sequence[PolarTrace], *, key: str = "polar", heading: str = "Circular deviation", unit: Unit = UM) -> str:
    """Deviation of up to five traces against the angle, which may exceed one turn. The heavier ring is zero, outwards is positive.

    ``unit``: display unit of the deviation.
    """
    displayed = [[float(v) / unit.size for v in t.deviation_um] for t in traces]
    low, high = data_range((v for values in displayed for v in values), zero=True)
    summary = "; ".join(f"{t.label}: {_extremes(values, unit)}" for t, values in zip(traces, displayed, strict=True)) or "no data"
    svg = Svg(SIZE, SIZE + 30.0, key, heading, f"Polar plot of the radial deviation. {summary}.")
    svg.text((CENTRE[0], 18.0), heading, "t-head", anchor="middle")
    _draw_rings(svg, low, high, unit)
    for trace, values, style in zip(traces, displayed, STYLES, strict=False):
        svg.polyline([_at(float(a), _radius(d, low, high)) for a, d in zip(trace.angle_deg, values, strict=False)], style)
    entries = [(style, trace.label[:40]) for trace, style in zip(traces, STYLES, strict=False)]
    svg.legend((20.0, SIZE + 20.0), entries)
    return svg.render()


def _draw_rings(svg: Svg, low: float, high: float, unit: Unit) -> None:
    step = nice_step(high - low, 4)
    for angle in range(0, 360, 30):
        svg.line(_at(angle, INNER), _at(angle, OUTER), "grid")
    for value in ticks(low, high, 4):
        radius = _radius(value, low, high)
        svg.circle(CENTRE, radius, "ring-zero" if abs(value) < 1e-9 * step else "grid")
    for value in ticks(low, high, 4):
        x, y = _at(75.0, _radius(value, low, high))
        sign = f" {unit.sign}" if abs(value) < 1e-9 * step else ""
        svg.text((x, y + 4.0), tick_text(value, step) + sign, "t-small t-halo", anchor="middle")
    for angle in range(0, 360, 90):
        x, y = _at(angle, OUTER + 18.0)
        svg.text((x, y + 4.0), f"{angle}°", "t-soft", anchor="middle")


def _radius(value: float, low: float, high: float) -> float:
    return INNER + (value - low) / (high - low) * (OUTER - INNER)


def _at(angle_deg: float, radius: float) -> XY:
    angle = math.radians(angle_deg)
    return CENTRE[0] + radius * math.cos(angle), CENTRE[1] - radius * math.sin(angle)


def _extremes(values: Sequence[float], unit: Unit) -> str:
    good = [v for v in values if math.isfinite(v)]
    return f"{plain(min(good))} to {plain(max(good))} {unit.sign}" if good else "n/a"
