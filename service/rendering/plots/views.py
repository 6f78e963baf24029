"""A campaign's paths in the machine's volume: three views of a drawing (above, front, side), or one isometric view of the set-ups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel
from abbe.service.rendering.numbers import MM, Unit
from abbe.service.rendering.plots.isometric import Paper, ViewWindow, depth, draw_box, label_edges
from abbe.service.rendering.svg import Svg

F2 = NDArray[np.float64]
F1 = NDArray[np.float64]

WIDTH, HEIGHT = 760.0, 760.0
SIDE = 300.0
MAX_POINTS = 600
"""Largest number of points per drawn path; more are indistinguishable."""
STYLES = {"bar": "c1", "laser": "c2"}
VIEWS = ((0, 1, "from above"), (0, 2, "from the front"), (1, 2, "from the side"))
CORNERS = ((70.0, 40.0), (70.0, 420.0), (450.0, 420.0))


@dataclass(frozen=True, slots=True)
class DrawnTest:
    """One test, planned or rehearsed, in space.

    Parameters
    ----------
    number : int
        Number of the test or of its set-up in the campaign, from 1.
    kind : "bar", "laser", "line" or "diagonal"
    text : str
        Tooltip.
    path_mm : array, shape (n, 3)
        Commanded positions, in order.
    mount_mm : array, shape (3,)
        Position of the cup, or start of the laser line.
    radius_mm : float
        Radius of the bar, 0 for a laser.
    mounts : bool
        Whether the test begins a set-up, whose number is then drawn.
    """

    number: int
    kind: str
    text: str
    path_mm: F2
    mount_mm: F1
    radius_mm: float = 0.0
    mounts: bool = True


def three_views(stroke_mm: F2, tests: Sequence[DrawnTest], *, key: str = "views", unit: Unit = MM) -> str:
    """Paths of all tests (in the order of measuring) in three views with one scale, strokes as frames, set-ups with their numbers.

    ``stroke_mm``: first and last position of X, Y, Z, shape (3, 2). ``unit``: display unit of positions.
    """
    summary = "; ".join(f"{t.number}: {t.text}" for t in tests)
    svg = Svg(WIDTH, HEIGHT, key, f"Paths of {len(tests)} tests in three views", summary)
    size = float((stroke_mm[:, 1] - stroke_mm[:, 0]).max()) * 1.04
    for (a, b, title), corner in zip(VIEWS, CORNERS, strict=True):
        middle = stroke_mm.mean(axis=1)
        low = middle - 0.5 * size
        panel = Panel(*corner, SIDE, SIDE, (low[a], low[a] + size), (low[b], low[b] + size))
        _draw_scales(svg, panel, (a, b), unit)
        svg.text((corner[0], corner[1] - 8.0), title, "t-head")
        first, last = panel.at(stroke_mm[a, 0], stroke_mm[b, 1]), panel.at(stroke_mm[a, 1], stroke_mm[b, 0])
        svg.rect(first, (last[0] - first[0], last[1] - first[1]), "ring-zero", "strokes")
        for test in tests:
            _draw(svg, panel, test, (a, b))
        for test in tests:
            if test.mounts:
                x, y = panel.at(test.mount_mm[a], test.mount_mm[b])
                svg.dot((x, y), 4.0, f"f-{STYLES[test.kind]}", test.text)
                svg.text((x + 6.0, y - 5.0), test.number, "t-head t-halo")
    names = {"bar": "ball-bar: path, its bar, cup", "laser": "laser: path, where it starts"}
    used = [k for k in STYLES if any(t.kind == k for t in tests)]
    svg.legend((450.0, 70.0), [(f"s-{STYLES[used[0]]}", names[used[0]])] if used else [])
    if len(used) > 1:
        svg.legend((450.0, 92.0), [(f"s-{STYLES[used[1]]}", names[used[1]])])
    svg.text((450.0, 120.0), "grey frame: strokes of the axes", "t-small")
    return svg.render()


def _draw_scales(svg: Svg, panel: Panel, plane: tuple[int, int], unit: Unit) -> None:
    """Grid and numbers at round values of the display unit."""
    (x_low, x_high), (y_low, y_high) = ((low / unit.size, high / unit.size) for low, high in (panel.x_range, panel.y_range))
    scaled = replace(panel, x_range=(x_low, x_high), y_range=(y_low, y_high))
    scaled.draw_x(svg, f"{'XYZ'[plane[0]]} {unit.sign}")
    scaled.draw_y(svg, f"{'XYZ'[plane[1]]} {unit.sign}")


def _draw(svg: Svg, panel: Panel, test: DrawnTest, plane: tuple[int, int]) -> None:
    a, b = plane
    path = test.path_mm[:: max(1, len(test.path_mm) // MAX_POINTS)]
    svg.polyline([panel.at(p[a], p[b]) for p in (*path, test.path_mm[-1])], f"s-{STYLES[test.kind]} thin")
    if test.radius_mm:
        end = test.path_mm[0]
        svg.line(panel.at(test.mount_mm[a], test.mount_mm[b]), panel.at(end[a], end[b]), "key")
        svg.dot(panel.at(end[a], end[b]), 2.5, "key-head", f"{test.number}: the bar where its path begins")


SETUP_STYLES = {"bar": "c1", "line": "c2", "diagonal": "c3"}
SETUP_NAMES = {"bar": "ball-bar, its cup", "line": "laser along an axis", "diagonal": "laser along a body diagonal"}


def setups_picture(stroke_mm: F2, paths: Sequence[DrawnTest], *, key: str = "setups") -> str:
    """Isometric view of the strokes, shape (3, 2), with all paths in the order of measuring and the numbers of their set-ups."""
    width, height = 760.0, 620.0
    count = len({p.number for p in paths})
    summary = "; ".join(f"{p.number}: {p.text}" for p in paths)
    svg = Svg(width, height, key, f"{count} set-ups in the machine's volume", summary)
    low, high = stroke_mm[:, 0], stroke_mm[:, 1]
    paper = Paper.around(low, high, ViewWindow((width / 2.0, height / 2.0 - 14.0), width - 150.0, height - 130.0))
    draw_box(svg, paper, low, high)
    middles = np.array([p.path_mm.mean(axis=0) for p in paths]).reshape(-1, 3)
    for i in np.argsort(depth(middles), kind="stable"):  # far ones first, near ones on top
        path = paths[int(i)]
        thinned = path.path_mm[:: max(1, len(path.path_mm) // 400)]
        svg.polyline([paper(point) for point in (*thinned, path.path_mm[-1])], f"s-{SETUP_STYLES[path.kind]} thin")
    for path in {p.number: p for p in reversed(paths)}.values():
        x, y = paper(path.mount_mm)
        svg.dot((x, y), 4.0, f"f-{SETUP_STYLES[path.kind]}", path.text)
        svg.text((x + 7.0, y - 5.0), path.number, "t-head t-halo")
    label_edges(svg, paper, low, high)
    used = [k for k in SETUP_STYLES if any(p.kind == k for p in paths)]
    svg.legend((30.0, height - 12.0), [(f"s-{SETUP_STYLES[k]}", SETUP_NAMES[k]) for k in used])
    return svg.render()
