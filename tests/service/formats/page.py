"""Writes docs/reference/formats.md from the code: ``python -m tests.service.formats.page`` (``--check``: is it current?)."""

from __future__ import annotations

import sys
from pathlib import Path

from abbe.service.formats.controls import CONTROLS
from abbe.service.formats.registry import FORMATS
from tests.service.formats.proof import all_proofs
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "formats.md"
_HEAD = """# Formats of compensation tables

Written by `python -m tests.service.formats.page` from `service/formats`; a test checks that it is current. e = actual − nominal: a machine
that goes too far has e > 0 and needs the correction −e. How to export: [Make tables and files for a control](../how-to/tables.md).

**Verified by execution**: the rule was seen on the real control (LinuxCNC 2.9, positions read back; specification, "Controllers", 1.4 and
1.5). **By manual**: read in documents only; no such control was at hand.

| format | what it holds | points of a table | sign of the number | evidence | how to activate |
|---|---|---|---|---|---|
"""
_PROOF = """
## The 10 µm step

Before the first real table: an error of +10 µm at one place is written, and the axis is measured there. If it moves as in the last column,
sign, axis, unit and scale are right. If it moves by 10 µm the other way, `abbe comp export --step-moved 10` writes the other sign, where
no manual states it; `--step-moved -10` records that the sign is confirmed. By another amount: nothing may be loaded. Points at 0, 50, 100,
150, 200 mm, reference 0; products: 50 µrad at Y 100 times a lever of 200 mm; grid: nodes at 0, 100, 200.

| format | table | lines of the file that are not as in a table of zeros | place | the axis has to move by |
|---|---|---|---|---|
"""
_CEC = """
Siemens CEC: two public tools of rotary tables (files 51872898796 and 51984388978 of a public index of source code, apparently of one French
builder) write +e; no manual states the sign.
"""
_CONTROLS = """
## Controls

What `abbe comp export --format CONTROL` chooses among. Order of effects: own-axis tables act first; where a control looks the others up is
in the last column.

| control | what | own-axis | cross and products | grid, motions or commands | looked up at |
|---|---|---|---|---|---|
"""


def page() -> str:
    """The whole page."""
    text = _HEAD
    for f in FORMATS.values():
        words = ("own", "cross", "products", "lattice", "motions", "lines", "lost_motion")
        held = ", ".join(w.replace("_", " ") for w in words if getattr(f.limits, w))
        held += "; both directions" if f.limits.own and f.limits.directional else ""
        sure = "" if f.sign.sure else " **(see the step first)**"
        text += f"| `{f.key}` {f.name} | {held} | {f.limits.points} | {f.sign.text}{sure} | {f.sign.evidence} | {f.live} |\n"
    text += _PROOF
    for p in all_proofs():
        at = ", ".join(f"{v:g}" for v in p.at_mm)
        way = "+" if p.direction > 0 else "−"
        lines = "<br>".join(f"`{line}`" for line in p.lines)
        text += f"| `{p.format}` | {p.what} | {lines} | {at}, moving in {way} | {p.axis} {p.added_mm * 1e3:+.3f} µm |\n"
    text += _CEC + _CONTROLS
    for c in CONTROLS.values():
        own = (
            f"`{c.own_format}`, {c.own_points} points, {'both directions' if c.both_directions else 'one direction'}"
            if c.own_format
            else "none"
        )
        cross = f"`{c.cross_format}`, {c.cross_points} points" + (", products" if c.products else "") if c.cross_format else "none"
        cross += f", at most {c.tables} tables" if c.tables is not None else ""
        rest = (
            f"`{c.lattice_format}`, {c.nodes} nodes an axis"
            if c.lattice_format
            else f"`{c.motions_format or c.lines_format}`"
            if c.motions_format or c.lines_format
            else "none"
        )
        text += f"| `{c.key}` | {c.name} | {own} | {cross} | {rest} | {c.lookup} |\n"
    return text


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.service.formats.page", __doc__))
