"""Nine tables before and after: three input axes across, three outputs down, old dashed, new with a band of its expanded uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.numbers import COVERAGE, plain, tidy
from abbe.service.rendering.svg import Svg

WIDTH, CELL_HEIGHT = 1010.0, 150.0
LEFT, GAP, TOP, BOTTOM = 68.0, 14.0, 46.0, 48.0
UM = 1e3
OLD, NEW = "s-c1 dash", "s-c2"


@dataclass(frozen=True, slots=True)
class CurveChange:
    """One table of two sets on the grid of the new one, mm. ``u_mm``: standard uncertainty of the new entries."""

    moved: str
    corrected: str
    position_mm: F1
    old_mm: F1
    new_mm: F1
    u_mm: F1

    @property
    def change_mm(self) -> F1:
        """New minus old."""
        return np.asarray(self.new_mm - self.old_mm)

    @property
    def worst(self) -> int:
        """Index of the largest change."""
        return int(np.abs(self.change_mm).argmax())


def change_plot(curves: Sequence[CurveChange], *, key: str = "change") -> str:
    """Corrections of up to nine tables in µm against the position in mm, on one ordinate."""
    inputs, outputs = (sorted({str(getattr(c, name)) for c in curves}) for name in ("moved", "corrected"))
    rows, columns = max(len(outputs), 1), max(len(inputs), 1)
    svg = Svg(WIDTH, TOP + rows * CELL_HEIGHT + (rows - 1) * GAP + BOTTOM, key, "Tables before and after", _describe(curves))
    ends = [float(v) * UM for c in curves for v in (*c.old_mm, *(c.new_mm - COVERAGE * c.u_mm), *(c.new_mm + COVERAGE * c.u_mm))]
    y_range = data_range(ends, zero=True)
    width = (WIDTH - LEFT - 10.0 - (columns - 1) * GAP) / columns
    svg.legend((LEFT, 14.0), [(OLD, "old"), (NEW, "new, with a band of U (k = 2)")])
    for curve in curves:
        row, column = outputs.index(curve.corrected), inputs.index(curve.moved)
        x_range = data_range((float(v) for v in curve.position_mm), margin=0.02)
        panel = Panel(LEFT + column * (width + GAP), TOP + row * (CELL_HEIGHT + GAP), width, CELL_HEIGHT, x_range, y_range)
        _draw_band(svg, panel, curve)
        panel.draw_y(svg, f"Δ{curve.corrected} in µm" if column == 0 else "", count=4, numbers=column == 0)
        panel.draw_x(svg, f"{curve.moved} in mm" if row == rows - 1 else "", count=5, numbers=row == rows - 1)
        _draw_curves(svg, panel, curve)
        panel.draw_frame(svg)
        svg.text((panel.left + 8.0, panel.top + 16.0), f"{curve.moved} → Δ{curve.corrected}", "t-head")
    for column, axis in enumerate(inputs):
        svg.text((LEFT + column * (width + GAP) + width / 2.0, TOP - 12.0), f"moving {axis}", "t-soft", anchor="middle")
    return svg.render()


def _draw_band(svg: Svg, panel: Panel, c: CurveChange) -> None:
    low, high = (UM * (c.new_mm + sign * COVERAGE * c.u_mm) for sign in (-1.0, 1.0))
    edge = [panel.at(float(x), float(y)) for x, y in zip(c.position_mm, high, strict=True)]
    edge += [panel.at(float(x), float(y)) for x, y in zip(c.position_mm[::-1], low[::-1], strict=True)]
    svg.polygon(edge, "band")


def _draw_curves(svg: Svg, panel: Panel, c: CurveChange) -> None:
    for style, values in ((OLD, c.old_mm * UM), (NEW, c.new_mm * UM)):
        svg.polyline((panel.at(float(x), float(y)) for x, y in zip(c.position_mm, values, strict=True)), style)
    for x, old, new, u in zip(c.position_mm, c.old_mm * UM, c.new_mm * UM, c.u_mm * UM, strict=True):
        tip = f"{c.moved} {tidy(float(x))} mm: {plain(float(old), 4)} → {plain(float(new), 4)} µm, U = {plain(COVERAGE * float(u), 2)} µm"
        svg.dot(panel.at(float(x), float(new)), 1.8, "f-c2", tip)


def _describe(curves: Sequence[CurveChange]) -> str:
    def one(c: CurveChange) -> str:
        return f"{c.moved} to {c.corrected} by up to {plain(float(np.abs(c.change_mm).max()) * UM)} µm"

    return "Largest changes: " + ("; ".join(one(c) for c in curves) or "none") + "."
