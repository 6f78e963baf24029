"""Maps over a plane of the volume: cells of uncertainty, level lines of signed values, and a matrix of correlations.

Signed values have eight bands with edges at -4 .. +4 steps, blue below zero, orange above. Roles ``d1`` (far below zero) to ``d8`` (far
above) have their colours in `abbe.service.rendering.palette`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, draw_sequence, round_up, sequence_level, tick_text
from abbe.service.rendering.model import Correlations, Slice
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.palette import BANDS, SEQUENCE
from abbe.service.rendering.svg import XY, Svg

Array = NDArray[np.float64]
Segment = tuple[XY, XY]

WIDTH = 500.0
LEFT, TOP, RIGHT, BOTTOM = 62.0, 48.0, 20.0, 96.0
HALF = BANDS // 2


def common_step(slices: Sequence[Slice]) -> float:
    """Common width of a colour band for all slices, µm."""
    largest = max((float(np.nanmax(s.values)) for s in slices), default=0.0)
    return round_up(largest / SEQUENCE) if largest > 0.0 else 1.0


def cell_map(found: Slice, step: float, *, key: str, heading: str) -> str:
    """One plane of the volume, a coloured cell per node. ``step``: width of a colour band, µm, from `common_step`."""
    height = 420.0
    low, high = float(np.nanmin(found.values)), float(np.nanmax(found.values))
    summary = f"from {plain(low)} to {plain(high)} µm, {found.at}"
    svg = Svg(WIDTH, height, key, heading, f"Map over a plane: {summary}.")
    svg.head(heading, summary)
    dx, dy = (0.5 * float(v[1] - v[0]) for v in (found.x_mm, found.y_mm))
    ranges = (float(found.x_mm[0]) - dx, float(found.x_mm[-1]) + dx), (float(found.y_mm[0]) - dy, float(found.y_mm[-1]) + dy)
    panel = Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, height - TOP - BOTTOM, *ranges)
    size = (panel.width / len(found.x_mm) + 0.6, panel.height / len(found.y_mm) + 0.6)  # cells overlap slightly to hide seams
    for j, y in enumerate(found.y_mm):
        for i, x in enumerate(found.x_mm):
            value = float(found.values[j, i])
            tip = f"{found.x_axis} {tidy(float(x))}, {found.y_axis} {tidy(float(y))} mm: {plain(value)} µm"
            svg.rect(panel.at(float(x) - dx, float(y) + dy), size, f"f-seq{sequence_level(value, SEQUENCE * step)}", tip)
    panel.draw_x(svg, f"{found.x_axis} in mm")
    panel.draw_y(svg, f"{found.y_axis} in mm")
    panel.draw_frame(svg)
    draw_sequence(svg, (WIDTH / 2.0 - 2.5 * 56.0, height - 34.0), 56.0, SEQUENCE * step, "µm")
    return svg.render()


@dataclass(frozen=True, slots=True)
class SignedScale:
    """Bands of one width, ``step``, on both sides of zero."""

    step: float

    @classmethod
    def around(cls, *fields: Array) -> SignedScale:
        """Scale with the smallest step of the form 1, 2, 5 that covers all finite values of all fields."""
        sizes = [float(np.nanmax(np.abs(f))) for f in fields if np.isfinite(f).any()]
        largest = max(sizes, default=0.0)
        return cls(round_up(largest / HALF) if largest > 0.0 else 1.0)

    def style(self, value: float) -> str:
        """Colour role of a finite value."""
        band = int(np.clip(np.floor(value / self.step), -HALF, HALF - 1))
        return f"f-d{band + HALF + 1}"

    def levels(self) -> list[float]:
        """Edges between the bands, including zero."""
        return [k * self.step for k in range(-HALF + 1, HALF)]

    def draw_bar(self, svg: Svg, at: XY, unit: str, cell: float = 40.0) -> None:
        """Draw the colour key: the bands with the values at their edges. ``at``: upper left corner; ``cell``: width of a band, pixels."""
        x, y = at
        for band in range(BANDS):
            svg.rect((x + band * cell, y), (cell, 9.0), f"f-d{band + 1}")
        for edge in range(BANDS + 1):
            label = tick_text((edge - HALF) * self.step, self.step)
            svg.text((x + edge * cell, y + 23.0), label + (f" {unit}" if edge == BANDS else ""), "t-small", anchor="middle")


def extremes(values: Iterable[float]) -> tuple[float, float]:
    """Smallest and largest finite value; both zero when there is none."""
    array = np.asarray(list(values), dtype=np.float64)
    good = array[np.isfinite(array)]
    return (float(good.min()), float(good.max())) if good.size else (0.0, 0.0)


def correlation_plot(found: Correlations, *, key: str = "correlations") -> str:
    """Matrix of correlations: blue below zero, orange above, with the number as tooltip."""
    labels, cell, top = 128.0, 22.0, 40.0
    n = len(found.names)
    side = n * cell
    scale = SignedScale(0.25)
    strong = [
        f"{found.names[i]} and {found.names[j]} {found.matrix[i, j]:+.2f}"
        for i in range(n)
        for j in range(i)
        if abs(found.matrix[i, j]) > 0.9
    ]
    width = max(labels + side + 20.0, labels + 350.0)
    svg = Svg(width, top + side + labels + 40.0, key, "Correlation of parameters", "Above 0.9: " + ("; ".join(strong) or "none") + ".")
    svg.text((10.0, 18.0), "The most correlated parameters", "t-head")
    for i, name in enumerate(found.names):
        svg.text((labels - 8.0, top + (i + 0.7) * cell), name[:20], "t-small", anchor="end")
        svg.text((labels + (i + 0.7) * cell, top + side + 8.0), name[:20], "t-small", anchor="end", turn=-90.0)
        for j in range(n):
            r = float(found.matrix[i, j])
            tip = f"{name} and {found.names[j]}: {r:+.3f}"
            svg.rect((labels + j * cell, top + i * cell), (cell - 1.0, cell - 1.0), scale.style(min(r, 0.999)), tip)
    scale.draw_bar(svg, (labels, top + side + labels), "", 40.0)
    return svg.render()


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Values over a rectangle: ``x`` (nx,), ``y`` (ny,), ``values`` (ny, nx) in ``unit``; labels: names and units of the axes."""

    x: Array
    y: Array
    values: Array
    x_label: str
    y_label: str
    unit: str


def contour_plot(surface: Surface, scale: SignedScale, *, key: str, heading: str, dots: Sequence[XY] = ()) -> str:
    """Map of a surface from above; ``surface`` needs a fine grid to look smooth.

    ``scale``: colour bands and levels of the lines, with a stronger line at zero. ``dots``: marked points, in the coordinates of the axes.
    """
    low, high = extremes(surface.values.ravel())
    summary = f"from {plain(low)} to {plain(high)} {surface.unit}"
    svg = Svg(WIDTH, 440.0, key, heading, f"Level lines over a plane: {summary}.")
    svg.head(heading, f"{summary}; one line every {tick_text(scale.step, scale.step)} {surface.unit}")
    ranges = (float(surface.x[0]), float(surface.x[-1])), (float(surface.y[0]), float(surface.y[-1]))
    panel = Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, svg.height - TOP - BOTTOM, *ranges)
    panel.draw_x(svg, surface.x_label)
    panel.draw_y(svg, surface.y_label)
    _draw_bands(svg, panel, surface, scale)
    for level in scale.levels():
        _draw_level(svg, panel, surface, level, scale.step)
    for x, y in dots:
        svg.dot(panel.at(x, y), 1.8, "key-head")
    panel.draw_frame(svg)
    scale.draw_bar(svg, (WIDTH / 2.0 - 160.0, svg.height - 30.0), surface.unit)
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
        One list per line; a closed line ends at its first point. In a saddle cell the mean of the corners decides which crossings connect.
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


def gain_map(found: Slice, *, key: str, heading: str = "Noise gain") -> str:
    """Micrometres of predicted deviation per micrometre of reading noise over one plane of the volume, with level lines.

    ``found.values`` has no unit; more than ten nodes per side look smooth.
    """
    labels = (f"{found.x_axis} in mm", f"{found.y_axis} in mm")
    surface = Surface(found.x_mm, found.y_mm, found.values, *labels, "µm per µm")
    return contour_plot(surface, SignedScale.around(found.values), key=key, heading=f"{heading}, {found.at}")
