"""Rectangles of colour: a map of uncertainty over a plane of the volume, and a matrix of correlations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.service.rendering.axes import Panel, round_up
from abbe.service.rendering.model import Correlations, Slice
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.palette import SEQUENCE
from abbe.service.rendering.plots.signed import SignedScale
from abbe.service.rendering.svg import Svg

WIDTH, HEIGHT = 500.0, 420.0
LEFT, TOP, RIGHT, BOTTOM = 62.0, 48.0, 20.0, 96.0
LABELS, CELL, HEAD = 128.0, 22.0, 40.0


def common_step(slices: Sequence[Slice]) -> float:
    """Common width of a colour band for all slices, µm."""
    largest = max((float(np.nanmax(s.values)) for s in slices), default=0.0)
    return round_up(largest / SEQUENCE) if largest > 0.0 else 1.0


def slice_plot(found: Slice, step: float, *, key: str, heading: str) -> str:
    """One plane of the volume, a cell per node; dark is large. ``step``: width of a colour band, µm, from `common_step`."""
    low, high = float(np.nanmin(found.values)), float(np.nanmax(found.values))
    summary = f"from {plain(low)} to {plain(high)} µm, {found.at}"
    svg = Svg(WIDTH, HEIGHT, key, heading, f"Map over a plane: {summary}.")
    svg.text((WIDTH / 2.0, 18.0), heading, "t-head", anchor="middle")
    svg.text((WIDTH / 2.0, 36.0), summary, "t-soft", anchor="middle")
    dx, dy = (0.5 * float(v[1] - v[0]) for v in (found.x_mm, found.y_mm))
    ranges = (float(found.x_mm[0]) - dx, float(found.x_mm[-1]) + dx), (float(found.y_mm[0]) - dy, float(found.y_mm[-1]) + dy)
    panel = Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, *ranges)
    size = (panel.width / len(found.x_mm) + 0.6, panel.height / len(found.y_mm) + 0.6)  # cells overlap slightly to hide seams
    for j, y in enumerate(found.y_mm):
        for i, x in enumerate(found.x_mm):
            value = float(found.values[j, i])
            band = 1 + min(SEQUENCE - 1, int(value / step))
            tip = f"{found.x_axis} {tidy(float(x))}, {found.y_axis} {tidy(float(y))} mm: {plain(value)} µm"
            svg.rect(panel.at(float(x) - dx, float(y) + dy), size, f"f-seq{band}", tip)
    panel.draw_x(svg, f"{found.x_axis} in mm")
    panel.draw_y(svg, f"{found.y_axis} in mm")
    panel.draw_frame(svg)
    left, cell = WIDTH / 2.0 - 2.5 * 56.0, 56.0
    for i in range(SEQUENCE):
        svg.rect((left + i * cell, HEIGHT - 34.0), (cell, 9.0), f"f-seq{i + 1}")
        svg.text((left + i * cell, HEIGHT - 11.0), tidy(i * step), "t-small", anchor="middle")
    svg.text((left + SEQUENCE * cell, HEIGHT - 11.0), f"{tidy(SEQUENCE * step)} µm", "t-small", anchor="middle")
    return svg.render()


def correlation_plot(found: Correlations, *, key: str = "correlations") -> str:
    """Matrix of correlations: blue below zero, orange above, with the number as tooltip."""
    n = len(found.names)
    side = n * CELL
    scale = SignedScale(0.25)
    strong = [
        f"{found.names[i]} and {found.names[j]} {found.matrix[i, j]:+.2f}"
        for i in range(n)
        for j in range(i)
        if abs(found.matrix[i, j]) > 0.9
    ]
    width = max(LABELS + side + 20.0, LABELS + 350.0)
    svg = Svg(width, HEAD + side + LABELS + 40.0, key, "Correlation of parameters", "Above 0.9: " + ("; ".join(strong) or "none") + ".")
    svg.text((10.0, 18.0), "Correlation of the parameters that go together most", "t-head")
    for i, name in enumerate(found.names):
        svg.text((LABELS - 8.0, HEAD + (i + 0.7) * CELL), name[:20], "t-small", anchor="end")
        svg.text((LABELS + (i + 0.7) * CELL, HEAD + side + 8.0), name[:20], "t-small", anchor="end", turn=-90.0)
        for j in range(n):
            r = float(found.matrix[i, j])
            tip = f"{name} and {found.names[j]}: {r:+.3f}"
            svg.rect((LABELS + j * CELL, HEAD + i * CELL), (CELL - 1.0, CELL - 1.0), scale.style(min(r, 0.999)), tip)
    scale.draw_bar(svg, (LABELS, HEAD + side + LABELS), "", 40.0)
    return svg.render()
