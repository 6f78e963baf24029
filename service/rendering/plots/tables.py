"""The nine one-axis tables as the controller holds them: three input axes across, three outputs down, one common ordinate."""

from __future__ import annotations

import math
from collections.abc import Sequence

from abbe.service.rendering.axes import Panel, data_range, nice_step, ticks
from abbe.service.rendering.model import TableCurve
from abbe.service.rendering.numbers import finite, plain, tidy
from abbe.service.rendering.svg import Svg

WIDTH, CELL_HEIGHT = 1010.0, 150.0
LEFT, GAP, TOP, BOTTOM = 68.0, 14.0, 30.0, 48.0
LSB_LINES = 24
"""Largest number of drawn levels; more are indistinguishable."""


def table_plot(tables: Sequence[TableCurve], *, lsb_um: float | None = None, key: str = "tables") -> str:
    """Correction in µm, which the controller adds to the command, against the position in mm.

    Up to nine curves; a missing one leaves its cell empty. ``lsb_um``: resolution of the controller, drawn as levels if coarse enough.
    """
    axes_in, axes_out = (sorted({str(getattr(t, name)) for t in tables}) for name in ("axis_in", "axis_out"))
    rows, columns = max(len(axes_out), 1), max(len(axes_in), 1)
    height = TOP + rows * CELL_HEIGHT + (rows - 1) * GAP + BOTTOM
    step = f" in steps of {tidy(lsb_um)} µm" if finite(lsb_um) else ""
    svg = Svg(WIDTH, height, key, "Compensation tables", _describe(tables) + f" Corrections are added to the command{step}.")
    y_range = data_range((float(v) for t in tables for v in t.correction_um), zero=True)
    width = (WIDTH - LEFT - 10.0 - (columns - 1) * GAP) / columns
    for row, axis_out in enumerate(axes_out):
        for column, axis_in in enumerate(axes_in):
            curves = [t for t in tables if (t.axis_in, t.axis_out) == (axis_in, axis_out)]
            x_range = data_range((float(v) for t in tables if t.axis_in == axis_in for v in t.position_mm), margin=0.02)
            panel = Panel(LEFT + column * (width + GAP), TOP + row * (CELL_HEIGHT + GAP), width, CELL_HEIGHT, x_range, y_range)
            panel.draw_y(svg, f"Δ{axis_out} in µm" if column == 0 else "", count=4, numbers=column == 0)
            panel.draw_x(svg, f"{axis_in} in mm" if row == rows - 1 else "", count=5, numbers=row == rows - 1)
            _draw_levels(svg, panel, lsb_um)
            for curve in curves:
                _draw_curve(svg, panel, curve)
            panel.draw_frame(svg)
            svg.text((panel.left + 8.0, panel.top + 16.0), f"{axis_in} → Δ{axis_out}", "t-head")
    for column, axis_in in enumerate(axes_in):
        svg.text((LEFT + column * (width + GAP) + width / 2.0, 18.0), f"moving {axis_in}", "t-soft", anchor="middle")
    return svg.render()


def _draw_curve(svg: Svg, panel: Panel, curve: TableCurve) -> None:
    pairs = [(float(x), float(y)) for x, y in zip(curve.position_mm, curve.correction_um, strict=False)]
    svg.polyline((panel.at(x, y) if math.isfinite(x) and math.isfinite(y) else (math.nan, math.nan) for x, y in pairs), "s-c2")
    for x, y in pairs:
        if math.isfinite(x) and math.isfinite(y):
            tip = f"{curve.axis_in} {tidy(x)} mm: {plain(y, 4)} µm added to {curve.axis_out}"
            svg.dot(panel.at(x, y), 1.8 if len(pairs) < 80 else 1.1, "f-c2", tip)


def _draw_levels(svg: Svg, panel: Panel, lsb_um: float | None) -> None:
    low, high = panel.y_range
    if not finite(lsb_um) or lsb_um <= 0.0 or (high - low) / lsb_um > LSB_LINES:
        return
    big = {round(v / lsb_um) for v in ticks(low, high, 4)} if nice_step(high - low, 4) >= lsb_um else set()
    for level in range(math.ceil(low / lsb_um), math.floor(high / lsb_um) + 1):
        if level not in big:
            y = panel.y(level * lsb_um)
            svg.line((panel.left, y), (panel.left + panel.width, y), "grid dots")


def _describe(tables: Sequence[TableCurve]) -> str:
    def extreme(table: TableCurve) -> str:
        good = [abs(float(v)) for v in table.correction_um if math.isfinite(float(v))]
        return f"{table.axis_in} to {table.axis_out} up to {plain(max(good, default=math.nan))} µm"

    return "Largest corrections: " + ("; ".join(extreme(t) for t in tables) or "none") + "."
