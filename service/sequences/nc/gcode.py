"""G-code dialects: Siemens, Fanuc, LinuxCNC, and plain ISO 6983."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.models.machine import AXES
from abbe.service.sequences.nc.blocks import Arc, Block, Comment, Dwell, Go, Halt, Program, Smooth
from abbe.service.sequences.steps import Point

LAST_NUMBER = 999
"""Block numbers restart after N9990: old controllers take four digits."""
PLANE_CODES = {"XY": "G17", "ZX": "G18", "YZ": "G19"}


@dataclass(frozen=True, slots=True)
class Dialect:
    """G-code of one controller. ``start`` and ``end``: first and last lines; ``safe``: modes; ``smooth``, ``exact``: corners."""

    title: str
    suffix: str
    start: tuple[str, ...]
    safe: tuple[str, ...]
    end: tuple[str, ...]
    smooth: str
    exact: str
    dwell: str
    comment: str
    message: tuple[str, ...]
    digits: int = 5
    numbered: bool = False


SIEMENS = Dialect(
    "Siemens SINUMERIK", "mpf", (), ("G500 G90 G710 G94 G17 G40 D0", "M5"), ("MSG()", "M30"),
    smooth="G64", exact="G60 G601", dwell="G4 F{seconds}", comment="; {text}", message=('MSG("{text}")', "M0"),
)  # fmt: skip
FANUC = Dialect(
    "Fanuc", "nc", ("%", "O{number:04d} ({name})"), ("G21 G90 G94 G17 G40 G49 G80", "M5"), ("M30", "%"),
    smooth="G64", exact="G61", dwell="G04 P{milliseconds}", comment="({text})", message=("M00 ({text})",), digits=4, numbered=True,
)  # fmt: skip
LINUXCNC = Dialect(
    "LinuxCNC", "ngc", ("%",), ("G21 G90 G94 G17 G40 G49 G54 G92.1 G80", "M5"), ("M2", "%"),
    smooth="G64 P0.001", exact="G61", dwell="G4 P{seconds}", comment="({text})", message=("(MSG, {text})", "M0"),
)  # fmt: skip
ISO = Dialect(
    "ISO 6983", "iso", ("%",), ("G71 G90 G94 G17 G40", "M5"), ("M30", "%"),
    smooth="G64", exact="G61", dwell="G04 X{seconds}", comment="({text})", message=("({text})", "M00"), numbered=True,
)  # fmt: skip
DIALECTS = {"siemens": SIEMENS, "fanuc": FANUC, "linuxcnc": LINUXCNC, "iso": ISO}


def gcode(made: Program, dialect: Dialect, number: int = 1) -> str:
    """Return the program text."""
    writer = _Writer(dialect)
    lines = [line.format(number=number, name=plain(made.name, dialect)[:30]) for line in dialect.start]
    body = [_comment(dialect, f"{dialect.title} program written by Abbe"), *(_comment(dialect, text) for text in made.head)]
    body += [*dialect.safe, dialect.exact]
    for block in made.blocks:
        body += writer.lines(block)
    for k, line in enumerate(body, start=1):
        lines.append(f"N{10 * ((k - 1) % LAST_NUMBER + 1)} {line}" if dialect.numbered and not line.startswith("(") else line)
    return "\n".join([*lines, *dialect.end]) + "\n"


def plain(text: str, dialect: Dialect) -> str:
    """Text for old controllers: ASCII, no brackets or quotes, capitals for Fanuc and ISO."""
    ascii_text = text.replace("µ", "u").encode("ascii", "replace").decode()
    kept = "".join(c if c.isalnum() or c in " .,:;+-/=" else " " for c in ascii_text).replace(";", ",")
    kept = " ".join(kept.split())
    return kept.upper() if dialect is FANUC or dialect is ISO else kept


def _comment(dialect: Dialect, text: str) -> str:
    return dialect.comment.format(text=plain(text, dialect))


class _Writer:
    """Turns blocks into lines; keeps the modal state."""

    def __init__(self, dialect: Dialect) -> None:
        self._d = dialect
        self._feed = 0.0
        self._plane = "XY"

    def lines(self, block: Block) -> list[str]:
        match block:
            case Comment(text):
                return [_comment(self._d, text)]
            case Halt(text):
                return [line.format(text=plain(text, self._d)[:100]) for line in self._d.message]
            case Dwell(seconds, _):
                return [self._d.dwell.format(seconds=f"{seconds:.3f}", milliseconds=round(seconds * 1e3))]
            case Smooth(on):
                return [self._d.smooth if on else self._d.exact]
            case Go(target, feed):
                return [f"G1 {self._point(target)}{self._f(feed)}"]
            case Arc():
                return self._arc(block)

    def _arc(self, arc: Arc) -> list[str]:
        out = [] if arc.plane == self._plane else [PLANE_CODES[arc.plane]]
        self._plane = arc.plane
        centre = " ".join(f"{'IJK'[k]}{self._n(arc.centre_mm[k] - arc.start_mm[k])}" for k in sorted("XYZ".index(c) for c in arc.plane))
        return [*out, f"{'G3' if arc.positive else 'G2'} {self._point(arc.target_mm)} {centre}{self._f(arc.feed_mm_min)}"]

    def _f(self, feed_mm_min: float) -> str:
        if feed_mm_min == self._feed:
            return ""
        self._feed = feed_mm_min
        return f" F{feed_mm_min:.3f}".rstrip("0").rstrip(".") + ("." if self._d is FANUC else "")

    def _point(self, p: Point) -> str:
        return " ".join(f"{a}{self._n(v)}" for a, v in zip(AXES, p, strict=True))

    def _n(self, value: float) -> str:
        text = f"{value:.{self._d.digits}f}".rstrip("0")
        return "0." if text in {"-0.", "0."} else text
