"""Fanuc three-dimensional error compensation: a sheet of the nodes of a rectangular grid with trilinear interpolation (A-79351E p. 3).

No public manual describes the control's file, parameter numbers or limits. So this module writes a sheet for manual entry, in whole
detection units, with X changing fastest.
"""

from __future__ import annotations

import numpy as np

from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, integers, whole
from abbe.service.formats.model import Compensation, Lattice
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_positions, check_size

LIMITS = FormatLimits(points=1000, equidistant=True, own=False, lattice=True)
SIGN = SignRule(-1, False, "by manual", False, "pulses that are added: −e; not stated in a manual")
WHAT = "Fanuc 3-D error compensation"
NAME = "LATTICE.CSV"
HEADER = "node,x_mm,y_mm,z_mm,x_units,y_units,z_units"


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one line per node.

    Raises
    ------
    FormatRefused
        There is no 3-D grid, there are other kinds of tables, the spacing is unequal, or a correction is too large.
    """
    check_kinds(comp, LIMITS, WHAT)
    if comp.lattice is None:
        raise FormatRefused(f"{WHAT}: there is no 3-D grid", NOTHING)
    positions, values = comp.lattice.position_mm, comp.lattice.correction_mm
    for p in positions:
        check_positions(p, LIMITS, WHAT)
    check_size(np.arange(values.size, dtype=np.float64), values.ravel(), LIMITS, WHAT)
    unit = settings.unit_mm * settings.magnification
    lines, node = [HEADER], 0
    for k, z in enumerate(positions[2]):
        for j, y in enumerate(positions[1]):
            for i, x in enumerate(positions[0]):
                node += 1
                numbers = integers(SIGN.to_file(values[i, j, k], np.zeros(3)), unit)
                lines.append(",".join([str(node), *(whole(v, 6) for v in (x, y, z)), *map(str, numbers)]))
    return (TextFile(NAME, "\n".join(lines) + "\n"),)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the grid of a sheet.

    Raises
    ------
    TableFileError
        The heading or a number is invalid, or a node is missing or out of order.
    """
    file = files[0]
    rows: list[list[float]] = []
    for line, text in file.lines():
        if line == 1:
            if text.strip() != HEADER:
                raise file.wrong(line, f"the heading is {text.strip()!r}, expected {HEADER!r}")
            continue
        cells = text.split(",")
        if len(cells) != 7:
            raise file.wrong(line, f"{len(cells)} values, expected 7")
        row = [file.number(line, w.strip(), n) for w, n in zip(cells, HEADER.split(","), strict=True)]
        if row[0] != line - 1:
            raise file.wrong(line, f"node {row[0]:g}, expected {line - 1}")
        rows.append(row)
    table = np.array(rows) if rows else np.zeros((0, 7))
    axes = [np.unique(table[:, k]) for k in (1, 2, 3)]
    nx, ny, nz = (a.size for a in axes)
    wanted = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    if table.shape[0] != nx * ny * nz or table.shape[0] < 8 or not np.array_equal(wanted, table[:, 1:4]):
        raise file.wrong(len(rows) + 1, "the nodes are not a complete grid with X fastest")
    unit = settings.unit_mm * settings.magnification
    units = table[:, 4:].reshape(nz, ny, nx, 3).transpose(2, 1, 0, 3)
    value = SIGN.from_file(units * unit, np.zeros(units.shape))
    return Compensation(lattice=Lattice((axes[0], axes[1], axes[2]), value))
