"""Mach4 screw map as a sheet for manual entry in its Machine Calibration plugin, which reads no file.

The sheet has the start (most negative end), the length, and error = expected − actual at equidistant points. Mach4 takes separate values
for + and − since build 4780.
"""

from __future__ import annotations

import numpy as np

from abbe.service.formats.files import FormatSettings, TextFile, fixed, short
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=10000, equidistant=True)
SIGN = SignRule(-1, False, "by manual", True, "expected − actual: −e")
WHAT = "Mach4 screw map"
HEADER = "point,position_mm,error_plus_mm,error_minus_mm"
_HEAD = ("axis", "start_mm", "length_mm", "points")


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one sheet per axis.

    Raises
    ------
    FormatRefused
        The table is of another kind, has unequal spacing, or is not zero at the reference.
    """
    check_kinds(comp, LIMITS, WHAT)
    files = []
    for table in comp.tables:
        check_table(table, LIMITS, WHAT, settings.reference_mm, settings.step_mm)
        position = table.position_mm
        values = (table.axis, short(position[0], 6), short(np.ptp(position), 6), str(position.size))
        lines = [f"{k},{v}" for k, v in zip(_HEAD, values, strict=True)] + [HEADER]
        plus, minus = (SIGN.to_file(v, position) for v in (table.forward_mm, table.backward_mm))
        for k, p in enumerate(position):
            lines.append(f"{k + 1},{short(p, 6)},{fixed(plus[k], settings.decimals)},{fixed(minus[k], settings.decimals)}")
        files.append(TextFile(f"mach4-{table.axis.lower()}.csv", "\n".join(lines) + "\n"))
    return tuple(files)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the table of each sheet.

    Raises
    ------
    TableFileError
        The heading or a number is invalid, or the points do not match start, length and count.
    """
    return Compensation(tuple(_read_one(f) for f in files))


def _read_one(file: TextFile) -> AxisTable:
    lines = list(file.lines())
    head = dict(text.split(",", 1) for _, text in lines[:4] if "," in text)
    if tuple(head) != _HEAD or head["axis"] not in ("X", "Y", "Z") or len(lines) < 7 or lines[4][1].strip() != HEADER:
        raise file.wrong(1, f"the sheet does not begin with {', '.join(_HEAD)} and {HEADER}")
    start, length, count = (file.number(k + 2, head[name], name) for k, name in enumerate(_HEAD[1:]))
    rows: list[list[float]] = []
    for line, text in lines[5:]:
        cells = text.split(",")
        if len(cells) != 4:
            raise file.wrong(line, f"{len(cells)} values, expected 4")
        rows.append([file.number(line, w.strip(), n) for w, n in zip(cells, HEADER.split(","), strict=True)])
        wanted = start + (len(rows) - 1) * length / max(1.0, count - 1.0)
        if rows[-1][0] != len(rows) or abs(rows[-1][1] - wanted) > 1e-5:
            raise file.wrong(line, f"point {rows[-1][0]:g} at {rows[-1][1]:g}, expected point {len(rows)} at {wanted:g}")
    if len(rows) != count:
        cut = ": the file is cut off" if len(rows) < count else ""
        raise file.wrong(len(lines), f"{len(rows)} points, but the heading states {count:g}{cut}")
    table = np.array(rows)
    plus, minus = (SIGN.from_file(table[:, k], table[:, 1]) for k in (2, 3))
    return AxisTable(head["axis"], head["axis"], table[:, 1], plus, minus)
