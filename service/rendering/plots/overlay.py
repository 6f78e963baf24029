"""Curves over one abscissa on one scale, and a difference with the band of its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.numbers import COVERAGE, UM, Unit, plain
from abbe.service.rendering.svg import Svg

Array = NDArray[np.float64]

WIDTH, HEIGHT, LEFT, TOP = 760.0, 330.0, 68.0, 48.0
STYLES = ("s-c1 dash", "s-c2", "s-c3", "s-c4")


def overlay_plot(curves: Sequence[tuple[str, Array, Array]], *, key: str, heading: str, labels: tuple[str, str], unit: Unit = UM) -> str:
    """Up to four curves (name, abscissa, µm) on one scale; ``labels``: of both axes; ``unit``: display unit of the values."""
    curves = [(name, x, y / unit.size) for name, x, y in curves]
    summary = "; ".join(f"{name}: {plain(float(y.min()))} … {plain(float(y.max()))} {unit.sign}" for name, _, y in curves)
    svg = Svg(WIDTH, HEIGHT, key, heading, f"{heading}. {summary}.")
    svg.text((LEFT, 18.0), heading, "t-head")
    panel = _panel([x for _, x, _ in curves], [y for _, _, y in curves])
    panel.draw_y(svg, labels[1])
    panel.draw_x(svg, labels[0])
    for style, (_, x, y) in zip(STYLES, curves, strict=False):
        svg.polyline([panel.at(float(a), float(b)) for a, b in zip(x, y, strict=True)], style)
    panel.draw_frame(svg)
    svg.legend((LEFT, 38.0), [(style, name) for style, (name, _, _) in zip(STYLES, curves, strict=False)])
    return svg.render()


def difference_plot(x: Array, apart_um: Array, u_um: Array, *, key: str, heading: str, labels: tuple[str, str], unit: Unit = UM) -> str:
    """A difference with its U (k = 2), if known, as dashed lines about zero. A difference between the lines is not significant.

    ``labels``: of both axes; ``unit``: display unit of the values.
    """
    order = np.argsort(x, kind="stable")
    x, apart, expanded = x[order], apart_um[order] / unit.size, COVERAGE * u_um[order] / unit.size
    largest = plain(float(np.abs(apart).max()))
    svg = Svg(WIDTH, HEIGHT, key, heading, f"{heading}: {largest} {unit.sign}.")
    svg.text((LEFT, 18.0), heading, "t-head")
    band = expanded[np.isfinite(expanded)]
    panel = _panel([x], [apart, band, -band])
    panel.draw_y(svg, labels[1])
    panel.draw_x(svg, labels[0])
    for sign in (1.0, -1.0):
        svg.polyline([panel.at(float(a), float(sign * b)) for a, b in zip(x, expanded, strict=True)], "band-edge")
    for a, b in zip(x, apart, strict=True):
        svg.dot(panel.at(float(a), float(b)), 1.8, "f-c2")
    panel.draw_frame(svg)
    return svg.render()


def _panel(xs: Sequence[Array], ys: Sequence[Array]) -> Panel:
    x_range = data_range((float(v) for x in xs for v in x), margin=0.02)
    y_range = data_range((float(v) for y in ys for v in y), zero=True)
    return Panel(LEFT, TOP, WIDTH - LEFT - 12.0, HEIGHT - TOP - 48.0, x_range, y_range)
