"""Readings with fitted lines, and their differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.numbers import plain
from abbe.service.rendering.svg import Svg

Array = NDArray[np.float64]

WIDTH, UPPER, LOWER = 1010.0, 250.0, 120.0
LEFT, TOP, GAP, BOTTOM = 68.0, 56.0, 30.0, 48.0
LINES = ("s-c2", "s-c3 dash", "s-c4 dots")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Readings over a position with the lines that describe them. Values in um.

    ``lines``: up to three names with values at every position; the lower panel compares the readings with the first one.
    """

    x_label: str
    x: Array
    name: str
    readings_um: Array
    lines: tuple[tuple[str, Array], ...]


def comparison_plot(data: Comparison, *, key: str, heading: str) -> str:
    """Upper panel: readings and lines; lower panel: readings minus the first line."""
    apart = data.readings_um - data.lines[0][1]
    size = np.abs(apart)
    summary = f"{data.name} − {data.lines[0][0]}: largest {plain(float(size.max()))} µm, mean size {plain(float(size.mean()))} µm"
    svg = Svg(WIDTH, TOP + UPPER + GAP + LOWER + BOTTOM, key, heading, summary)
    svg.text((LEFT, 18.0), heading, "t-head")
    svg.dot((LEFT + 8.0, 38.0), 3.5, "f-c1")
    svg.text((LEFT + 18.0, 42.0), data.name, "t-small")
    svg.legend((LEFT + 38.0 + 6.2 * len(data.name), 42.0), [(style, name) for style, (name, _) in zip(LINES, data.lines, strict=False)])
    x_range = data_range((float(v) for v in data.x), margin=0.02)
    everything = np.concatenate([data.readings_um, *(y for _, y in data.lines)])
    width = WIDTH - LEFT - 10.0
    upper = Panel(LEFT, TOP, width, UPPER, x_range, data_range((float(v) for v in everything), zero=True))
    lower = Panel(LEFT, TOP + UPPER + GAP, width, LOWER, x_range, data_range((float(v) for v in apart), zero=True, margin=0.12))
    upper.draw_y(svg, "deviation in µm")
    upper.draw_x(svg, numbers=False)
    lower.draw_y(svg, "dots − line in µm", count=4)
    lower.draw_x(svg, data.x_label, count=9)
    for style, (_, y) in zip(LINES, data.lines, strict=False):
        upper_points = [upper.at(float(a), float(b)) for a, b in zip(data.x, y, strict=True)]
        svg.polyline(upper_points, style)
    for a, b, d in zip(data.x, data.readings_um, apart, strict=True):
        tip = f"{plain(float(a), 4)} mm: {plain(float(b))} µm, {plain(float(d))} µm from the line"
        svg.dot(upper.at(float(a), float(b)), 3.5, "f-c1", tip)
        svg.line(lower.at(float(a), 0.0), lower.at(float(a), float(d)), "s-c1")
        svg.dot(lower.at(float(a), float(d)), 3.5, "f-c1", tip)
    upper.draw_frame(svg)
    lower.draw_frame(svg)
    svg.text((LEFT + width, lower.top - 8.0), summary, "t-small", anchor="end")
    return svg.render()
