"""Values over a plane as coloured bands with their level lines (marching squares)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, tick_text
from abbe.service.rendering.numbers import plain
from abbe.service.rendering.plots.facets import Surface
from abbe.service.rendering.plots.signed import SignedScale, extremes
from abbe.service.rendering.svg import XY, Svg

Array = NDArray[np.float64]
Segment = tuple[XY, XY]

WIDTH, HEIGHT = 500.0, 440.0
LEFT, TOP, RIGHT, BOTTOM = 62.0, 48.0, 20.0, 96.0


def contour_plot(surface: Surface, scale: SignedScale, *, key: str, heading: str, dots: Sequence[XY] = ()) -> str:
    """Map of a surface from above; ``surface`` needs a fine grid to look smooth.

    ``scale``: colour bands and levels of the lines, with a stronger line at zero. ``dots``: marked points, in the coordinates of the axes.
    """
    low, high = extremes(surface.values.ravel())
    summary = f"from {plain(low)} to {plain(high)} {surface.unit}"
    svg = Svg(WIDTH, HEIGHT, key, heading, f"Level lines over a plane: {summary}.")
    svg.text((WIDTH / 2.0, 18.0), heading, "t-head", anchor="middle")
    svg.text(
        (WIDTH / 2.0, 36.0), f"{summary}; one line every {tick_text(scale.step, scale.step)} {surface.unit}", "t-soft", anchor="middle"
    )
    ranges = (float(surface.x[0]), float(surface.x[-1])), (float(surface.y[0]), float(surface.y[-1]))
    panel = Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, *ranges)
    panel.draw_x(svg, surface.x_label)
    panel.draw_y(svg, surface.y_label)
    _draw_bands(svg, panel, surface, scale)
    for level in scale.levels():
        _draw_level(svg, panel, surface, level, scale.step)
    for x, y in dots:
        svg.dot(panel.at(x, y), 1.8, "key-head")
    panel.draw_frame(svg)
    scale.draw_bar(svg, (WIDTH / 2.0 - 160.0, HEIGHT - 30.0), surface.unit)
    return svg.render()


def level_lines(x: Array, y: Array, values: Array, level: float) -> list[list[XY]]:
    """Lines on which a field has one value, by marching squares with straight interpolation on the cell edges.

    Parameters
    ----------
    x, y : arrays, shapes (nx,), (ny,)
    values : array, shape (ny, nx)
        Cells with a corner that is not finite are left out.

    Returns
    -------
    list of lists of (x, y)
        One list per line; a closed line ends at its first point. The lines of a saddle put its centre on the side of the cell's mean.
    """
    segments: list[Segment] = []
    for j in range(len(y) - 1):
        for i in range(len(x) - 1):
            corners = np.array([values[j, i], values[j, i + 1], values[j + 1, i + 1], values[j + 1, i]])
            if np.isfinite(corners).all():
                places = ((x[i], y[j]), (x[i + 1], y[j]), (x[i + 1], y[j + 1]), (x[i], y[j + 1]))
                segments += _cell(corners, [(float(a), float(b)) for a, b in places], level)
    return _join([s for s in segments if _key(s[0]) != _key(s[1])])  # drop segments of zero length from corners on the level


def _cell(corners: Array, places: list[XY], level: float) -> list[Segment]:
    above = corners >= level
    crossed = [k for k in range(4) if above[k] != above[(k + 1) % 4]]
    points = {k: _between(places[k], places[(k + 1) % 4], float(corners[k]), float(corners[(k + 1) % 4]), level) for k in crossed}
    if len(crossed) == 2:
        return [(points[crossed[0]], points[crossed[1]])]
    if len(crossed) == 4:
        first_apart = (float(corners.mean()) >= level) != bool(above[0])
        pairs = ((3, 0), (1, 2)) if first_apart else ((0, 1), (2, 3))
        return [(points[a], points[b]) for a, b in pairs]
    return []


def _between(p: XY, q: XY, at_p: float, at_q: float, level: float) -> XY:
    t = (level - at_p) / (at_q - at_p)
    return p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])


def _join(segments: list[Segment]) -> list[list[XY]]:
    """Chain segments that share an end. Neighbouring cells compute the shared point from the same numbers, so their ends are equal."""
    ends: dict[XY, list[int]] = {}
    for k, (p, q) in enumerate(segments):
        for end in (_key(p), _key(q)):
            ends.setdefault(end, []).append(k)
    free = set(range(len(segments)))
    lines = []
    # Open lines first, from their loose ends; the remaining lines are closed.
    order = [k for shared in ends.values() if len(shared) == 1 for k in shared] + list(range(len(segments)))
    for start in order:
        if start not in free:
            continue
        free.discard(start)
        p, q = segments[start]
        if len(ends[_key(p)]) != 1 and len(ends[_key(q)]) == 1:
            p, q = q, p
        line = [p, q]
        while (step := next((k for k in ends[_key(line[-1])] if k in free), None)) is not None:
            free.discard(step)
            p, q = segments[step]
            line.append(q if _key(p) == _key(line[-1]) else p)
        lines.append(line)
    return lines


def _key(point: XY) -> XY:
    return round(point[0], 9), round(point[1], 9)


def _draw_bands(svg: Svg, panel: Panel, surface: Surface, scale: SignedScale) -> None:
    """Neighbouring cells of one colour in a row become one rectangle; rectangles overlap by a pixel to hide seams."""
    v = surface.values
    mean = 0.25 * (v[:-1, :-1] + v[1:, :-1] + v[:-1, 1:] + v[1:, 1:])
    for j in range(mean.shape[0]):
        top, bottom = panel.y(float(surface.y[j + 1])), panel.y(float(surface.y[j]))
        over = 1.0 if j < mean.shape[0] - 1 else 0.0
        styles = [scale.style(float(m)) if np.isfinite(m) else "" for m in mean[j]]
        start = 0
        for i in range(1, len(styles) + 1):
            if i == len(styles) or styles[i] != styles[start]:
                if styles[start]:
                    left, right = panel.x(float(surface.x[start])), panel.x(float(surface.x[i]))
                    svg.rect((left, top - over), (right - left, bottom - top + over), styles[start])
                start = i


def _draw_level(svg: Svg, panel: Panel, surface: Surface, level: float, step: float) -> None:
    zero = abs(level) < 1e-9 * step
    longest: list[XY] = []
    for line in level_lines(surface.x, surface.y, surface.values, level):
        pixels = [panel.at(*p) for p in line]
        svg.polyline(pixels, "level-zero" if zero else "level")
        if len(pixels) > len(longest):
            longest = pixels
    if len(longest) > 5:
        x, y = longest[len(longest) // 2]
        inside = (
            min(max(x, panel.left + 16.0), panel.left + panel.width - 16.0),
            min(max(y, panel.top + 10.0), panel.top + panel.height - 6.0),
        )
        svg.text((inside[0], inside[1] + 4.0), tick_text(level, step), "t-small t-halo t-level", anchor="middle")
