"""Nine panels, three moved axes across and three components down: error motions, tables of a controller, tables before and after."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.rendering.axes import Panel, PanelGrid, data_range, nice_step, ticks
from abbe.service.rendering.model import MotionCurve, TableCurve
from abbe.service.rendering.numbers import COVERAGE, finite, plain, tidy
from abbe.service.rendering.svg import Svg

NOT_OBSERVABLE = "not observable"
LSB_LINES = 24
"""Largest number of drawn levels; more are indistinguishable."""
UM = 1e3
OLD, NEW = "s-c1 dash", "s-c2"


def motion_bands(curves: Sequence[MotionCurve], *, key: str, link: str = "") -> str:
    """Error motions of one unit over their strokes, each with a band of U (k = 2); those not observable by themselves are dashed.

    ``link``: address to which the name of a motion is appended for its screen; empty: the panels have no links.
    """
    unit = curves[0].unit if curves else ""
    ends = [v for c in curves for v in (float((c.value - COVERAGE * c.u).min()), float((c.value + COVERAGE * c.u).max()))]
    names = sorted({c.name[1] for c in curves}), sorted({c.axis for c in curves})
    grid = PanelGrid(*names, cell_height=132.0, gap=30.0, top=30.0, y_range=data_range(ends, zero=True))
    svg = Svg(grid.WIDTH, grid.height, key, f"Error motions in {unit}", f"Value and U (k = 2): {_listed(map(_motion, curves))}.")
    for c in curves:
        cell = (c.name[1], c.axis)
        panel = grid.panel(*cell, (float(c.position_mm[0]), float(c.position_mm[-1])))
        panel.draw_band(svg, c.position_mm, c.value - COVERAGE * c.u, c.value + COVERAGE * c.u)
        panel.draw_line(svg, c.position_mm, c.value, "s-c1 dash" if c.status == NOT_OBSERVABLE else "s-c2")
        grid.draw_axes(svg, panel, cell, (f"{c.axis} in mm", f"E{c.name[1]} in {unit}"))
        _finish(svg, panel, c.name + ("" if c.status != NOT_OBSERVABLE else ", not by itself"))
        if link:
            svg.link((panel.left, panel.top), (panel.width, panel.height), link + c.name)
    grid.draw_columns(svg, 18.0)
    return svg.render()


def table_plot(tables: Sequence[TableCurve], *, lsb_um: float | None = None, key: str = "tables") -> str:
    """Correction in µm, which the controller adds to the command, against the position in mm.

    Up to nine curves; a missing one leaves its cell empty. ``lsb_um``: resolution of the controller, drawn as levels if coarse enough.
    """
    names = sorted({str(t.axis_out) for t in tables}), sorted({str(t.axis_in) for t in tables})
    y_range = data_range((float(v) for t in tables for v in t.correction_um), zero=True)
    grid = PanelGrid(*names, cell_height=150.0, gap=14.0, top=30.0, y_range=y_range)
    step = f" in steps of {tidy(lsb_um)} µm" if finite(lsb_um) else ""
    summary = f"Largest corrections: {_listed(map(_correction, tables))}. Corrections are added to the command{step}."
    svg = Svg(grid.WIDTH, grid.height, key, "Compensation tables", summary)
    for cell in ((row, column) for row in grid.rows for column in grid.columns):
        axis_out, axis_in = cell
        x_range = data_range((float(v) for t in tables if t.axis_in == axis_in for v in t.position_mm), margin=0.02)
        panel = grid.panel(*cell, x_range)
        grid.draw_axes(svg, panel, cell, (f"{axis_in} in mm", f"Δ{axis_out} in µm"))
        _draw_levels(svg, panel, lsb_um)
        for curve in tables:
            if (curve.axis_in, curve.axis_out) == (axis_in, axis_out):
                _draw_table(svg, panel, curve)
        _finish(svg, panel, f"{axis_in} → Δ{axis_out}")
    grid.draw_columns(svg, 18.0)
    return svg.render()


@dataclass(frozen=True, slots=True)
class CurveChange:
    """One of the nine tables before and after a change, on the grid of the new one. ``u_mm``: standard uncertainty of the new entries."""

    moved: str
    corrected: str
    position_mm: F1
    old_mm: F1
    new_mm: F1
    u_mm: F1

    @property
    def change_mm(self) -> F1:
        """New minus old entries of the table, mm."""
        return np.asarray(self.new_mm - self.old_mm)

    @property
    def worst(self) -> int:
        """Index of the largest change."""
        return int(np.abs(self.change_mm).argmax())


def change_plot(curves: Sequence[CurveChange], *, key: str = "change") -> str:
    """Up to nine tables in µm against the position in mm: old dashed, new with a band of U (k = 2)."""
    names = sorted({str(c.corrected) for c in curves}), sorted({str(c.moved) for c in curves})
    ends = [float(v) * UM for c in curves for v in (*c.old_mm, *(c.new_mm - COVERAGE * c.u_mm), *(c.new_mm + COVERAGE * c.u_mm))]
    grid = PanelGrid(*names, cell_height=150.0, gap=14.0, top=46.0, y_range=data_range(ends, zero=True))
    svg = Svg(grid.WIDTH, grid.height, key, "Tables before and after", f"Largest changes: {_listed(map(_change, curves))}.")
    svg.legend((grid.LEFT, 14.0), [(OLD, "old"), (NEW, "new, with a band of U (k = 2)")])
    for c in curves:
        cell = (c.corrected, c.moved)
        panel = grid.panel(*cell, data_range((float(v) for v in c.position_mm), margin=0.02))
        low, high = (UM * (c.new_mm + sign * COVERAGE * c.u_mm) for sign in (-1.0, 1.0))
        panel.draw_band(svg, c.position_mm, low, high)
        grid.draw_axes(svg, panel, cell, (f"{c.moved} in mm", f"Δ{c.corrected} in µm"))
        panel.draw_line(svg, c.position_mm, c.old_mm * UM, OLD)
        panel.draw_line(svg, c.position_mm, c.new_mm * UM, NEW)
        _draw_changes(svg, panel, c)
        _finish(svg, panel, f"{c.moved} → Δ{c.corrected}")
    grid.draw_columns(svg, 34.0)
    return svg.render()


def _finish(svg: Svg, panel: Panel, name: str) -> None:
    panel.draw_frame(svg)
    svg.text((panel.left + 8.0, panel.top + 16.0), name, "t-head")


def _draw_table(svg: Svg, panel: Panel, curve: TableCurve) -> None:
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


def _draw_changes(svg: Svg, panel: Panel, c: CurveChange) -> None:
    for x, old, new, u in zip(c.position_mm, c.old_mm * UM, c.new_mm * UM, c.u_mm * UM, strict=True):
        tip = f"{c.moved} {tidy(float(x))} mm: {plain(float(old), 4)} → {plain(float(new), 4)} µm, U = {plain(COVERAGE * float(u), 2)} µm"
        svg.dot(panel.at(float(x), float(new)), 1.8, "f-c2", tip)


def _listed(texts: Iterable[str]) -> str:
    return "; ".join(texts) or "none"


def _motion(c: MotionCurve) -> str:
    return f"{c.name} up to {plain(float(np.abs(c.value).max()))} ± {plain(COVERAGE * float(c.u.max()), 2)} {c.unit} ({c.status})"


def _correction(table: TableCurve) -> str:
    good = [abs(float(v)) for v in table.correction_um if math.isfinite(float(v))]
    return f"{table.axis_in} to {table.axis_out} up to {plain(max(good, default=math.nan))} µm"


def _change(c: CurveChange) -> str:
    return f"{c.moved} to {c.corrected} by up to {plain(float(np.abs(c.change_mm).max()) * UM)} µm"
