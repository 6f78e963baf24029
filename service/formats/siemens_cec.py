"""Siemens sag and angularity compensation, $AN_CEC: a table corrects any axis as a function of any axis.

If the two directions differ, there are two tables, with $AN_CEC_DIRECTION 1 and -1. For a product, $AN_CEC_MULT_BY_TABLE[t] = n multiplies
table t by table n (index n - 1). As in the manual's grid example (6FC5397-1BP40-3BA1 p. 259), only the product acts; the factor table by
itself is switched off ($SN_CEC_TABLE_ENABLE = 0). This is untested on a control: verify the 10 µm step first (docs/reference/formats.md).
The sign is in no manual. Two public writers (files 51872898796 and 51984388978 of a public index of source code, apparently of one French
builder; rotary tables, both directions) write measured - nominal, +e; we write −e because the sum is added to the setpoint. The measured
step decides: ``--step-moved 10`` turns the sign. Load with MD32710 = 0. The input is the SETPOINT of the base axis, so tables
are looked up at the command.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.machine import AXES
from abbe.service.formats.files import FormatSettings, TextFile, short
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, ProductTable
from abbe.service.formats.rules import FormatLimits, SignRule, check_kinds, check_positions, check_size, check_table
from abbe.service.formats.siemens import END, HEAD, POSITION_DECIMALS, Assignments, grid, parse, step_of

LIMITS = FormatLimits(points=2000, equidistant=True, own=True, cross=True, products=True)
SIGN = SignRule(-1, False, "by manual", False, "added to the setpoint of the compensated axis: −e; in no manual; two public tools write +e")
LEVERS = FormatLimits(points=2000, equidistant=True, size_mm=1e5)
WHAT = "Siemens CEC"
NAME = "NC_CEC.INI"
ANGLE_DECIMALS = 3


@dataclass(frozen=True, slots=True)
class _CecTable:
    """One $AN_CEC table. ``curve``: numbers as in the file; ``times``: number of the table that multiplies it, from 1 (0: none);
    ``factor``: it only multiplies another table.
    """

    curve: AxisCurve
    output: str
    direction: int
    times: int
    factor: bool
    decimals: int


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write all tables in one file, numbered from 0, in the order of the manual's example.

    Raises
    ------
    FormatRefused
        There is a grid or an error motion, or a table exceeds a limit or MD18342 (``settings.points``).
    """
    limits = LIMITS if settings.points is None else FormatLimits(points=settings.points, equidistant=True, cross=True, products=True)
    check_kinds(comp, limits, WHAT)
    found: list[_CecTable] = []
    for table in comp.tables:
        check_table(table, limits, WHAT, settings.reference_mm, settings.step_mm)
        for way, values in ((1, table.forward_mm), (-1, table.backward_mm)) if table.directional else ((0, table.forward_mm),):
            curve = AxisCurve(table.axis, table.position_mm, SIGN.to_file(values, table.position_mm))
            found.append(_CecTable(curve, table.output, way, 0, False, settings.decimals))
    for p in comp.products:
        for part, limit in ((p.angle, limits), (p.lever, LEVERS)):
            check_positions(part.position_mm, limit, f"{WHAT}, {p.name}")
            check_size(part.position_mm, part.value, limit, f"{WHAT}, {p.name}")
        angle = AxisCurve(p.angle.axis, p.angle.position_mm, SIGN.to_file(p.angle.value, p.angle.position_mm))
        found.append(_CecTable(angle, p.output, 0, len(found) + 2, False, settings.decimals + ANGLE_DECIMALS))
        found.append(_CecTable(p.lever, p.output, 0, 0, True, settings.decimals))
    lines = ["%_N_NC_CEC_INI", HEAD]
    for t, table_ in enumerate(found):
        lines += _lines(t, table_, switches=bool(comp.products))
    return (TextFile(NAME, "\n".join([*lines, END]) + "\n"),)


def _lines(t: int, table: _CecTable, *, switches: bool) -> list[str]:
    c = table.curve
    lines = [f"$AN_CEC[{t},{k}]={short(v, table.decimals)}" for k, v in enumerate(c.value)]
    lines += [
        f"$AN_CEC_INPUT_AXIS[{t}]=(AX{AXES.index(c.axis) + 1})",
        f"$AN_CEC_OUTPUT_AXIS[{t}]=(AX{AXES.index(table.output) + 1})",
        f"$AN_CEC_STEP[{t}]={short(step_of(c.position_mm, f'{WHAT}, table {t}'), POSITION_DECIMALS)}",
        f"$AN_CEC_MIN[{t}]={short(c.position_mm[0], POSITION_DECIMALS)}",
        f"$AN_CEC_MAX[{t}]={short(c.position_mm[-1], POSITION_DECIMALS)}",
        f"$AN_CEC_DIRECTION[{t}]={table.direction}",
        f"$AN_CEC_MULT_BY_TABLE[{t}]={table.times}",
        f"$AN_CEC_IS_MODULO[{t}]=0",
    ]
    return [*lines, f"$SN_CEC_TABLE_ENABLE[{t}]={0 if table.factor else 1}"] if switches else lines


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the file as the control does; a table for one direction adds nothing in the other direction.

    Raises
    ------
    TableFileError
        A line is of another kind, a point is missing, the end does not fit step and count, an axis is not AX1 to AX3, or a factor table
        is missing.
    """
    found = parse(files[0], "NC_CEC")
    numbers = sorted({int(i[0]) for v, i in found.value if v == "AN_CEC" and i[0].isdigit()})
    if not numbers:
        raise found.file.wrong(1, "there is no table")
    tables = {t: _table(found, t) for t in numbers}
    plain: dict[tuple[str, str, bytes], list[tuple[int, AxisCurve]]] = {}
    products = []
    for t, table in tables.items():
        if table.times:
            other = tables.get(table.times - 1)
            if other is None:
                line = found.line[("AN_CEC_MULT_BY_TABLE", (str(t),))]
                raise found.file.wrong(line, f"table {t} is multiplied by table number {table.times}, which is missing")
            angle = AxisCurve(table.curve.axis, table.curve.position_mm, SIGN.from_file(table.curve.value, table.curve.position_mm))
            products.append(ProductTable(table.output, angle, other.curve))
        elif not table.factor:
            key = (table.curve.axis, table.output, table.curve.position_mm.tobytes())
            plain.setdefault(key, []).append((table.direction, table.curve))
    return Compensation(tuple(_both(k[0], k[1], parts) for k, parts in plain.items()), tuple(products))


def _both(axis: str, output: str, parts: list[tuple[int, AxisCurve]]) -> AxisTable:
    """Add up all tables of one pair of axes on one grid, for both directions."""
    position = parts[0][1].position_mm
    there, back = np.zeros(position.size), np.zeros(position.size)
    for way, curve in parts:
        value = SIGN.from_file(curve.value, position)
        there = there + (value if way >= 0 else 0.0)
        back = back + (value if way <= 0 else 0.0)
    return AxisTable(axis, output, position, there, back)


def _table(found: Assignments, t: int) -> _CecTable:
    n = str(t)
    values = found.values("AN_CEC", n)
    step, first, last = (found.number(f"AN_CEC_{w}", n) for w in ("STEP", "MIN", "MAX"))
    position = grid(found, values.size, step, first, last, ("AN_CEC_MAX", n))
    way, times = (int(found.number(f"AN_CEC_{w}", n)) for w in ("DIRECTION", "MULT_BY_TABLE"))
    if way not in (-1, 0, 1):
        raise found.file.wrong(found.line[("AN_CEC_DIRECTION", (n,))], f"direction {way}, expected -1, 0 or 1")
    enabled = found.value.get(("SN_CEC_TABLE_ENABLE", (n,)), "1") not in ("0", "FALSE")
    return _CecTable(
        AxisCurve(_axis(found, "AN_CEC_INPUT_AXIS", n), position, values), _axis(found, "AN_CEC_OUTPUT_AXIS", n), way, times, not enabled, 0
    )


def _axis(found: Assignments, variable: str, n: str) -> str:
    name = found.value.get((variable, (n,)), "")
    if name not in ("AX1", "AX2", "AX3"):
        raise found.file.wrong(found.line.get((variable, (n,)), 1), f"${variable}[{n}] is {name!r}, expected (AX1), (AX2) or (AX3)")
    return AXES[int(name[2]) - 1]
