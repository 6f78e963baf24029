"""The isometric view that all spatial pictures share, and surfaces in it: coloured facets drawn from far to near.

The view is from the front right, from above: X runs to the lower right, Y to the upper right, Z up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import nice_step, tick_text, ticks
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.plots.maps import SignedScale, Surface, extremes
from abbe.service.rendering.svg import XY, Svg

F2 = NDArray[np.float64]

_ROOT2, _ROOT6, _ROOT3 = math.sqrt(2.0), math.sqrt(6.0), math.sqrt(3.0)
VIEW: F2 = np.array([[1 / _ROOT2, 1 / _ROOT2, 0.0], [-1 / _ROOT6, 1 / _ROOT6, 2 / _ROOT6], [1 / _ROOT3, -1 / _ROOT3, 1 / _ROOT3]])
"""Rows: right and up on the paper, and towards the viewer, for a right-handed frame seen from (+1, -1, +1)."""


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
    """Distance towards the viewer, shape (n,). Draw in rising order, so that near covers far."""
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
    """Write the ranges of X, Y and Z, in mm, along the edges of the box."""
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


Array = NDArray[np.float64]

WIDTH, HEIGHT = 500.0, 430.0
FLOOR, ROOF = 0.0, 0.62
"""Bottom and top of the box of a surface, as a share of its side."""


def draw_facets(svg: Svg, paper: Paper, nodes: Array, values: Array, scale: SignedScale) -> None:
    """Quadrangles between neighbouring nodes, far ones first, coloured by the mean of their corners.

    ``nodes``: points in space, shape (rows, columns, 3); ``values``: shape (rows, columns).
    """
    corners = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1]], axis=2).reshape(-1, 4, 3)
    mean = (0.25 * (values[:-1, :-1] + values[:-1, 1:] + values[1:, 1:] + values[1:, :-1])).ravel()
    for i in np.argsort(depth(corners.mean(axis=1)), kind="stable"):
        if np.isfinite(corners[i]).all() and np.isfinite(mean[i]):
            svg.polygon([paper(p) for p in corners[i]], f"facet {scale.style(float(mean[i]))}")


def surface_plot(surface: Surface, scale: SignedScale, *, key: str, heading: str) -> str:
    """One surface over its rectangle; height and colour show the value.

    ``scale``: shared by all pictures to compare; its whole range is the height of the box.
    """
    low_value, high_value = extremes(surface.values.ravel())
    summary = f"from {plain(low_value)} to {plain(high_value)} {surface.unit}"
    svg = Svg(WIDTH, HEIGHT, key, heading, f"Surface over a plane: {summary}.")
    svg.head(heading, summary)
    low, high = np.array([0.0, 0.0, FLOOR]), np.array([1.0, 1.0, ROOF])
    paper = Paper.around(low, high, ViewWindow((WIDTH / 2.0, 206.0), WIDTH - 120.0, HEIGHT - 150.0))
    top = 4.0 * scale.step
    draw_box(svg, paper, low, high)
    x, y = np.meshgrid(_share(surface.x), _share(surface.y))
    z = FLOOR + (ROOF - FLOOR) * (np.asarray(surface.values) + top) / (2.0 * top)
    draw_facets(svg, paper, np.stack([x, y, z], axis=2), surface.values, scale)
    _axis(svg, paper, (surface.x, surface.x_label), "x")
    _axis(svg, paper, (surface.y, surface.y_label), "y")
    _height(svg, paper, scale, surface.unit)
    scale.draw_bar(svg, (WIDTH / 2.0 - 160.0, HEIGHT - 30.0), surface.unit)
    return svg.render()


def lobing_plot(colatitude_rad: Array, longitude_rad: Array, values: Array, scale: SignedScale, *, key: str, heading: str) -> str:
    """The probe error over the upper hemisphere, as relief on a ball: every node is moved outwards by its magnified value.

    Parameters
    ----------
    colatitude_rad, longitude_rad : arrays, shapes (rows,), (columns,)
        Colatitude from the pole (0) to the equator (pi/2); longitude over a full turn, so that first and last column coincide.
    values : array, shape (rows, columns)
        Probe error, µm, outwards positive.
    """
    low_value, high_value = extremes(values.ravel())
    relief = 0.22 / (4.0 * scale.step)
    summary = f"from {plain(low_value)} to {plain(high_value)} µm; {tidy(4.0 * scale.step)} µm drawn as 22 % of the radius"
    svg = Svg(WIDTH, HEIGHT, key, heading, f"Probe error as relief on a hemisphere: {summary}.")
    svg.head(heading, summary)
    paper = Paper.around(
        np.array([-0.95, -0.95, 0.0]), np.array([0.95, 0.95, 1.0]), ViewWindow((WIDTH / 2.0, 208.0), WIDTH - 130.0, HEIGHT - 110.0)
    )
    phi, theta = np.meshgrid(colatitude_rad, longitude_rad, indexing="ij")
    normal = np.stack([np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)], axis=2)
    draw_facets(svg, paper, normal * (1.0 + relief * values)[:, :, None], values, scale)
    _reference(svg, paper)
    scale.draw_bar(svg, (WIDTH / 2.0 - 160.0, HEIGHT - 30.0), "µm")
    return svg.render()


def _reference(svg: Svg, paper: Paper) -> None:
    """Draw the equator of a ball without probe error, and the directions of x' and y'."""
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    svg.polyline([paper(np.array([np.cos(t), np.sin(t), 0.0])) for t in turn], "hidden-edge")
    for end, name, shift in ((np.array([1.3, 0.0, 0.0]), "x′ (θ = 0°)", 16.0), (np.array([0.0, 1.3, 0.0]), "y′ (θ = 90°)", -8.0)):
        tip = paper(end)
        svg.line(paper(end / 1.3), tip, "key")
        svg.text((tip[0] + 4.0, tip[1] + shift), name, "t-soft t-halo")


def _share(values: Array) -> Array:
    out: Array = (values - values[0]) / (values[-1] - values[0])
    return out


def _axis(svg: Svg, paper: Paper, axis: tuple[Array, str], name: str) -> None:
    """Draw ticks with numbers along one front edge of the floor, and the label."""
    values, label = axis
    low, high = float(values[0]), float(values[-1])
    step = nice_step(high - low, 4)
    for value in ticks(low, high, 4):
        t = (value - low) / (high - low)
        point = np.array([t, 0.0, FLOOR]) if name == "x" else np.array([1.0, t, FLOOR])
        x, y = paper(point)
        side = -1.0 if name == "x" else 1.0
        svg.line((x, y), (x + side * 4.0, y + 3.0), "frame")
        svg.text((x + side * 7.0, y + 14.0), tick_text(value, step), "t-small", anchor="end" if name == "x" else "start")
    x, y = paper(np.array([0.5, 0.0, FLOOR]) if name == "x" else np.array([1.0, 0.5, FLOOR]))
    svg.text((x - 34.0 if name == "x" else x + 34.0, y + 40.0), label, "t-soft", anchor="end" if name == "x" else "start")


def _height(svg: Svg, paper: Paper, scale: SignedScale, unit: str) -> None:
    for k in range(-4, 5, 2):
        share = FLOOR + (ROOF - FLOOR) * (k + 4) / 8.0
        x, y = paper(np.array([0.0, 0.0, share]))
        svg.line((x, y), (x - 5.0, y), "frame")
        svg.text((x - 8.0, y + 4.0), tick_text(k * scale.step, scale.step), "t-small", anchor="end")
    at: XY = paper(np.array([0.0, 0.0, ROOF]))
    svg.text((at[0] - 8.0, at[1] - 12.0), unit, "t-soft", anchor="end")
