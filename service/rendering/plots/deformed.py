"""A machine's volume as a grid: nominal, and with magnified errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import nice_step
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.plots.isometric import Paper, ViewWindow, label_edges, round_down
from abbe.service.rendering.svg import Svg

Array = NDArray[np.float64]

WIDTH, HEIGHT = 500.0, 470.0
SHARE = 0.14
"""Drawn length of the longest error as a share of the volume's diagonal."""


def deformed_grid(grid_mm: Array, deviation_um: Array, *, key: str, heading: str) -> str:
    """The lines of a grid on the faces of its box: dashed as commanded, solid with magnified errors.

    ``grid_mm``, ``deviation_um``: nodes and actual minus nominal, shape (nx, ny, nz, 3).
    """
    longest = float(np.linalg.norm(deviation_um, axis=3).max())
    low, high = grid_mm[0, 0, 0], grid_mm[-1, -1, -1]
    magnified = round_down(SHARE * float(np.linalg.norm(high - low)) / (longest * 1e-3)) if longest > 0.0 else 1.0
    summary = f"longest {plain(longest)} µm; errors drawn {tidy(magnified)} ×"
    svg = Svg(WIDTH, HEIGHT, key, heading, f"Isometric view of a nominal grid and the same grid with its errors: {summary}.")
    svg.text((WIDTH / 2.0, 18.0), heading, "t-head", anchor="middle")
    svg.text((WIDTH / 2.0, 36.0), summary, "t-soft", anchor="middle")
    actual = grid_mm + deviation_um * 1e-3 * magnified
    paper = Paper.around(low, high, ViewWindow((WIDTH / 2.0, 232.0), WIDTH - 170.0, HEIGHT - 200.0))
    for nodes, style in ((grid_mm, "hidden-edge"), (actual, "s-c2")):
        for line in _face_lines(nodes):
            svg.polyline([paper(p) for p in line], style)
    label_edges(svg, paper, low, high)
    svg.legend((24.0, HEIGHT - 18.0), [("hidden-edge", "nominal"), ("s-c2", "actual")])
    bar = nice_step(longest, 2)
    length = bar * 1e-3 * magnified * paper.zoom
    right, y = WIDTH - 24.0, HEIGHT - 36.0
    svg.line((right - length, y), (right, y), "key")
    for end in (right - length, right):
        svg.line((end, y - 4.0), (end, y + 4.0), "key")
    svg.text((right, y + 18.0), f"{tidy(bar)} µm in the plane of the paper", "t-small", anchor="end")
    return svg.render()


def _face_lines(nodes: Array) -> Iterator[Array]:
    """Grid lines on the three visible faces (X large, Y small, Z large) and the three hidden edges."""
    nx, ny, nz = nodes.shape[:3]
    for i in range(nx):
        yield nodes[i, 0, :]
        yield nodes[i, :, -1]
    for j in range(ny):
        yield nodes[-1, j, :]
        yield nodes[:, j, -1]
    for k in range(nz):
        yield nodes[:, 0, k]
        yield nodes[-1, :, k]
    yield nodes[0, -1, :]
    yield nodes[0, :, 0]
    yield nodes[:, -1, 0]
