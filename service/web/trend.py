"""One figure over time as SVG: points with their uncertainty, the limit, axes with units. No script, no inline style (CSP)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from html import escape
from itertools import pairwise

from abbe.service.web.formatting import number

WIDTH, HEIGHT = 560, 230
LEFT, RIGHT, TOP, BOTTOM = 58, 40, 16, 40
MANY = 120
"""Above this number, points are too close for a pointer, and points that look alike are drawn as one path."""


@dataclass(frozen=True, slots=True)
class Point:
    """A figure of one check. ``verdict`` is that of the figure; ``earlier``: measured with an earlier table; ``href``: its screen."""

    at: datetime
    value: float
    uncertainty: float
    limit: float | None
    verdict: str
    earlier: bool = False
    href: str = ""


@dataclass(frozen=True, slots=True)
class _PixelScale:
    """Maps [low, high] to pixels."""

    low: float
    high: float
    first_px: float
    last_px: float

    def __call__(self, value: float) -> float:
        return self.first_px + (value - self.low) / (self.high - self.low) * (self.last_px - self.first_px)


def trend_svg(name: str, unit: str, points: Sequence[Point], zone: tzinfo, changes: Sequence[datetime] = ()) -> str:
    """The plot as an SVG element.

    ``name``, ``unit`` label the vertical axis; ``points`` may have any order and must not be empty; ``zone`` applies to the dates;
    ``changes``: times when another table came into force, drawn as vertical lines. Points of an earlier table are grey.
    """
    points = sorted(points, key=lambda point: point.at)
    changes = [time for time in changes if time >= points[0].at]
    x, y = _time_scale(points, changes), _value_scale(points)
    label = f"{name} [{unit}]" if unit else name
    body = [*_grid(y), *_dates(points, x, zone), *_limit(points, x, y), *_changes(changes, x)]
    if len(points) > MANY:
        body += _joined(points, x, y)
    else:
        for point in points:
            body += _mark(point, x(point.at.timestamp()), y, unit)
    body.append(f'<text class="axis" x="{LEFT}" y="11">{escape(label)}</text>')
    newest = points[-1]
    title = f"{name}: {len(points)} checks, latest {number(newest.value)} {unit}"
    return (
        f'<svg class="trend" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}" xmlns="http://www.w3.org/2000/svg">'
        + "".join(body)
        + "</svg>"
    )


def _changes(changes: Sequence[datetime], x: _PixelScale) -> list[str]:
    """Vertical lines where another table came into force."""
    lines = [f"M{x(time.timestamp()):.1f} {TOP + 4}V{HEIGHT - BOTTOM}" for time in changes]
    return [f'<path class="changed" d="{line}"/>' for line in lines]


def _time_scale(points: Sequence[Point], changes: Sequence[datetime]) -> _PixelScale:
    first, last = points[0].at.timestamp(), max([points[-1].at, *changes]).timestamp()
    # A single check, or several within a minute, still need an axis with a length.
    margin = max((last - first) * 0.04, 30.0)
    return _PixelScale(first - margin, last + margin, LEFT, WIDTH - RIGHT)


def _value_scale(points: Sequence[Point]) -> _PixelScale:
    highs = [point.value + point.uncertainty for point in points] + [point.limit for point in points if point.limit is not None]
    lows = [point.value - point.uncertainty for point in points]
    step = _step(max(highs) - min(0.0, *lows))
    low = math.floor(min(0.0, *lows) / step) * step
    high = math.ceil(max(highs) * 1.04 / step) * step
    return _PixelScale(low, max(high, low + step), HEIGHT - BOTTOM, TOP + 4)


def _step(length: float) -> float:
    """A round step that divides ``length`` into two to five parts."""
    rough = max(length, 1e-9) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)


def _grid(y: _PixelScale) -> list[str]:
    step = _step(y.high - y.low)
    lines = []
    for index in range(round((y.high - y.low) / step) + 1):
        value = y.low + index * step
        lines.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>')
        lines.append(f'<text class="tick" x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:g}</text>')
    return lines


def _dates(points: Sequence[Point], x: _PixelScale, zone: tzinfo) -> list[str]:
    length = timedelta(seconds=x.high - x.low)
    form = "%H:%M:%S" if length < timedelta(minutes=10) else "%H:%M" if length < timedelta(hours=36) else "%d %b"
    texts = []
    for part in (0.125, 0.375, 0.625, 0.875):
        time = datetime.fromtimestamp(x.low + part * (x.high - x.low), zone)
        texts.append(
            f'<text class="tick" x="{x(time.timestamp()):.1f}" y="{HEIGHT - BOTTOM + 17}" text-anchor="middle">{time:{form}}</text>'
        )
    day = points[-1].at.astimezone(zone).strftime("%Y-%m-%d")
    texts.append(
        f'<text class="axis" x="{WIDTH - RIGHT}" y="{HEIGHT - 5}" text-anchor="end">time ({escape(str(zone))}), up to {day}</text>'
    )
    return texts


def _limit(points: Sequence[Point], x: _PixelScale, y: _PixelScale) -> list[str]:
    """The limit as a step line, since the machine file may have changed it."""
    known = [(x(point.at.timestamp()), y(point.limit)) for point in points if point.limit is not None]
    if not known:
        return []
    path = (
        f"M{LEFT} {known[0][1]:.1f}"
        + "".join(f"H{px:.1f}V{py:.1f}" for (_, before), (px, py) in pairwise(known) if py != before)
        + f"H{WIDTH - RIGHT}"
    )
    last_y = known[-1][1]
    return [
        f'<path class="limit" d="{path}"/>',
        # Beside the plot, not in it: the newest point may lie on the limit.
        f'<text class="limit-text" x="{WIDTH - RIGHT + 5}" y="{last_y + 4:.1f}">limit</text>',
    ]


SHAPES = {"pass": "h0", "fail": "m-3 -3l6 6m0 -6l-6 6", "unclear": "m0 -3l3 3l-3 3l-3 -3z"}


def _joined(points: Sequence[Point], x: _PixelScale, y: _PixelScale) -> list[str]:
    """Uncertainty bars and marks of many points: a path for the bars, and one for each kind of mark."""
    paths: dict[str, list[str]] = {"bar": []}
    for point in points:
        px = f"{x(point.at.timestamp()):.1f}"
        paths["bar"].append(f"M{px} {y(point.value + point.uncertainty):.1f}V{y(point.value - point.uncertainty):.1f}")
        look = point.verdict if point.verdict in SHAPES else "unclear"
        paths.setdefault(f"many {look}{' earlier' if point.earlier else ''}", []).append(f"M{px} {y(point.value):.1f}{SHAPES[look]}")
    return [f'<path class="{look}" d="{"".join(parts)}"/>' for look, parts in paths.items()]


def _mark(point: Point, px: float, y: _PixelScale, unit: str) -> list[str]:
    """Uncertainty bar and mark of a point; shape and colour of the mark show the verdict."""
    top, bottom, middle = y(point.value + point.uncertainty), y(point.value - point.uncertainty), y(point.value)
    bar = f'<path class="bar" d="M{px:.1f} {top:.1f}V{bottom:.1f}M{px - 4:.1f} {top:.1f}h8M{px - 4:.1f} {bottom:.1f}h8"/>'
    text = f"{number(point.value)} ± {number(point.uncertainty)} {unit}, {point.verdict}"
    hover = f"<title>{escape(text + (', earlier table' if point.earlier else ''))}</title>"
    earlier = " earlier" if point.earlier else ""
    if point.verdict == "pass":
        mark = f'<circle class="pass{earlier}" cx="{px:.1f}" cy="{middle:.1f}" r="4">{hover}</circle>'
    elif point.verdict == "fail":
        mark = f'<path class="fail{earlier}" d="M{px - 5:.1f} {middle - 5:.1f}l10 10m0 -10l-10 10">{hover}</path>'
    else:
        mark = f'<path class="unclear{earlier}" d="M{px:.1f} {middle - 5:.1f}l5 5l-5 5l-5 -5z">{hover}</path>'
    # A script opens the screen of the check; the table of the checks has the same links for the keyboard.
    return [bar, f'<g data-href="{escape(point.href)}">{mark}</g>' if point.href else mark]
