"""Centroid ballscrew table, version 1 (.tab; CNC7 v6.00 and later): corrections in encoder counts, the same for both directions.

The first line holds the number of values and the signed travel from the first to the last, in counts. One whole number per line follows,
the first at the reference. Source: cncsnw.com, "Laser Compensation"; in its example, 24 values over -1448819 counts are 40 mm apart at
40000 counts per inch. Versions 2 and 3 (two directions, a longer heading) are not supported, because no description was available.
"""

from __future__ import annotations

import numpy as np

from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, integers
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=1000, equidistant=True, directional=False)
SIGN = SignRule(-1, False, "by manual", False, "amount of correction to apply: −e; not stated in a manual")
WHAT = "Centroid ballscrew table"


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one file per axis; the reference must be one end of the table.

    Raises
    ------
    FormatRefused
        The table is of another kind, differs between the directions, or is not zero at the reference; or the reference is at neither end.
    """
    check_kinds(comp, LIMITS, WHAT)
    files = []
    for table in comp.tables:
        check_table(table, LIMITS, WHAT, settings.reference_mm, 1.0 / settings.counts_per_mm)
        ends = (table.position_mm[0], table.position_mm[-1])
        reference = ends[0] if settings.reference_mm is None else settings.reference_mm[AXES.index(table.axis)]
        if min(abs(reference - e) for e in ends) > 1e-6:
            raise FormatRefused(
                f"{WHAT}, table {table.name}: the reference {reference:g} mm is at neither end of the table",
                f"choose another grid; {NOTHING}",
            )
        way = 1 if abs(reference - ends[0]) <= 1e-6 else -1
        travel = way * round(float(np.ptp(table.position_mm)) * settings.counts_per_mm)
        counts = integers(SIGN.to_file(table.forward_mm, table.position_mm), 1.0 / settings.counts_per_mm)[::way]
        lines = [f"{table.position_mm.size} {travel}", *map(str, counts)]
        files.append(TextFile(f"cnc-{table.axis.lower()}.tab", "\n".join(lines) + "\n"))
    return tuple(files)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read version 1 files; the axis is the letter before ``.tab``, positions count from the reference.

    Raises
    ------
    TableFileError
        The first line is not two whole numbers, the number of values differs from the stated one, or a value is not a number.
    """
    return Compensation(tuple(_read_one(f, settings) for f in files))


def _read_one(file: TextFile, settings: FormatSettings) -> AxisTable:
    axis = file.name.rpartition(".")[0][-1:].upper()
    lines = list(file.lines())
    if axis not in AXES or not lines:
        raise file.wrong(1, "the file's name does not end in its axis, or the file is empty", "name it cnc-x.tab, cnc-y.tab or cnc-z.tab")
    head = lines[0][1].split()
    if len(head) != 2 or not head[0].isdigit():
        raise file.wrong(1, f"{lines[0][1]!r} is not a heading of version 1 (number of values, travel in counts)")
    count, travel = int(head[0]), file.number(1, head[1], "the travel")
    values = np.array([file.number(line, text.strip(), "the correction") for line, text in lines[1:]])
    if values.size != count or count < 2 or travel == 0.0:
        raise file.wrong(len(lines), f"{values.size} values, {count} stated with a travel of {travel:g} counts")
    start = 0.0 if settings.reference_mm is None else settings.reference_mm[AXES.index(axis)]
    position = start + np.linspace(0.0, travel / settings.counts_per_mm, count)
    way = 1 if travel > 0 else -1
    value = SIGN.from_file(values / settings.counts_per_mm, position)[::way]
    return AxisTable(axis, axis, position[::way], value, value)
