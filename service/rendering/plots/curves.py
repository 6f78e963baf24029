"""Curves and readings over one abscissa: diagonals, compared runs, positioning tests, readings with fitted lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.model import Floats
from abbe.service.rendering.numbers import COVERAGE, UM, Unit, plain
from abbe.service.rendering.svg import Svg

Array = NDArray[np.float64]
WIDE, LEFT = 1010.0, 68.0

Curves = Mapping[str, tuple[Floats, Floats]]


def diagonal_plot(before: Curves, after: Curves, *, key: str = "diagonals") -> str:
    """Deviation along each body diagonal before and after the correction, on one ordinate (ISO 230-6).

    Curves: position in mm and deviation in µm by name of the diagonal, e.g. ``ppp``; one curve may run out and back.
    """
    cell, gap, top, columns = 150.0, 46.0, 44.0, 2
    names = list(dict.fromkeys([*before, *after]))
    rows = max(1, math.ceil(len(names) / columns))
    summary = "; ".join(f"{n}: range {_spread(before, n)} before, {_spread(after, n)} after" for n in names)
    height = top + rows * cell + (rows - 1) * gap + 48.0
    svg = Svg(WIDE, height, key, "Body diagonals", f"Deviation along the body diagonals. {summary}.")
    svg.legend((LEFT, 18.0), [("s-c1 dash", "before correction"), ("s-c2", "after correction")])
    y_range = data_range([float(v) for curves in (before, after) for _, y in curves.values() for v in y], zero=True)
    width = (WIDE - LEFT - 10.0 - (columns - 1) * 24.0) / columns
    for i, name in enumerate(names):
        row, column = divmod(i, columns)
        curves = [(c[name], style) for c, style in ((before, "s-c1 dash"), (after, "s-c2")) if name in c]
        x_range = data_range((float(v) for (x, _), _ in curves for v in x), margin=0.02)
        panel = Panel(LEFT + column * (width + 24.0), top + row * (cell + gap), width, cell, x_range, y_range)
        panel.draw_y(svg, "deviation in µm" if column == 0 else "", count=5, numbers=column == 0)
        panel.draw_x(svg, "along the diagonal in mm" if row == rows - 1 else "")
        for (x, y), style in curves:
            panel.draw_line(svg, x, y, style)
        panel.draw_frame(svg)
        svg.text((panel.left, panel.top - 7.0), name, "t-head")
        figures = f"range {_spread(before, name)} → {_spread(after, name)}"
        svg.text((panel.left + panel.width, panel.top - 7.0), figures, "t-small", anchor="end")
    return svg.render()


def _spread(curves: Curves, name: str) -> str:
    if name not in curves:
        return "n/a"
    values = np.asarray(curves[name][1], dtype=np.float64)
    values = values[np.isfinite(values)]
    return f"{plain(float(np.ptp(values)))} µm" if values.size else "n/a"


STYLES = ("s-c1 dash", "s-c2", "s-c3", "s-c4")
OVERLAY = (760.0, 330.0)
"""Width and height of a picture of compared runs."""


def overlay_plot(curves: Sequence[tuple[str, Array, Array]], *, key: str, heading: str, labels: tuple[str, str], unit: Unit = UM) -> str:
    """Up to four curves (name, abscissa, µm) on one scale; ``labels``: labels of both axes; ``unit``: display unit of the values."""
    curves = [(name, x, y / unit.size) for name, x, y in curves]
    summary = "; ".join(f"{name}: {plain(float(y.min()))} … {plain(float(y.max()))} {unit.sign}" for name, _, y in curves)
    svg = Svg(*OVERLAY, key, heading, f"{heading}. {summary}.")
    panel = _compared(svg, heading, labels, [x for _, x, _ in curves], [y for _, _, y in curves])
    for style, (_, x, y) in zip(STYLES, curves, strict=False):
        panel.draw_line(svg, x, y, style)
    panel.draw_frame(svg)
    svg.legend((LEFT, 38.0), [(style, name) for style, (name, _, _) in zip(STYLES, curves, strict=False)])
    return svg.render()


def difference_plot(x: Array, apart_um: Array, u_um: Array, *, key: str, heading: str, labels: tuple[str, str], unit: Unit = UM) -> str:
    """A difference with its U (k = 2), if known, as dashed lines about zero. A difference between the lines is not significant.

    ``labels``: labels of both axes; ``unit``: display unit of the values.
    """
    order = np.argsort(x, kind="stable")
    x, apart, expanded = x[order], apart_um[order] / unit.size, COVERAGE * u_um[order] / unit.size
    svg = Svg(*OVERLAY, key, heading, f"{heading}: {plain(float(np.abs(apart).max()))} {unit.sign}.")
    band = expanded[np.isfinite(expanded)]
    panel = _compared(svg, heading, labels, [x], [apart, band, -band])
    for sign in (1.0, -1.0):
        panel.draw_line(svg, x, sign * expanded, "band-edge")
    for at in panel.points(x, apart):
        svg.dot(at, 1.8, "f-c2")
    panel.draw_frame(svg)
    return svg.render()


def _compared(svg: Svg, heading: str, labels: tuple[str, str], xs: Sequence[Array], ys: Sequence[Array]) -> Panel:
    """Draw heading and axes of a picture with room for all values; return its panel."""
    svg.text((LEFT, 18.0), heading, "t-head")
    x_range = data_range((float(v) for x in xs for v in x), margin=0.02)
    y_range = data_range((float(v) for y in ys for v in y), zero=True)
    panel = Panel(LEFT, 48.0, OVERLAY[0] - LEFT - 12.0, OVERLAY[1] - 96.0, x_range, y_range)
    panel.draw_y(svg, labels[1])
    panel.draw_x(svg, labels[0])
    return panel


@dataclass(frozen=True, slots=True, eq=False)
class PositioningCurves:
    """Position in mm; mean deviations and standard deviations of both directions in µm (None: no repeats), shape (m,)."""

    label: str
    x_label: str
    position_mm: Array
    forward_um: Array
    backward_um: Array
    s_forward_um: Array | None = None
    s_backward_um: Array | None = None


def positioning_plot(curves: PositioningCurves, *, key: str, figures: str = "") -> str:
    """A bidirectional test as ISO 230-2 draws it: means of both directions with bars of ± two standard deviations.

    ``figures``: text for the heading.
    """
    width, height, left = 700.0, 300.0, 66.0
    sides = (
        (curves.forward_um, curves.s_forward_um, "c2", "moving in +"),
        (curves.backward_um, curves.s_backward_um, "c1", "moving in −"),
    )
    ends = [v for y, s, _, _ in sides for v in (y if s is None else np.concatenate([y - 2.0 * s, y + 2.0 * s])).tolist()]
    svg = Svg(width, height, key, f"Positioning {curves.label}", f"Mean deviation of both directions against {curves.x_label}. {figures}")
    svg.text((left, 16.0), curves.label, "t-head")
    svg.text((width - 10.0, 16.0), figures, "t-small", anchor="end")
    x_range = data_range(curves.position_mm.tolist(), margin=0.04)
    panel = Panel(left, 26.0, width - 76.0, height - 96.0, x_range, data_range(ends, zero=True))
    panel.draw_y(svg, "deviation in µm")
    panel.draw_x(svg, curves.x_label)
    for k, (y, s, role, _) in enumerate(sides):
        points = panel.points(curves.position_mm, y)
        svg.polyline(points, f"s-{role}" + (" dash" if k else ""))
        for at, half in zip(points, np.zeros(y.size) if s is None else 2.0 * s, strict=True):
            svg.dot(at, 2.2, f"f-{role}")
            if half > 0.0:
                # Shift the two directions so that neither hides the other.
                svg.error_bar((at[0] + (3.0 if k else -3.0), at[1]), float(panel.y(0.0) - panel.y(float(half))), cap=2.5)
    panel.draw_frame(svg)
    svg.legend((left, height - 8.0), [(f"s-{role}" + (" dash" if k else ""), name) for k, (_, _, role, name) in enumerate(sides)])
    return svg.render()


LINES = ("s-c2", "s-c3 dash", "s-c4 dots")


@dataclass(frozen=True, slots=True, eq=False)
class ComparedReadings:
    """Readings over a position, with lines that describe them, e.g. fits. Values in µm.

    ``lines``: up to three names with values at every position; the lower panel compares the readings with the first one.
    """

    x_label: str
    x: Array
    name: str
    readings_um: Array
    lines: tuple[tuple[str, Array], ...]


def comparison_plot(data: ComparedReadings, *, key: str, heading: str) -> str:
    """Upper panel: readings and lines; lower panel: readings minus the first line."""
    top, upper_height, gap, lower_height = 56.0, 250.0, 30.0, 120.0
    apart = data.readings_um - data.lines[0][1]
    size = np.abs(apart)
    summary = f"{data.name} − {data.lines[0][0]}: largest {plain(float(size.max()))} µm, mean size {plain(float(size.mean()))} µm"
    svg = Svg(WIDE, top + upper_height + gap + lower_height + 48.0, key, heading, summary)
    svg.text((LEFT, 18.0), heading, "t-head")
    svg.dot((LEFT + 8.0, 38.0), 3.5, "f-c1")
    svg.text((LEFT + 18.0, 42.0), data.name, "t-small")
    svg.legend((LEFT + 38.0 + 6.2 * len(data.name), 42.0), [(style, name) for style, (name, _) in zip(LINES, data.lines, strict=False)])
    x_range = data_range((float(v) for v in data.x), margin=0.02)
    everything = np.concatenate([data.readings_um, *(y for _, y in data.lines)])
    width, lower_top = WIDE - LEFT - 10.0, top + upper_height + gap
    upper = Panel(LEFT, top, width, upper_height, x_range, data_range(everything.tolist(), zero=True))
    lower = Panel(LEFT, lower_top, width, lower_height, x_range, data_range(apart.tolist(), zero=True, margin=0.12))
    upper.draw_y(svg, "deviation in µm")
    upper.draw_x(svg, numbers=False)
    lower.draw_y(svg, "dots − line in µm", count=4)
    lower.draw_x(svg, data.x_label, count=9)
    for style, (_, y) in zip(LINES, data.lines, strict=False):
        upper.draw_line(svg, data.x, y, style)
    for a, b, d in zip(data.x.tolist(), data.readings_um.tolist(), apart.tolist(), strict=True):
        tip = f"{plain(a, 4)} mm: {plain(b)} µm, {plain(d)} µm from the line"
        svg.dot(upper.at(a, b), 3.5, "f-c1", tip)
        svg.line(lower.at(a, 0.0), lower.at(a, d), "s-c1")
        svg.dot(lower.at(a, d), 3.5, "f-c1", tip)
    upper.draw_frame(svg)
    lower.draw_frame(svg)
    svg.text((LEFT + width, lower.top - 8.0), summary, "t-small", anchor="end")
    return svg.render()
