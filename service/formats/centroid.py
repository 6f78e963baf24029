"""Centroid ballscrew table, version 3 (cnc-x.tab; CNC10 v2.61 and later, CNC11, CNC12): corrections for both directions of motion.

Five lines of heading (version, axis, units, interval, number of entries), then a line per point: position, correction while moving in +,
correction while moving in −, separated by tabs. The first point is the reference; the others follow away from it. Sources: cncsnw.com,
"Laser Compensation" (versions, file names, both directions), and a control's own file of zeros (github.com/teno1608/PLC-CNC-lathe-machine,
cnc-x.tab). Neither states the unit of a correction (this module takes the unit of the heading), its sign, or which column is which: verify
the 10 µm step first, in both directions (docs/reference/formats.md). Version 1 (CNC7 up to v7.17) is neither written nor read.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, whole
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=1000, equidistant=True)
SIGN = SignRule(-1, False, "by manual", False, "amount of correction to apply: −e; not stated in a manual")
WHAT = "Centroid ballscrew table"
VERSION = "CNC10 TAB FILE VERSION 3"
HEADING = ("AXIS", "UNITS", "INTERVAL", "ENTRIES")


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one file per axis; the reference must be one end of the table.

    Raises
    ------
    FormatRefused
        The table is of another kind or is not zero at the reference, or the reference is at neither end.
    """
    check_kinds(comp, LIMITS, WHAT)
    files = []
    for table in comp.tables:
        check_table(table, LIMITS, WHAT, settings.reference_mm, settings.step_mm)
        position = table.position_mm
        reference = position[0] if settings.reference_mm is None else settings.reference_mm[AXES.index(table.axis)]
        if min(abs(reference - e) for e in (position[0], position[-1])) > 1e-6:
            raise FormatRefused(
                f"{WHAT}, table {table.name}: the reference {reference:g} mm is at neither end of the table",
                f"choose another grid; {NOTHING}",
            )
        way = 1 if abs(reference - position[0]) <= 1e-6 else -1
        values = (table.axis, "MM", whole(float(np.ptp(position)) / (position.size - 1), 6), str(position.size))
        lines = [VERSION, *(f"{k} {v}" for k, v in zip(HEADING, values, strict=True))]
        columns = (position, *(SIGN.to_file(v, position) for v in (table.forward_mm, table.backward_mm)))
        rows = zip(*(c[::way] for c in columns), strict=True)
        lines += ["\t".join((whole(p, 6), *(whole(v, settings.decimals) for v in both))) for p, *both in rows]
        files.append(TextFile(f"cnc-{table.axis.lower()}.tab", "\n".join(lines) + "\n"))
    return tuple(files)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read version 3 files.

    Raises
    ------
    TableFileError
        The heading is of another version, axis or unit; the number or interval of the entries is not the stated one; or a value is not a
        number.
    """
    return Compensation(tuple(_read_one(f) for f in files))


def _read_one(file: TextFile) -> AxisTable:
    lines = [text.rstrip() for _, text in file.lines()]
    if not lines or lines[0] != VERSION:
        raise file.wrong(1, f"the first line is {lines[0] if lines else ''!r}, expected {VERSION!r}", "export the table from the control")
    head = [line.split() for line in lines[1:5]]
    for n, (key, words) in enumerate(zip(HEADING, [*head, [], [], [], []], strict=False), start=2):
        if len(words) != 2 or words[0] != key:
            raise file.wrong(n, f"the line is {' '.join(words)!r}, expected {key} and its value")
    axis, unit = head[0][1], head[1][1]
    if axis not in AXES or unit != "MM":
        raise file.wrong(2 if axis not in AXES else 3, f"axis {axis}, units {unit}: expected X, Y or Z, and MM")
    interval, count = (file.number(n, head[n - 2][1], HEADING[n - 2]) for n in (4, 5))
    rows: list[list[float]] = []
    for line, text in enumerate(lines[5:], start=6):
        cells = text.split()
        if len(cells) != 3:
            raise file.wrong(line, f"{len(cells)} values, expected position and two corrections")
        rows.append([file.number(line, w, n) for w, n in zip(cells, ("the position", "forward", "reverse"), strict=True)])
        if len(rows) > 1 and abs(abs(rows[-1][0] - rows[-2][0]) - interval) > 1e-5:
            raise file.wrong(line, f"position {rows[-1][0]:g} after {rows[-2][0]:g}, the interval is {interval:g}")
    if len(rows) != count or count < 2:
        raise file.wrong(len(lines), f"{len(rows)} entries, {count:g} stated")
    return _table(file, axis, np.array(rows))


def _table(file: TextFile, axis: str, rows: F1) -> AxisTable:
    way = 1 if rows[1, 0] > rows[0, 0] else -1
    position, there, back = (rows[::way, k] for k in range(3))
    if not (np.diff(position) > 0).all():
        raise file.wrong(6, "the positions turn back, expected all rising or all falling")
    return AxisTable(axis, axis, position, SIGN.from_file(there, position), SIGN.from_file(back, position))
