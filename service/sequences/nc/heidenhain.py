"""Heidenhain plain language (Klartext)."""

from __future__ import annotations

from abbe.models.machine import AXES
from abbe.service.sequences.nc.blocks import Arc, Block, Comment, Dwell, Go, Halt, Program, Smooth
from abbe.service.sequences.nc.gcode import ISO, plain
from abbe.service.sequences.steps import Point

TOLERANCE_MM = 0.001


def heidenhain(made: Program, tool: int | None = None) -> str:
    """Return the program text; blocks are numbered from 0, as on the controller.

    ``tool``: row of the tool table for the holder in the spindle. TOOL CALL sets the axis of the arcs' plane and the length. Only the
    operator knows the row, and tool 0 would empty the spindle; without a row the program marks the place of the block and stops there.
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
