"""Scales and axes: from numbers to pixels, with ticks at 1, 2 and 5."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from abbe.service.rendering.numbers import finite, fixed
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
    """Range of all finite values, widened on both sides by ``margin`` times the span; 0 .. 1 without any. ``zero``: include zero."""
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
