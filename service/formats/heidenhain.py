"""Heidenhain .COM value tables and the .CMA that assigns them (MANUALplus 620 pp. 716-718, TNC 407 pp. 153-156).

There is one .COM file per input axis. Its column X, Y or Z holds the correction of that axis as a function of the input axis, so it also
takes straightness and sag. Column BACKLASH holds the correction of the input axis itself while it moves in −. The heading differs per
control: export a table from the target control and compare. The sign of the values differs between manuals: verify the 10 µm step first
(docs/reference/formats.md).
"""

from __future__ import annotations

import re

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, fixed, increasing
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=256, cross=True)
SIGN = SignRule(-1, False, "by manual", False, "compensation value: −e; manuals differ (error or correction), a public tool writes +e")
WHAT = "Heidenhain .COM"
POSITION_DECIMALS = 4
ASSIGNMENT = "CONFIG.CMA"
UNIT_MM = 1e-4
_EQUAL = re.compile(r"DATUM:(\S+)\s+DISTANCE:(\S+)")
"""Heading of an iTNC 530: equal distances in place of a column AXISPOS. This module reads the heading, but does not write it."""
STEEPEST = 64
"""TNC 4xx: neighbouring values may differ by at most the spacing divided by this number."""


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one .COM per input axis, and CONFIG.CMA, whose only line is the active one.

    Raises
    ------
    FormatRefused
        The table is of another kind, is a direction-dependent cross table (only own-axis tables have BACKLASH), exceeds a limit, or has
        positions finer than 0.1 µm.
    """
    check_kinds(comp, LIMITS, WHAT)
    files, names = [], {}
    for axis in AXES:
        mine = [t for t in comp.tables if t.axis == axis]
        if not mine:
            continue
        for table in mine:
            check_table(table, LIMITS, WHAT, settings.reference_mm, settings.step_mm)
            if table.directional and not table.own:
                raise FormatRefused(
                    f"{WHAT}, table {table.name}: the two directions of motion differ, and only own-axis tables have a BACKLASH column",
                    f"give the mean of both; {NOTHING}",
                )
            if not np.array_equal(table.position_mm, mine[0].position_mm):
                raise FormatRefused(
                    f"{WHAT}: the tables over {axis} have different points, but share one column of positions",
                    f"use the same points; {NOTHING}",
                )
        _check_positions(mine, settings)
        names[axis] = f"{axis}.COM"
        files.append(TextFile(names[axis], _com(axis, mine, settings)))
    return (*files, assignment(names))


def assignment(names: dict[str, str]) -> TextFile:
    """Return the .CMA that assigns a file to each axis; its only line is the active one."""
    head = "NR   " + "".join(f"{a:<12}" for a in AXES) + "ACTIVE"
    row = "0    " + "".join(f"{names.get(a, ''):<12}" for a in AXES) + "*"
    return TextFile(ASSIGNMENT, "\n".join([f"BEGIN {ASSIGNMENT}", head, row, "[END]"]) + "\n")


def check_fine(position: F1, axis: str, what: str) -> None:
    """Refuse positions finer than 0.1 µm.

    Raises
    ------
    FormatRefused
        A position needs more decimals than are written.
    """
    if np.abs(np.round(position, POSITION_DECIMALS) - position).max() > 1e-7:
        raise FormatRefused(f"{what}: positions over {axis} are finer than 0.1 µm", f"choose another grid; {NOTHING}")


def _check_positions(tables: list[AxisTable], settings: FormatSettings) -> None:
    position = tables[0].position_mm
    check_fine(position, tables[0].axis, WHAT)
    if not settings.power_of_two:
        return
    units = np.diff(position) / UNIT_MM
    power = np.log2(units[0])
    if np.ptp(units) > 1e-3 or abs(power - round(power)) > 1e-6:
        raise FormatRefused(
            f"{WHAT}: spacing over {tables[0].axis} is {units[0] * UNIT_MM:g} mm, this control wants a power of two times 0.1 µm",
            f"take a spacing of 6.5536 mm (2^16 times 0.1 µm), or double or half that; {NOTHING}",
        )
    steepest = max(float(np.abs(np.diff(v)).max()) for t in tables for v in (t.forward_mm, t.backward_mm))
    if steepest > units[0] * UNIT_MM / STEEPEST:
        raise FormatRefused(
            f"{WHAT}: values over {tables[0].axis} change by {steepest * 1e3:.1f} µm from point to point, more than spacing / {STEEPEST}",
            NOTHING,
        )


def _com(axis: str, tables: list[AxisTable], settings: FormatSettings) -> str:
    position = tables[0].position_mm
    own = next((t for t in tables if t.own), None)
    columns: dict[str, F1] = {}
    if own is not None and own.directional:
        columns["BACKLASH"] = SIGN.to_file(own.backward_mm, position)
    columns |= {t.output: SIGN.to_file(t.forward_mm, position) for t in sorted(tables, key=lambda t: t.output)}
    lines = [f"BEGIN {axis}.COM MM", "NR   AXISPOS      " + "".join(f"{c:<12}" for c in columns).rstrip()]
    for k, p in enumerate(position):
        cells = "".join(f"{fixed(v[k], settings.decimals):<12}" for v in columns.values())
        lines.append(f"{k:<5}{fixed(p, POSITION_DECIMALS):<13}{cells}".rstrip())
    return "\n".join([*lines, "[END]"]) + "\n"


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the tables that the active line of the .CMA names; without a .CMA, all .COM files.

    Raises
    ------
    TableFileError
        The number of active lines is not one, a named file or [END] is missing (truncated file), there are too many points, or positions
        do not increase.
    """
    return Compensation(tuple(table for axis, file in assigned(files) for table in _read_com(file, axis)))


def assigned(files: tuple[TextFile, ...]) -> list[tuple[str, TextFile]]:
    """Return the axes and their .COM files: by the active line of the .CMA, or, if there is no .CMA, by the last letter of the names.

    Such names are X.COM and AXIS_X.COM.

    Raises
    ------
    TableFileError
        The number of active lines is not one, or a named file is missing.
    """
    by_name = {f.name.upper(): f for f in files}
    cma = next((f for n, f in by_name.items() if n.endswith(".CMA")), None)
    names = {n[-5:-4]: n for n in by_name if n.endswith(".COM")} if cma is None else _active(cma)
    for name in names.values():
        if name not in by_name:
            assert cma is not None
            raise cma.wrong(3, f"the file {name} of the active line is missing")
    return [(axis, by_name[name]) for axis, name in sorted(names.items())]


def body(file: TextFile) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the column names of a table between BEGIN and [END], and its rows with their line numbers."""
    lines = list(file.lines())
    if not lines or not lines[0][1].startswith("BEGIN "):
        raise file.wrong(1, "the first line is not BEGIN")
    if lines[-1][1].strip() != "[END]":
        raise file.wrong(len(lines), "[END] is missing: the file is cut off")
    if len(lines) < 3:
        raise file.wrong(1, "the table has no columns")
    return lines[1][1].split(), [(n, text.split()) for n, text in lines[2:-1]]


def _active(cma: TextFile) -> dict[str, str]:
    lines = list(cma.lines())
    columns, rows = body(cma)
    active = [n for n, cells in rows if cells and cells[-1] == "*"]
    if len(active) != 1:
        raise cma.wrong(active[1] if active else 3, f"{len(active)} lines are active, expected one")
    head, row = lines[1][1], lines[active[0] - 1][1]
    at = {c: head.index(f" {c}") + 1 for c in columns if c in AXES}  # columns are located by their position, because cells may be empty
    found = {c: row[k : k + 12].strip().rstrip("*").strip().upper() for c, k in at.items()}
    return {c: v for c, v in found.items() if v}


def _read_com(file: TextFile, axis: str) -> list[AxisTable]:
    columns, rows = body(file)
    if (equal := _EQUAL.search(file.text.partition("\n")[0])) is not None and columns[:1] == ["NR"] and "AXISPOS" not in columns:
        datum, distance = (file.number(1, w, "DATUM or DISTANCE") for w in equal.groups())
        columns = ["NR", "AXISPOS", *columns[1:]]
        rows = [(line, [*cells[:1], repr(datum + k * distance), *cells[1:]]) for k, (line, cells) in enumerate(rows)]
    if columns[:2] != ["NR", "AXISPOS"] or not set(columns[2:]) <= {"BACKLASH", *AXES} or not set(columns) & set(AXES):
        raise file.wrong(2, f"columns {' '.join(columns)}, expected NR AXISPOS [BACKLASH] and axes")
    if len(rows) > LIMITS.points:
        raise file.wrong(rows[LIMITS.points][0], f"more than {LIMITS.points} points")
    values: list[list[float]] = []
    for line, cells in rows:
        if len(cells) != len(columns):
            raise file.wrong(line, f"{len(cells)} values for {len(columns)} columns")
        values.append([file.number(line, w, c) for w, c in zip(cells, columns, strict=True)])
    if len(values) < 2:
        raise file.wrong(3, "fewer than 2 points")
    increasing(file, [v[1] for v in values], [n for n, _ in rows])
    position = np.array([v[1] for v in values])
    column = {c: SIGN.from_file(np.array([v[k] for v in values]), position) for k, c in enumerate(columns) if k > 1}
    back = column.get("BACKLASH")
    return [AxisTable(axis, c, position, v, back if c == axis and back is not None else v) for c, v in column.items() if c != "BACKLASH"]
