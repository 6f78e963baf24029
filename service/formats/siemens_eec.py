"""Siemens encoder (leadscrew) error compensation, $AA_ENC_COMP: one equidistant table per axis, for both directions of motion.

Load with MD32700 = 0, then set it to 1 and reference the axis; the table is inactive until then. The control neither limits nor monitors
the size of a correction. The table must be zero at the reference point. A lost motion that is constant along the axis goes into MD32450
(backlash), by hand.
"""

from __future__ import annotations

from abbe.models.machine import AXES
from abbe.service.formats.files import FormatSettings, TextFile, short
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import FormatLimits, SignRule, check_kinds, check_table
from abbe.service.formats.siemens import END, HEAD, POSITION_DECIMALS, grid, parse, step_of

LIMITS = FormatLimits(points=5000, equidistant=True, directional=False)
SIGN = SignRule(1, False, "by manual", True, "corrects the ACTUAL value; a positive number moves the axis in −: +e")
WHAT = "Siemens ENC_COMP"
NAME = "AX_EEC.INI"


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write all own-axis tables in one file, in the order of the manual's example.

    Raises
    ------
    FormatRefused
        A table is of another kind, depends on direction, exceeds MD38000 (``settings.points``), or is not zero at the reference.
    """
    limits = LIMITS if settings.points is None else FormatLimits(points=settings.points, equidistant=True, directional=False)
    check_kinds(comp, limits, WHAT)
    lines = ["%_N_AX_EEC_INI", HEAD]
    for table in comp.tables:
        check_table(table, limits, WHAT, settings.reference_mm, settings.step_mm)
        axis = settings.axis_names[AXES.index(table.axis)]
        numbers = SIGN.to_file(table.forward_mm, table.position_mm)
        lines += [f"$AA_ENC_COMP[0,{k},{axis}]={short(v, settings.decimals)}" for k, v in enumerate(numbers)]
        lines += [
            f"$AA_ENC_COMP_STEP[0,{axis}]={short(step_of(table.position_mm, f'{WHAT}, {table.name}'), POSITION_DECIMALS)}",
            f"$AA_ENC_COMP_MIN[0,{axis}]={short(table.position_mm[0], POSITION_DECIMALS)}",
            f"$AA_ENC_COMP_MAX[0,{axis}]={short(table.position_mm[-1], POSITION_DECIMALS)}",
            f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
        ]
    return (TextFile(NAME, "\n".join([*lines, END]) + "\n"),)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the file as the control does.

    Raises
    ------
    TableFileError
        A line is of another kind, a point is missing, the end does not fit step and count, or a table is for a rotary axis.
    """
    found = parse(files[0], "AX_EEC")
    tables = []
    for axis, name in zip(AXES, settings.axis_names, strict=True):
        if not any(v == "AA_ENC_COMP" and i[-1] == name for v, i in found.value):
            continue
        numbers = found.values("AA_ENC_COMP", "0", name)
        if found.number("AA_ENC_COMP_IS_MODULO", "0", name) != 0:
            raise found.file.wrong(found.line[("AA_ENC_COMP_IS_MODULO", ("0", name))], "modulo is set: the table is for a rotary axis")
        step, first, last = (found.number(f"AA_ENC_COMP_{w}", "0", name) for w in ("STEP", "MIN", "MAX"))
        position = grid(found, numbers.size, step, first, last, ("AA_ENC_COMP_MAX", f"0,{name}"))
        value = SIGN.from_file(numbers, position)
        tables.append(AxisTable(axis, axis, position, value, value))
    if not tables:
        raise found.file.wrong(1, f"no table for {', '.join(settings.axis_names)}", "give the control's axis names")
    return Compensation(tuple(tables))
