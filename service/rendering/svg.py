"""A small SVG writer: the same calls always give the same bytes.

Elements carry style classes, not colours (see ``palette``). Elements without finite coordinates are left out, so that a gap in the data
becomes a gap in the plot and never a broken file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from unicodedata import east_asian_width

from abbe.service.rendering.numbers import printable
from abbe.service.rendering.phrases import LANGUAGES, phrase

XY = tuple[float, float]


def coordinate(value: float) -> str:
    """Pixel coordinate with at most two decimals, which are accurate enough and keep the file short."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in {"-0", ""} else text


class Svg:
    """One picture. Coordinates in pixels, y downwards; the page scales it.

    ``key``: identifier, unique in the page. ``title``, ``desc``: text for screen readers.
    """

    def __init__(self, width: float, height: float, key: str, title: str, desc: str = "") -> None:
        self.width = width
        self.height = height
        self._key = "".join(c if c.isascii() and (c.isalnum() or c == "-") else "-" for c in key)
        self._title = title
        self._desc = desc or title
        self._body: list[str] = []

    def line(self, start: XY, end: XY, style: str) -> None:
        """Draw a straight line."""
        if _finite(start, end):
            (x1, y1), (x2, y2) = (_pair(start), _pair(end))
            self._body.append(f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" class="{_attr(style)}"/>')

    def polyline(self, points: Iterable[XY], style: str) -> None:
        """Line through points, broken wherever a point is not finite."""
        for part in _runs(points):
            if len(part) > 1:
                self._body.append(f'<polyline points="{_points(part)}" class="{_attr(style)}"/>')
            else:
                self.dot(part[0], 1.2, style.replace("s-", "f-"))

    def polygon(self, points: Iterable[XY], style: str) -> None:
        """Filled shape; left out when one of its corners is not finite."""
        corners = list(points)
        if corners and _finite(*corners):
            self._body.append(f'<polygon points="{_points(corners)}" class="{_attr(style)}"/>')

    def rect(self, corner: XY, size: XY, style: str, tip: str = "") -> None:
        """Rectangle with the tooltip ``tip``."""
        if _finite(corner, size):
            (x, y), (w, h) = _pair(corner), _pair((abs(size[0]), abs(size[1])))
            self._body.append(f'<rect x="{x}" y="{y}" width="{w}" height="{h}" class="{_attr(style)}"{_close("rect", tip)}')

    def link(self, corner: XY, size: XY, href: str) -> None:
        """Invisible area; a script of the page opens ``href`` on a click. Keyboard users find links beside the picture."""
        (x, y), (w, h) = _pair(corner), _pair(size)
        self._body.append(f'<rect x="{x}" y="{y}" width="{w}" height="{h}" class="leads" fill-opacity="0" data-href="{_attr(href)}"/>')

    def circle(self, centre: XY, radius: float, style: str) -> None:
        """Circle outline."""
        if _finite(centre, (radius, 0.0)):
            x, y = _pair(centre)
            self._body.append(f'<circle cx="{x}" cy="{y}" r="{coordinate(radius)}" class="{_attr(style)}"/>')

    def dot(self, centre: XY, radius: float, style: str, tip: str = "") -> None:
        """Point marker with the tooltip ``tip``."""
        if _finite(centre):
            x, y = _pair(centre)
            self._body.append(f'<circle cx="{x}" cy="{y}" r="{coordinate(radius)}" class="{_attr(style)}"{_close("circle", tip)}')

    def error_bar(self, centre: XY, half: float, *, horizontal: bool = False, cap: float = 4.0) -> None:
        """Whisker of ``half`` pixels to both sides, with caps."""
        if not _finite(centre, (half, 0.0)):
            return
        x, y = centre
        dx, dy = (half, 0.0) if horizontal else (0.0, half)
        cx, cy = (0.0, cap) if horizontal else (cap, 0.0)
        self.line((x - dx, y - dy), (x + dx, y + dy), "whisker")
        for side in (-1.0, 1.0):
            self.line((x + side * dx - cx, y + side * dy - cy), (x + side * dx + cx, y + side * dy + cy), "whisker")

    def arrow(self, start: XY, end: XY, style: str, tip: str = "") -> None:
        """Arrow with a filled head, or a dot if shorter than a pixel. ``style``: role of the colour; ``tip``: tooltip."""
        if not _finite(start, end):
            return
        dx, dy = end[0] - start[0], end[1] - start[1]
        length = math.hypot(dx, dy)
        if length < 1.0:
            self.dot(start, 1.3, f"f-{style}", tip)
            return
        head = min(7.0, 1.5 + 0.35 * length)
        ux, uy = dx / length, dy / length
        base = (end[0] - head * ux, end[1] - head * uy)
        wing = 0.42 * head
        shape = (end, (base[0] - wing * uy, base[1] + wing * ux), (base[0] + wing * uy, base[1] - wing * ux))
        (x1, y1), (x2, y2) = _pair(start), _pair(base)
        self._body.append(
            f'<g><line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" class="s-{_attr(style)}"/>'
            f'<polygon points="{_points(shape)}" class="f-{_attr(style)}"/>{_tip(tip)}</g>'
        )

    def text(self, at: XY, content: object, style: str = "", *, anchor: str = "start", turn: float = 0.0) -> None:
        """Text on its base line; ``anchor`` is ``start``, ``middle`` or ``end``, ``turn`` in degrees clockwise."""
        if not _finite(at):
            return
        x, y = _pair(at)
        kind = f' class="{_attr(style)}"' if style else ""
        side = f' text-anchor="{anchor}"' if anchor != "start" else ""
        rotation = f' transform="rotate({coordinate(turn)} {x} {y})"' if turn else ""
        self._body.append(f'<text x="{x}" y="{y}"{kind}{side}{rotation}>{escape(printable(content))}</text>')

    def head(self, heading: str, below: str = "") -> None:
        """Heading in the middle of the top, with a softer line below."""
        self.text((self.width / 2.0, 18.0), heading, "t-head", anchor="middle")
        if below:
            self.text((self.width / 2.0, 36.0), below, "t-soft", anchor="middle")

    def length_key(self, end: XY, length: float, text: str) -> None:
        """Bar of ``length`` pixels that ends at ``end``, with its text below: the scale of arrows and magnified errors."""
        right, y = end
        self.line((right - length, y), (right, y), "key")
        for x in (right - length, right):
            self.line((x, y - 4.0), (x, y + 4.0), "key")
        self.text((right, y + 18.0), text, "t-small", anchor="end")

    def legend(self, at: XY, entries: Sequence[tuple[str, str]]) -> None:
        """Row of line samples with their names, with room for the names in every language. ``entries``: style class of the line, name."""
        x, y = at
        for style, name in entries:
            self.line((x, y - 4.0), (x + 22.0, y - 4.0), style)
            self.text((x + 28.0, y), name, "t-small")
            x += 44.0 + 6.2 * max(_letters(phrase(lang, name)) for lang in LANGUAGES)

    def render(self) -> str:
        """The ``<svg>`` element, ready to stand inside an HTML page (which needs no namespace declaration)."""
        width, height = coordinate(self.width), coordinate(self.height)
        title, desc = escape(printable(self._title)), escape(printable(self._desc))
        head = (
            f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img"'
            f' aria-labelledby="{self._key}-t {self._key}-d"><title id="{self._key}-t">{title}</title>'
            f'<desc id="{self._key}-d">{desc}</desc>'
        )
        return head + "\n".join(self._body) + "</svg>"


def _letters(text: str) -> int:
    """Width of a text in Latin letters; those of East Asia are twice as wide."""
    return sum(2 if east_asian_width(letter) in "WF" else 1 for letter in text)


def _finite(*points: XY) -> bool:
    return all(math.isfinite(v) for point in points for v in point)


def _pair(point: XY) -> tuple[str, str]:
    return coordinate(point[0]), coordinate(point[1])


def _points(points: Iterable[XY]) -> str:
    return " ".join(",".join(_pair(p)) for p in points)


def _runs(points: Iterable[XY]) -> Iterable[list[XY]]:
    part: list[XY] = []
    for point in points:
        if _finite(point):
            part.append(point)
        elif part:
            yield part
            part = []
    if part:
        yield part


def _attr(text: str) -> str:
    return escape(text, quote=True)


def _tip(tip: str) -> str:
    return f"<title>{escape(printable(tip))}</title>" if tip else ""


def _close(name: str, tip: str) -> str:
    return f">{_tip(tip)}</{name}>" if tip else "/>"
