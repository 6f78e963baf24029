"""Set-ups of a planned campaign: every path in the machine's volume, numbered in the order of measuring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.plots.isometric import Paper, ViewWindow, depth, draw_box, label_edges
from abbe.service.rendering.plots.views import DrawnTest
from abbe.service.rendering.svg import Svg

F2 = NDArray[np.float64]

WIDTH, HEIGHT = 760.0, 620.0
MAX_POINTS = 400
"""Largest number of points per drawn path; more are indistinguishable."""
STYLES = {"bar": "c1", "line": "c2", "diagonal": "c3"}
NAMES = {"bar": "ball-bar, its cup", "line": "laser along an axis", "diagonal": "laser along a body diagonal"}


def setups_picture(stroke_mm: F2, paths: Sequence[DrawnTest], *, key: str = "setups") -> str:
    """Isometric view of the strokes, shape (3, 2), with all paths in the order of measuring and the numbers of their set-ups."""
    count = len({p.number for p in paths})
    summary = "; ".join(f"{p.number}: {p.text}" for p in paths)
    svg = Svg(WIDTH, HEIGHT, key, f"{count} set-ups in the machine's volume", summary)
    low, high = stroke_mm[:, 0], stroke_mm[:, 1]
    paper = Paper.around(low, high, ViewWindow((WIDTH / 2.0, HEIGHT / 2.0 - 14.0), WIDTH - 150.0, HEIGHT - 130.0))
    draw_box(svg, paper, low, high)
    middles = np.array([p.path_mm.mean(axis=0) for p in paths]).reshape(-1, 3)
    for i in np.argsort(depth(middles), kind="stable"):  # far ones first, near ones on top
        path = paths[int(i)]
        thinned = path.path_mm[:: max(1, len(path.path_mm) // MAX_POINTS)]
        svg.polyline([paper(point) for point in (*thinned, path.path_mm[-1])], f"s-{STYLES[path.kind]} thin")
    for path in {p.number: p for p in reversed(paths)}.values():
        x, y = paper(path.mount_mm)
        svg.dot((x, y), 4.0, f"f-{STYLES[path.kind]}", path.text)
        svg.text((x + 7.0, y - 5.0), path.number, "t-head t-halo")
    label_edges(svg, paper, low, high)
    used = [k for k in STYLES if any(p.kind == k for p in paths)]
    svg.legend((30.0, HEIGHT - 12.0), [(f"s-{STYLES[k]}", NAMES[k]) for k in used])
    return svg.render()
