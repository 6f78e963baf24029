"""The isometric view that all spatial pictures share.

The view is from the front right, from above: X runs to the lower right, Y to the upper right, Z up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.numbers import tidy
from abbe.service.rendering.svg import XY, Svg

F2 = NDArray[np.float64]

# Rows: right and up on the paper, and towards the viewer, for a right-handed frame seen from (+1, -1, +1).
_ROOT2, _ROOT6, _ROOT3 = math.sqrt(2.0), math.sqrt(6.0), math.sqrt(3.0)
VIEW: F2 = np.array([[1 / _ROOT2, 1 / _ROOT2, 0.0], [-1 / _ROOT6, 1 / _ROOT6, 2 / _ROOT6], [1 / _ROOT3, -1 / _ROOT3, 1 / _ROOT3]])
"""Rows: right and up on the paper, towards the viewer."""


@dataclass(frozen=True, slots=True)
class ViewWindow:
    """Part of a picture for a spatial view: its centre, and the largest width and height of the box drawn there, in pixels."""

    at: XY
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Paper:
    """Projection of space to pixels: pixels per unit, and the central point with its pixel."""

    zoom: float
    centre: F2
    at: XY

    @classmethod
    def around(cls, low: F2, high: F2, window: ViewWindow) -> Paper:
        """Largest scale at which the box from ``low`` to ``high`` fits the window."""
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        flat = (corners - (low + high) / 2.0) @ VIEW[:2].T
        span = np.maximum(np.ptp(flat, axis=0), 1e-9)
        zoom = min(window.width / span[0], window.height / span[1])
        return cls(float(zoom), (low + high) / 2.0, window.at)

    def __call__(self, point: F2) -> XY:
        """Pixel of a point, shape (3,)."""
        right, up = self.zoom * (VIEW[:2] @ (point - self.centre))
        return self.at[0] + float(right), self.at[1] - float(up)


def depth(points: F2) -> NDArray[np.float64]:
    """Distance towards the viewer, shape (n,): draw in rising order, near over far."""
    towards: NDArray[np.float64] = points @ VIEW[2]
    return towards


def draw_box(svg: Svg, paper: Paper, low: F2, high: F2) -> None:
    """Edges of a box; the three behind the volume are dashed."""
    hidden = np.array([low[0], high[1], low[2]])  # the corner farthest from the viewer: its three edges lie behind the volume
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for choice in itertools.product((0, 1), repeat=2):
            start, end = low.copy(), high.copy()
            for a, c in zip(others, choice, strict=True):
                start[a] = end[a] = (low, high)[c][a]
            behind = np.allclose(start, hidden) or np.allclose(end, hidden)
            svg.line(paper(start), paper(end), "hidden-edge" if behind else "frame")


def label_edges(svg: Svg, paper: Paper, low: F2, high: F2) -> None:
    """Range of X, Y and Z along the box, in mm."""
    middle = (low + high) / 2.0
    spots = (
        (np.array([middle[0], low[1], low[2]]), (-14.0, 26.0), "end"),
        (np.array([high[0], middle[1], low[2]]), (14.0, 26.0), "start"),
        (np.array([low[0], low[1], middle[2]]), (-8.0, 4.0), "end"),
    )
    for axis, (point, shift, anchor) in enumerate(spots):
        x, y = paper(point)
        label = f"{'XYZ'[axis]} {tidy(float(low[axis]))} … {tidy(float(high[axis]))}"
        if axis == 2:
            svg.text((x - 22.0, y), f"{label} mm", "t-soft t-halo", anchor="middle", turn=-90.0)
        else:
            svg.text((x + shift[0], y + shift[1]), f"{label} mm", "t-soft t-halo", anchor=anchor)


def round_down(value: float) -> float:
    """Largest round magnification (1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten) that does not exceed ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(m for m in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0) if m * power <= value * (1.0 + 1e-9)) * power
