"""From a plan to the text of an NC program: G-code (Siemens, Fanuc, LinuxCNC, plain ISO 6983) or Heidenhain conversational."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.models.paths import PLANES
from abbe.service.domain.machine import Point
from abbe.service.domain.machine_file import NcSettings
from abbe.service.errors import ConfigError
from abbe.service.sequences.nc.blocks import Arc, Block, Comment, Dwell, Go, Halt, Program, Smooth, program
from abbe.service.sequences.steps import CampaignPlan

LAST_NUMBER = 999
"""Number of blocks after which the block numbers restart (N10 to N9990): old controllers take four digits."""
PLANE_CODES = {"XY": "G17", "ZX": "G18", "YZ": "G19"}


@dataclass(frozen=True, slots=True)
class Dialect:
    """G-code of one controller. ``start``, ``end``: first and last lines; ``safe``: modal codes; ``smooth``, ``exact``: corner modes."""

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
    """Return a program as G-code text; ``number``: the program's number (Fanuc)."""
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
    """Return a text for old controllers: ASCII, no brackets or quotes, capitals for Fanuc and ISO."""
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


TOLERANCE_MM = 0.001


def heidenhain(made: Program, tool: int | None = None) -> str:
    """Return a program in Heidenhain conversational; blocks are numbered from 0, as on the controller.

    ``tool``: row of the tool table for the holder in the spindle. TOOL CALL sets the tool axis, normal to the plane of the arcs, and the
    length. Only the operator knows the row, and tool 0 would empty the spindle; without a row the program says where to write TOOL CALL and
    stops there.
    """
    name = "".join(c for c in plain(made.name, ISO) if c.isalnum())[:16] or "ABBE"
    lines = [f"BEGIN PGM {name} MM", "; Heidenhain program written by Abbe", *(f"; {plain(text, ISO)}" for text in made.head)]
    lines += ["CYCL DEF 7.0 DATUM SHIFT", "CYCL DEF 7.1 X+0", "CYCL DEF 7.2 Y+0", "CYCL DEF 7.3 Z+0"]
    lines += _tool_call(tool)
    lines += ["L M5"]
    for block in made.blocks:
        lines += _lines(block)
    lines += ["L M30", f"END PGM {name} MM"]
    return "\n".join(f"{k} {line}" for k, line in enumerate(lines)) + "\n"


def _tool_call(tool: int | None) -> list[str]:
    if tool is not None:
        return [f"TOOL CALL {tool} Z"]
    return [
        "; WRITE TOOL CALL N Z IN PLACE OF THE NEXT BLOCK, N: THE ROW OF THE TOOL TABLE",
        "; FOR THE HOLDER IN THE SPINDLE, L 0, R 0; NOT TOOL 0, WHICH EMPTIES THE SPINDLE",
        "L M0",
    ]


def _lines(block: Block) -> list[str]:
    match block:
        case Comment(text):
            return [f"; {plain(text, ISO)}"]
        case Halt(text):
            return [f"; {plain(text, ISO)}", "L M0"]
        case Dwell(seconds, _):
            return ["CYCL DEF 9.0 DWELL TIME", f"CYCL DEF 9.1 DWELL {seconds:.3f}"]
        case Smooth(on):
            return ["CYCL DEF 32.0 TOLERANCE", f"CYCL DEF 32.1 T{TOLERANCE_MM:g}" if on else "CYCL DEF 32.1"]
        case Go(target, feed):
            return [f"L {_point(target, 'XYZ')} R0 F{feed:.0f}"]
        case Arc(plane, _, target, centre, positive, feed):
            letters = "".join(sorted(plane))
            return [f"CC {_point(centre, letters)}", f"C {_point(target, letters)} DR{'+' if positive else '-'} R0 F{feed:.0f}"]


def _point(p: Point, letters: str) -> str:
    return " ".join(f"{a}{v:+.4f}" for a, v in zip(AXES, p, strict=True) if a in letters)


NAMES = (*DIALECTS, "heidenhain")


@dataclass(frozen=True, slots=True)
class NcProgram:
    """Program text, run time, ``size`` and run time in words, and a warning if the text exceeds the controller's memory (else empty)."""

    text: str
    runtime: Runtime
    size: str
    warning: str = ""


def nc_program(name: str, machine: Machine, plan: CampaignPlan, dialect: str, settings: NcSettings | None = None) -> NcProgram:
    """Return the NC program of a checked plan. Raises ConfigError for an unknown dialect."""
    if dialect not in NAMES:
        raise ConfigError(f"there is no NC dialect {dialect!r}", f"use one of: {', '.join(sorted(NAMES))}")
    settings = settings or NcSettings()
    arcs = ("XY",) if dialect == "heidenhain" else PLANES  # heidenhain: arcs (C) lie in the plane normal to the tool axis Z of TOOL CALL
    made = program(name, plan, machine.stroke_mm, arcs)
    pace = PathDynamics(settings.acceleration_mm_s2)
    took = runtime(made.blocks, pace)
    made = replace(made, head=(*made.head, *_runtime_comments(took, pace)))
    text = heidenhain(made, settings.heidenhain_tool) if dialect == "heidenhain" else gcode(made, DIALECTS[dialect])
    size, blocks = len(text.encode()), text.count("\n")
    memory = settings.memory_of(dialect)
    warning = _too_long(dialect, size, memory) if memory is not None and size > memory * 1024.0 else ""
    return NcProgram(text, took, f"{size} bytes, {blocks} blocks, {_minutes(made, took)}", warning)


# The run time counts every block as a controller drives it, not the plan's length at full feed.


@dataclass(frozen=True, slots=True)
class PathDynamics:
    """Assumptions about a controller: acceleration along the path, and the time of an exact stop until the axes are in position."""

    acceleration_mm_s2: float = 500.0
    stop_s: float = 0.1


@dataclass(frozen=True, slots=True)
class Runtime:
    """Time in s that the axes move (stops included) and that the program dwells. Both exclude the way to the first position and the halts
    for a person."""

    moving_s: float
    resting_s: float

    @property
    def total_s(self) -> float:
        """Time of motion and dwells together, s."""
        return self.moving_s + self.resting_s


def runtime(blocks: tuple[Block, ...], pace: PathDynamics) -> Runtime:
    """Return the time of all blocks: each line or arc from standstill to standstill; moves without a stop between them are one move."""
    moving, resting, here = 0.0, 0.0, None
    smooth, run_mm, run_feed = False, 0.0, 0.0
    for block in blocks:
        match block:
            case Dwell(seconds, _):
                resting += seconds
            case Smooth(on):
                moving += one_move_s(run_mm, run_feed, pace) if run_mm else 0.0
                smooth, run_mm = on, 0.0
            case Go() | Arc():
                way = _way_mm(block, here)
                here = block.target_mm
                if smooth and (run_feed == block.feed_mm_min or not run_mm):
                    run_mm, run_feed = run_mm + way, block.feed_mm_min
                else:
                    moving += one_move_s(way, block.feed_mm_min, pace)
    return Runtime(moving + (one_move_s(run_mm, run_feed, pace) if run_mm else 0.0), resting)


def one_move_s(way_mm: float, feed_mm_min: float, pace: PathDynamics) -> float:
    """Return the time in s from standstill to standstill: accelerate, run at the feed if the length allows it, brake, stop exactly."""
    if way_mm <= 0.0:
        return 0.0
    speed, rise = feed_mm_min / 60.0, pace.acceleration_mm_s2
    if way_mm < speed**2 / rise:
        return 2.0 * math.sqrt(way_mm / rise) + pace.stop_s
    return way_mm / speed + speed / rise + pace.stop_s


def _way_mm(block: Go | Arc, here: Point | None) -> float:
    if isinstance(block, Go):
        return 0.0 if here is None else math.dist(here, block.target_mm)
    a, b = ("XYZ".index(c) for c in block.plane)
    first, last = (math.atan2(p[b] - block.centre_mm[b], p[a] - block.centre_mm[a]) for p in (block.start_mm, block.target_mm))
    turn = (last - first if block.positive else first - last) % (2.0 * np.pi)
    return float(turn * math.hypot(block.start_mm[a] - block.centre_mm[a], block.start_mm[b] - block.centre_mm[b]))


def _minutes(made: Program, took: Runtime) -> str:
    return f"about {math.ceil(took.total_s / 60.0)} min without the {made.halts} stops for a person"


def _runtime_comments(took: Runtime, pace: PathDynamics) -> tuple[str, str]:
    """Return comments with the run time, rounded up: the operator should wait less than announced, not longer."""
    return (
        f"runs {math.ceil(took.total_s / 60.0)} min: {took.moving_s:.0f} s of moves, {took.resting_s:.0f} s of dwells, without"
        " the stops for a person and the way to the first position",
        f"computed with {pace.acceleration_mm_s2:g} mm/s2 along the path, {pace.stop_s:g} s at each exact stop, feed override 100 percent",
    )


def _too_long(dialect: str, size: int, memory_kib: float) -> str:
    return (
        f"the program has {size / 1024.0:.0f} KiB, and a {dialect} control is assumed to hold {memory_kib:g} KiB: run it from its card or"
        " by drip feed, shorten the recipe, or set memory_kib under [nc] to what your control holds"
    )
