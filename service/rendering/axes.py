"""Axes of plots: scales from numbers to pixels, ticks, panels with curves and bars, grids of panels, and colour keys."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from abbe.service.rendering.model import Floats
from abbe.service.rendering.numbers import finite, fixed, tidy
from abbe.service.rendering.palette import SEQUENCE
from abbe.service.rendering.svg import XY, Svg


def nice_step(span: float, count: int = 5) -> float:
    """Tick distance of the form 1, 2 or 5 times a power of ten that gives about ``count`` intervals over ``span``."""
    if not math.isfinite(span) or span <= 0.0:
        return 1.0
    raw = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    # Nearest ratio: always rounding up would leave two ticks on some axes.
    return next((m * power for m, limit in ((1.0, 1.5), (2.0, 3.3), (5.0, 7.1)) if raw <= limit * power), 10.0 * power)


def round_up(value: float) -> float:
    """Smallest number of the form 1, 2 or 5 times a power of ten that is not below ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((m * power for m in (1.0, 2.0, 5.0) if value <= m * power * (1.0 + 1e-9)), 10.0 * power)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Tick positions inside ``low`` .. ``high``."""
    step = nice_step(high - low, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def tick_text(value: float, step: float) -> str:
    """Tick label with the decimals that the tick distance needs."""
    if not 1e-6 <= step < 1e7:
        return f"{value:.1e}"
    return fixed(value, max(0, -math.floor(math.log10(step) + 1e-9)))


def data_range(values: Iterable[float | None], *, margin: float = 0.06, zero: bool = False) -> tuple[float, float]:
    """Range of all finite values, widened on both sides by ``margin`` times the span; 0 .. 1 if there are none. ``zero``: include zero."""
    good = [float(v) for v in values if finite(v)]
    if zero:
        good.append(0.0)
    if not good:
        return 0.0, 1.0
    low, high = min(good), max(good)
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
        half = abs(high) * 0.5 or 1.0
        return low - half, high + half
    pad = margin * (high - low)
    return low - pad, high + pad


@dataclass(frozen=True, slots=True)
class Scale:
    """Linear map from ``low`` .. ``high`` to the pixels ``start`` .. ``end``."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Pixel of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle with an x and a y scale. ``left, top, width, height`` bound the data area; labels go outside."""

    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    @property
    def x(self) -> Scale:
        """Scale of the abscissa."""
        return Scale(*self.x_range, self.left, self.left + self.width)

    @property
    def y(self) -> Scale:
        """Scale of the ordinate, upwards."""
        return Scale(*self.y_range, self.top + self.height, self.top)

    def at(self, x: float, y: float) -> XY:
        """Pixel of a data point."""
        return self.x(x), self.y(y)

    def points(self, x: Floats, y: Floats) -> list[XY]:
        """Pixels of data points."""
        return [self.at(float(a), float(b)) for a, b in zip(x, y, strict=True)]

    def draw_line(self, svg: Svg, x: Floats, y: Floats, style: str) -> None:
        """Line through data points, broken at missing points."""
        svg.polyline(self.points(x, y), style)

    def draw_band(self, svg: Svg, x: Floats, low: Floats, high: Floats) -> None:
        """Filled band between two curves."""
        svg.polygon([*self.points(x, high), *self.points(x[::-1], low[::-1])], "band")

    def draw_bar(self, svg: Svg, end: float, y: float, height: float, style: str, tip: str = "") -> None:
        """Horizontal bar from the left edge to the value ``end``, centred on the pixel ``y``."""
        svg.rect((self.left, y - height / 2.0), (self.x(end) - self.left, height), style, tip)

    def draw_whisker(self, svg: Svg, value: float, expanded: float, y: float) -> None:
        """Horizontal whisker of an uncertainty about a size, cut off at zero because a size is never negative."""
        low, high = self.x(max(value - expanded, 0.0)), self.x(value + expanded)
        svg.error_bar((0.5 * (low + high), y), 0.5 * (high - low), horizontal=True)

    def draw_y(self, svg: Svg, label: str = "", *, count: int = 5, numbers: bool = True) -> None:
        """Horizontal grid lines with their numbers, a stronger line at zero, and the label along the axis."""
        step = nice_step(self.y_range[1] - self.y_range[0], count)
        right = self.left + self.width
        for value in ticks(*self.y_range, count):
            y = self.y(value)
            svg.line((self.left, y), (right, y), "zero" if abs(value) < 1e-9 * step else "grid")
            if numbers:
                svg.text((self.left - 6.0, y + 4.0), tick_text(value, step), "t-soft", anchor="end")
        if label:
            svg.text((self.left - 48.0, self.top + self.height / 2.0), label, "t-soft", anchor="middle", turn=-90.0)

    def draw_x(self, svg: Svg, label: str = "", *, count: int = 6, numbers: bool = True) -> None:
        """Vertical grid lines with their numbers, and the label under the axis."""
        step = nice_step(self.x_range[1] - self.x_range[0], count)
        bottom = self.top + self.height
        for value in ticks(*self.x_range, count):
            x = self.x(value)
            svg.line((x, self.top), (x, bottom), "grid")
            if numbers:
                svg.text((x, bottom + 16.0), tick_text(value, step), "t-soft", anchor="middle")
        if label:
            svg.text((self.left + self.width / 2.0, bottom + 34.0), label, "t-soft", anchor="middle")

    def draw_frame(self, svg: Svg) -> None:
        """Border around the data area."""
        svg.rect((self.left, self.top), (self.width, self.height), "frame")


def bar_panel(left: float, top: float, size: XY, ends: Iterable[float | None]) -> Panel:
    """Panel for horizontal bars from zero; its scale reaches beyond the largest of ``ends``. ``size``: width and height."""
    return Panel(left, top, *size, (0.0, data_range(ends, zero=True)[1]), (0.0, 1.0))


@dataclass(frozen=True, slots=True)
class PanelGrid:
    """Panels of one size in rows and columns with a common ordinate, and numbers and labels at the outer edges only.

    ``rows``, ``columns``: names; ``top``: pixels above the first row, for headings.
    """

    rows: Sequence[str]
    columns: Sequence[str]
    cell_height: float
    gap: float
    top: float
    y_range: tuple[float, float]

    WIDTH = 1010.0
    LEFT = 68.0
    BOTTOM = 48.0

    @property
    def height(self) -> float:
        """Height of the picture."""
        count = max(len(self.rows), 1)
        return self.top + count * self.cell_height + (count - 1) * self.gap + self.BOTTOM

    @property
    def _width(self) -> float:
        count = max(len(self.columns), 1)
        return (self.WIDTH - self.LEFT - 10.0 - (count - 1) * self.gap) / count

    def panel(self, row: str, column: str, x_range: tuple[float, float]) -> Panel:
        """The panel to draw in, for the cell in this row and column."""
        left = self.LEFT + self.columns.index(column) * (self._width + self.gap)
        top = self.top + self.rows.index(row) * (self.cell_height + self.gap)
        return Panel(left, top, self._width, self.cell_height, x_range, self.y_range)

    def draw_axes(self, svg: Svg, panel: Panel, cell: tuple[str, str], labels: tuple[str, str]) -> None:
        """Grid lines of a ``cell`` (row, column), with numbers and ``labels`` (x, y) if the cell is at the edge."""
        last, first = cell[0] == self.rows[-1], cell[1] == self.columns[0]
        panel.draw_y(svg, labels[1] if first else "", count=4, numbers=first)
        panel.draw_x(svg, labels[0] if last else "", count=5, numbers=last)

    def draw_columns(self, svg: Svg, y: float) -> None:
        """Write the moved axis above each column."""
        for column, axis in enumerate(self.columns):
            x = self.LEFT + column * (self._width + self.gap) + self._width / 2.0
            svg.text((x, y), f"moving {axis}", "t-soft", anchor="middle")


def draw_sequence(svg: Svg, at: XY, cell: float, top: float, unit: str) -> None:
    """Draw the key of the five colours for sizes from zero to ``top``. ``at``: upper left corner; ``cell``: width of a colour, pixels."""
    x, y = at
    for i in range(SEQUENCE):
        svg.rect((x + i * cell, y), (cell, 9.0), f"f-seq{i + 1}")
        svg.text((x + i * cell, y + 23.0), tidy(i * top / SEQUENCE), "t-small", anchor="middle")
    svg.text((x + SEQUENCE * cell, y + 23.0), f"{tidy(top)} {unit}", "t-small", anchor="middle")


def sequence_level(size: float, top: float) -> int:
    """Level of a size on the colour scale, 1 to 5."""
    return 1 + min(SEQUENCE - 1, int(SEQUENCE * size / top))
