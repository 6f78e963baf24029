"""A plane through the machine's volume: commanded grid, grid with magnified errors, and an arrow at each node with a significant error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, draw_sequence, sequence_level
from abbe.service.rendering.numbers import MM, UM, Unit, placed, plain, tidy
from abbe.service.rendering.palette import SEQUENCE
from abbe.service.rendering.plots.isometric import round_down
from abbe.service.rendering.svg import Svg

Array = NDArray[np.float64]

WIDTH, SIDE, LEFT, TOP, BOTTOM = 620.0, 420.0, 74.0, 52.0, 104.0
MARGIN = 0.11
"""Margin for the magnified errors around the strokes, as a share of the longer stroke."""
HANDY = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
PLANES = {"XY": (0, 1, 2), "XZ": (0, 2, 1), "YZ": (1, 2, 0)}
"""Axes to the right, upwards and through the paper."""


@dataclass(frozen=True, slots=True, eq=False)
class SlicePlane:
    """Nodes of one plane, shape (a, b, 3), mm; deviation, µm; U (k = 2) of its length, µm; whether the length exceeds U, shape (a, b).

    Nodes in a single row (a = 1) are places without an order: no lines connect them.
    """

    plane: str
    grid_mm: Array
    deviation_um: Array
    expanded_um: Array
    significant: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SliceTexts:
    """Texts of the picture in the reader's language, and display units of positions and errors; without lines, ``nominal`` is empty."""

    heading: str
    nominal: str
    actual: str
    uncertain: str
    magnified: str
    place: Unit = MM
    error: Unit = UM


def colour_top(length: Array) -> float:
    """Upper end of the colour scale for these lengths: five equal round steps, at most a third longer than needed."""
    longest = float(length.max()) if length.size else 0.0
    if longest <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(longest / SEQUENCE))
    return SEQUENCE * power * next(m for m in HANDY if longest / SEQUENCE <= m * power * (1.0 + 1e-9))


def magnification(span_mm: float, longest_um: float) -> float:
    """Round factor at which the longest error spans at most a tenth of ``span_mm``."""
    return round_down(0.1 * span_mm / (longest_um * 1e-3)) if longest_um > 0.0 and span_mm > 0.0 else 1.0


def slice_plot(data: SlicePlane, top: float, magnified: float, texts: SliceTexts, *, key: str = "slice") -> str:
    """One plane. ``top``: upper end of the colours in the display unit; ``magnified``: mm drawn per mm of error."""
    across, up, _ = PLANES[data.plane]
    grid = data.grid_mm / texts.place.size
    low, high = grid.reshape(-1, 3).min(axis=0), grid.reshape(-1, 3).max(axis=0)
    size = max(float(high[across] - low[across]), float(high[up] - low[up]))
    pad = MARGIN * size
    scale = SIDE / (size + 2.0 * pad)
    width, height = (float(high[a] - low[a] + 2.0 * pad) * scale for a in (across, up))
    ranges = [(float(low[a] - pad), float(high[a] + pad)) for a in (across, up)]
    panel = Panel(LEFT, TOP, width, height, ranges[0], ranges[1])
    length = np.linalg.norm(data.deviation_um, axis=2) / texts.error.size
    sizes = f"{texts.heading}: {plain(float(length.min()))} … {plain(float(length.max()))} {texts.error.sign}"
    svg = Svg(WIDTH, TOP + height + BOTTOM, key, texts.heading, sizes)
    svg.text((LEFT, 18.0), texts.heading, "t-head")
    svg.text((LEFT, 36.0), texts.magnified, "t-soft")
    panel.draw_x(svg, f"{'XYZ'[across]} {texts.place.sign}", count=5)
    panel.draw_y(svg, f"{'XYZ'[up]} {texts.place.sign}", count=5)
    actual = grid + data.deviation_um * 1e-3 * magnified / texts.place.size
    known = np.where(data.significant[..., None], actual, np.nan)  # lines break at insignificant nodes
    for nodes, style in ((grid, "hidden-edge"), (known, "s-c2 thin")) if len(grid) > 1 else ():
        for line in (*nodes, *np.swapaxes(nodes, 0, 1)):
            svg.polyline([panel.at(float(p[across]), float(p[up])) for p in line], style)
    _arrows(svg, panel, data, (grid, actual), top, texts)
    panel.draw_frame(svg)
    _key(svg, TOP + height + 62.0, top, texts)
    return svg.render()


def _arrows(svg: Svg, panel: Panel, data: SlicePlane, ends: tuple[Array, Array], top: float, texts: SliceTexts) -> None:
    """Draw an arrow from each node of the first grid in ``ends`` to its actual position in the second; a circle if not significant."""
    across, up, _ = PLANES[data.plane]
    (grid, actual), unit = ends, texts.error
    for index in np.ndindex(data.significant.shape):
        node, error, expanded = grid[index], data.deviation_um[index] / unit.size, float(data.expanded_um[index]) / unit.size
        foot = panel.at(float(node[across]), float(node[up]))
        length = float(np.linalg.norm(error))
        place = ", ".join(placed(float(v), texts.place) for v in data.grid_mm[index])
        tip = f"({place}) {texts.place.sign}: {plain(length)} {unit.sign}, U = {plain(expanded, 2)} {unit.sign}"
        if not data.significant[index]:
            svg.circle(foot, 4.0, "frame")
            svg.dot(foot, 0.0, "key-head", tip)
            continue
        svg.arrow(foot, panel.at(float(actual[index][across]), float(actual[index][up])), f"seq{sequence_level(length, top)}", tip)


def _key(svg: Svg, y: float, top: float, texts: SliceTexts) -> None:
    """Key of the colours and lines."""
    cell = 52.0
    draw_sequence(svg, (LEFT, y), cell, top, texts.error.sign)
    svg.circle((LEFT + SEQUENCE * cell + 56.0, y + 4.0), 4.0, "frame")
    svg.text((LEFT + SEQUENCE * cell + 66.0, y + 9.0), texts.uncertain, "t-small")
    if texts.nominal:
        svg.legend((LEFT, y + 40.0), [("hidden-edge", texts.nominal), ("s-c2", texts.actual)])


def steps(top: float) -> list[str]:
    """Ends of the five colours as text, from zero to ``top``."""
    return [tidy(i * top / SEQUENCE) for i in range(SEQUENCE + 1)]
