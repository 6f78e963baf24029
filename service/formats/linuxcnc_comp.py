"""LinuxCNC COMP_FILE, type 0 and 1: bare triplets "nominal forward reverse", one file per joint.

The control reads with sscanf and stops WITHOUT AN ERROR at the first line that is not three numbers: a comment, a heading or a blank line
at the start yields an empty table. It skips lines whose nominal does not increase. So the writer writes triplets only, and the reader
refuses every line that the control would silently skip. BACKLASH of the ini file has no effect on a joint with a table, so the two columns
hold the lost motion.
"""

from __future__ import annotations

import numpy as np

from abbe.service.formats.files import FormatSettings, TextFile, fixed, increasing, whole
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import PLAUSIBLE_MM, FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=256)
SIGNS = {
    1: SignRule(-1, False, "verified by execution", True, "what is added to the motor's command: −e"),
    0: SignRule(1, True, "verified by execution", True, "the position that was reached: nominal + e"),
}
"""Sign rule by COMP_FILE_TYPE."""
POSITION_DECIMALS = 6


def write(comp: Compensation, settings: FormatSettings, *, kind: int = 1) -> tuple[TextFile, ...]:
    """Write one file (``x.comp``, ...) per own-axis table, for ``COMP_FILE`` with ``COMP_FILE_TYPE = kind``.

    Raises
    ------
    FormatRefused
        A table is not an own-axis table or exceeds a limit.
    """
    what = f"LinuxCNC COMP_FILE type {kind}"
    check_kinds(comp, LIMITS, what)
    files = []
    for table in comp.tables:
        check_table(table, LIMITS, what, settings.reference_mm, settings.step_mm)
        columns = [SIGNS[kind].to_file(v, table.position_mm) for v in (table.forward_mm, table.backward_mm)]
        rows = zip(table.position_mm, *columns, strict=True)
        lines = [f"{whole(p, POSITION_DECIMALS)} {fixed(f, settings.decimals)} {fixed(b, settings.decimals)}" for p, f, b in rows]
        files.append(TextFile(f"{table.axis.lower()}.comp", "\n".join(lines) + "\n"))
    return tuple(files)


def read(files: tuple[TextFile, ...], settings: FormatSettings, *, kind: int = 1) -> Compensation:
    """Read the files as LinuxCNC does; the axis is the first letter of the file's name.

    Raises
    ------
    TableFileError
        The control would stop at a line or skip it, the table is of the other type, or there are too many points.
    """
    return Compensation(tuple(_read_one(f, kind) for f in files))


def _read_one(file: TextFile, kind: int) -> AxisTable:
    axis = file.name[:1].upper()
    if axis not in ("X", "Y", "Z"):
        raise file.wrong(1, "the name of the file does not begin with its axis", "name it x.comp, y.comp or z.comp")
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, text in file.lines():
        cells = text.split()
        if len(cells) != 3:
            found = "is blank" if not cells else f"is {text.strip()!r}"
            raise file.wrong(line, f"the line {found}: LinuxCNC would stop reading here, silently", "write only lines of three numbers")
        rows.append([file.number(line, w, n) for w, n in zip(cells, ("the position", "forward", "reverse"), strict=True)])
        lines.append(line)
    if not rows:
        raise file.wrong(1, "the file is empty: LinuxCNC would not compensate at all")
    if len(rows) > LIMITS.points:
        raise file.wrong(lines[LIMITS.points], f"{len(rows)} points: LinuxCNC takes {LIMITS.points} and leaves out the rest")
    increasing(file, [r[0] for r in rows], lines)
    position = np.array([r[0] for r in rows])
    there, back = (SIGNS[kind].from_file(np.array([r[k] for r in rows]), position) for k in (1, 2))
    _right_type(file, kind, lines, np.maximum(np.abs(there), np.abs(back)))
    return AxisTable(axis, axis, position, there, back)


def _right_type(file: TextFile, kind: int, lines: list[int], size_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    """Refuse implausible corrections: a table of the other type has positions in place of corrections, or vice versa."""
    k = int(np.argmax(size_mm))
    if size_mm[k] > PLAUSIBLE_MM:
        other = "0 (positions reached)" if not SIGNS[kind].adds_position else "1 (corrections)"
        raise file.wrong(
            lines[k],
            f"as type {kind} this is a correction of {size_mm[k]:.3f} mm: the file looks like type {other}",
            "check COMP_FILE_TYPE",
        )
