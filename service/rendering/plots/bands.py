"""Error motions over their strokes with a band of their expanded uncertainty: three axes across, components down, one ordinate per unit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.model import MotionCurve
from abbe.service.rendering.numbers import COVERAGE, plain
from abbe.service.rendering.svg import Svg

WIDTH, CELL_HEIGHT = 1010.0, 132.0
LEFT, GAP, TOP, BOTTOM = 68.0, 30.0, 30.0, 48.0
OPEN = "not observable"


def motion_bands(curves: Sequence[MotionCurve], *, key: str) -> str:
    """Curves of one unit, each with its band; motions that are not observable by themselves are dashed."""
    unit = curves[0].unit if curves else ""
    axes = sorted({c.axis for c in curves})
    rows = sorted({c.name[1] for c in curves})
    height = TOP + len(rows) * CELL_HEIGHT + max(len(rows) - 1, 0) * GAP + BOTTOM
    svg = Svg(WIDTH, height, key, f"Error motions in {unit}", _describe(curves))
    ends = [v for c in curves for v in (float((c.value - COVERAGE * c.u).min()), float((c.value + COVERAGE * c.u).max()))]
    y_range = data_range(ends, zero=True)
    width = (WIDTH - LEFT - 10.0 - (len(axes) - 1) * GAP) / max(len(axes), 1)
    for curve in curves:
        row, column = rows.index(curve.name[1]), axes.index(curve.axis)
        x_range = (float(curve.position_mm[0]), float(curve.position_mm[-1]))
        panel = Panel(LEFT + column * (width + GAP), TOP + row * (CELL_HEIGHT + GAP), width, CELL_HEIGHT, x_range, y_range)
        _draw(svg, panel, curve)
        panel.draw_y(svg, f"E{curve.name[1]} in {unit}" if column == 0 else "", count=4, numbers=column == 0)
        last = row == len(rows) - 1
        panel.draw_x(svg, f"{curve.axis} in mm" if last else "", count=5, numbers=last)
        panel.draw_frame(svg)
        svg.text((panel.left + 8.0, panel.top + 16.0), curve.name + ("" if curve.status != OPEN else ", not by itself"), "t-head")
    for column, axis in enumerate(axes):
        svg.text((LEFT + column * (width + GAP) + width / 2.0, 18.0), f"moving {axis}", "t-soft", anchor="middle")
    return svg.render()


def _draw(svg: Svg, panel: Panel, curve: MotionCurve) -> None:
    x, low, high = curve.position_mm, curve.value - COVERAGE * curve.u, curve.value + COVERAGE * curve.u
    edge = [panel.at(float(a), float(b)) for a, b in zip(x, high, strict=True)]
    edge += [panel.at(float(a), float(b)) for a, b in zip(x[::-1], low[::-1], strict=True)]
    svg.polygon(edge, "band")
    style = "s-c1 dash" if curve.status == OPEN else "s-c2"
    svg.polyline([panel.at(float(a), float(b)) for a, b in zip(x, curve.value, strict=True)], style)


def _describe(curves: Sequence[MotionCurve]) -> str:
    def one(c: MotionCurve) -> str:
        return f"{c.name} up to {plain(float(np.abs(c.value).max()))} ± {plain(COVERAGE * float(c.u.max()), 2)} {c.unit} ({c.status})"

    return "Value and U (k = 2): " + ("; ".join(one(c) for c in curves) or "none") + "."
