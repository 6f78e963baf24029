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
OLD, NEW = "s-c1 dash", "s-c2"


@dataclass(frozen=True)
class DiffCurve:
    """One table, old and new: positions in mm, corrections and standard uncertainty in µm, all of one shape."""

    axis_in: str
    axis_out: str
    position_mm: F1
    old_um: F1
    new_um: F1
    u_um: F1


def change_plot(curves: Sequence[DiffCurve], *, key: str = "change") -> str:
    """Corrections in µm against the position in mm, one ordinate for all.

    Parameters
    ----------
    curves : sequence of DiffCurve
        Up to nine.
    key : str, optional
        Identifier, unique in the page.
    """
    inputs, outputs = (sorted({str(getattr(c, name)) for c in curves}) for name in ("axis_in", "axis_out"))
    rows, columns = max(len(outputs), 1), max(len(inputs), 1)
    svg = Svg(WIDTH, TOP + rows * CELL_HEIGHT + (rows - 1) * GAP + BOTTOM, key, "Tables before and after", _describe(curves))
    ends = [float(v) for c in curves for v in (*c.old_um, *(c.new_um - COVERAGE * c.u_um), *(c.new_um + COVERAGE * c.u_um))]
    y_range = data_range(ends, zero=True)
    width = (WIDTH - LEFT - 10.0 - (columns - 1) * GAP) / columns
    svg.legend((LEFT, 14.0), [(OLD, "old"), (NEW, "new, with a band of U (k = 2)")])
    for curve in curves:
        row, column = outputs.index(curve.axis_out), inputs.index(curve.axis_in)
        x_range = data_range((float(v) for v in curve.position_mm), margin=0.02)
        panel = Panel(LEFT + column * (width + GAP), TOP + row * (CELL_HEIGHT + GAP), width, CELL_HEIGHT, x_range, y_range)
        _draw_band(svg, panel, curve)
        panel.draw_y(svg, f"Δ{curve.axis_out} in µm" if column == 0 else "", count=4, numbers=column == 0)
        panel.draw_x(svg, f"{curve.axis_in} in mm" if row == rows - 1 else "", count=5, numbers=row == rows - 1)
        _draw_curves(svg, panel, curve)
        panel.draw_frame(svg)
        svg.text((panel.left + 8.0, panel.top + 16.0), f"{curve.axis_in} → Δ{curve.axis_out}", "t-head")
    for column, axis in enumerate(inputs):
        svg.text((LEFT + column * (width + GAP) + width / 2.0, TOP - 12.0), f"moving {axis}", "t-soft", anchor="middle")
    return svg.render()


def _draw_band(svg: Svg, panel: Panel, c: DiffCurve) -> None:
    low, high = c.new_um - COVERAGE * c.u_um, c.new_um + COVERAGE * c.u_um
    edge = [panel.at(float(x), float(y)) for x, y in zip(c.position_mm, high, strict=True)]
    edge += [panel.at(float(x), float(y)) for x, y in zip(c.position_mm[::-1], low[::-1], strict=True)]
    svg.polygon(edge, "band")


def _draw_curves(svg: Svg, panel: Panel, c: DiffCurve) -> None:
    for style, values in ((OLD, c.old_um), (NEW, c.new_um)):
        svg.polyline((panel.at(float(x), float(y)) for x, y in zip(c.position_mm, values, strict=True)), style)
    for x, old, new, u in zip(c.position_mm, c.old_um, c.new_um, c.u_um, strict=True):
        tip = f"{c.axis_in} {tidy(float(x))} mm: {plain(float(old), 4)} → {plain(float(new), 4)} µm, U = {plain(COVERAGE * float(u), 2)} µm"
        svg.dot(panel.at(float(x), float(new)), 1.8, "f-c2", tip)


def _describe(curves: Sequence[DiffCurve]) -> str:
    def one(c: DiffCurve) -> str:
        return f"{c.axis_in} to {c.axis_out} by up to {plain(float(np.abs(c.new_um - c.old_um).max()))} µm"

    return "Largest changes: " + ("; ".join(one(c) for c in curves) or "none") + "."
