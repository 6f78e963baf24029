"""The machine's volume in isometric view: an arrow for the error at every node, or a grid with magnified errors.

Before and after share one exaggeration and one colour scale, because individual scales would hide the improvement.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import draw_sequence, nice_step, round_up, sequence_level
from abbe.service.rendering.model import ArrowField
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.palette import SEQUENCE
from abbe.service.rendering.plots.isometric import Paper, ViewWindow, depth, draw_box, label_edges, round_down
from abbe.service.rendering.svg import Svg

F2 = NDArray[np.float64]

WIDTH, HEIGHT = 500.0, 450.0
MAX_ARROWS = 420
"""Largest number of arrows; more nodes are thinned out evenly (the figures still use all of them)."""


GRID_SHARE = 0.14
"""Drawn length of the longest error of a grid as a share of the volume's diagonal."""


@dataclass(frozen=True, slots=True)
class ArrowScale:
    """Common scale of both pictures. ``exaggeration``: mm drawn per mm of error; ``top_um``: length at the upper end of the colours."""

    exaggeration: float
    top_um: float


def common_scale(*fields: ArrowField) -> ArrowScale:
    """Scale at which the longest arrow of all fields spans at most a sixth of the volume's diagonal."""
    lengths = [_lengths(f) for f in fields]
    longest = max((float(np.nanmax(v)) for v in lengths if np.isfinite(v).any()), default=0.0)
    diagonal = max((_diagonal(f.grid_mm) for f in fields), default=0.0)
    if longest <= 0.0 or diagonal <= 0.0:
        return ArrowScale(1.0, 1.0)
    step = round_up(longest / SEQUENCE)
    return ArrowScale(round_down(0.16 * diagonal / (longest * 1e-3)), SEQUENCE * step)


def volume_arrows(field: ArrowField, scale: ArrowScale, *, key: str, heading: str) -> str:
    """One volume with its arrows, scale key and figures. ``scale``: from ``common_scale``, shared by all pictures to compare."""
    lengths = _lengths(field)
    good = lengths[np.isfinite(lengths)]
    longest = float(good.max()) if good.size else math.nan
    rms = float(np.sqrt(np.mean(good**2))) if good.size else math.nan
    figures = f"longest {plain(longest)} µm, rms {plain(rms)} µm over {good.size} nodes"
    svg = Svg(
        WIDTH, HEIGHT, key, f"Volumetric error, {heading}", f"Isometric view of the machine volume with an error arrow per node: {figures}."
    )
    svg.head(heading, figures)
    finite_grid = field.grid_mm[np.isfinite(field.grid_mm).all(axis=1)] if field.grid_mm.size else field.grid_mm
    if finite_grid.size:
        low, high = finite_grid.min(axis=0), finite_grid.max(axis=0)
        # The margin leaves room for arrows that leave the box.
        window = ViewWindow((WIDTH / 2.0, 58.0 + (HEIGHT - 110.0) / 2.0), WIDTH - 120.0, HEIGHT - 178.0)
        paper = Paper.around(low, high, window)
        draw_box(svg, paper, low, high)
        _draw_arrows(svg, paper, field, scale)
        label_edges(svg, paper, low, high)
        _draw_key(svg, paper, scale)
    return svg.render()


def volume_pair(before: ArrowField | None, after: ArrowField | None, *, key: str = "volume") -> list[str]:
    """Before and after at one scale; a side without data is left out."""
    sides = [(before, "before"), (after, "after")]
    scale = common_scale(*(f for f, _ in sides if f is not None))
    return [volume_arrows(f, scale, key=f"{key}-{name}", heading=f"{name.capitalize()} correction") for f, name in sides if f is not None]


def _draw_arrows(svg: Svg, paper: Paper, field: ArrowField, scale: ArrowScale) -> None:
    lengths = _lengths(field)
    order = np.argsort(depth(field.grid_mm), kind="stable")  # far ones first, near ones on top
    for i in order[:: max(1, math.ceil(order.size / MAX_ARROWS))]:
        if not (np.isfinite(lengths[i]) and np.isfinite(field.grid_mm[i]).all()):
            continue
        node, error = field.grid_mm[i], field.deviation_um[i]
        place = ", ".join(tidy(float(v)) for v in node)
        parts = ", ".join(plain(float(v)) for v in error)
        tip = f"({place}) mm: ({parts}) µm, length {plain(float(lengths[i]))} µm"
        svg.arrow(
            paper(node), paper(node + error * 1e-3 * scale.exaggeration), f"seq{sequence_level(float(lengths[i]), scale.top_um)}", tip
        )


def _draw_key(svg: Svg, paper: Paper, scale: ArrowScale) -> None:
    """Draw the colours of the lengths, and a reference length in the plane of the paper; arrows at an angle to that plane look shorter."""
    y = HEIGHT - 34.0
    draw_sequence(svg, (24.0, y), 46.0, scale.top_um, "µm")
    bar = nice_step(scale.top_um, 3)
    text = f"{tidy(bar)} µm (errors drawn {tidy(scale.exaggeration)} ×)"
    svg.length_key((WIDTH - 24.0, y + 5.0), bar * 1e-3 * scale.exaggeration * paper.zoom, text)


def _lengths(field: ArrowField) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(field.deviation_um.reshape(-1, 3), axis=1), dtype=np.float64)


def _diagonal(grid: F2) -> float:
    finite_grid = grid[np.isfinite(grid).all(axis=1)] if grid.size else grid
    return float(np.linalg.norm(np.ptp(finite_grid, axis=0))) if finite_grid.size else 0.0


def deformed_grid(grid_mm: F2, deviation_um: F2, *, key: str, heading: str) -> str:
    """The lines of a grid on the faces of its box: dashed as commanded, solid with magnified errors.

    ``grid_mm``, ``deviation_um``: nodes and actual minus nominal, shape (nx, ny, nz, 3).
    """
    height = 470.0
    longest = float(np.linalg.norm(deviation_um, axis=3).max())
    low, high = grid_mm[0, 0, 0], grid_mm[-1, -1, -1]
    magnified = round_down(GRID_SHARE * float(np.linalg.norm(high - low)) / (longest * 1e-3)) if longest > 0.0 else 1.0
    summary = f"longest {plain(longest)} µm; errors drawn {tidy(magnified)} ×"
    svg = Svg(WIDTH, height, key, heading, f"Isometric view of a nominal grid and the same grid with its errors: {summary}.")
    svg.head(heading, summary)
    actual = grid_mm + deviation_um * 1e-3 * magnified
    paper = Paper.around(low, high, ViewWindow((WIDTH / 2.0, 232.0), WIDTH - 170.0, height - 200.0))
    for nodes, style in ((grid_mm, "hidden-edge"), (actual, "s-c2")):
        for line in _face_lines(nodes):
            svg.polyline([paper(p) for p in line], style)
    label_edges(svg, paper, low, high)
    svg.legend((24.0, height - 18.0), [("hidden-edge", "nominal"), ("s-c2", "actual")])
    bar = nice_step(longest, 2)
    text = f"{tidy(bar)} µm in the plane of the paper"
    svg.length_key((WIDTH - 24.0, height - 36.0), bar * 1e-3 * magnified * paper.zoom, text)
    return svg.render()


def _face_lines(nodes: F2) -> Iterator[F2]:
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
