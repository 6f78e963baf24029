"""Beckhoff/ISG volumetric CSV: ISO 230-1 error motions per axis. The neutral exchange format.

Blank-separated columns stand under a heading; ``//`` begins a comment, and ``#`` a block with a new heading. Positions are in mm, errors in
mm and rad. The kernel computes the correction by its own kinematic chain. Its parameter ``negate`` inverts single axes: verify the 10 µm
step first (docs/reference/formats.md). Squareness (C0Y, B0Z, A0Z) is one row without a position. Its effect here is zero at the start of
the stroke; another zero would only shift the whole map.
"""

from __future__ import annotations

import numpy as np

from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, increasing, short
from abbe.service.formats.model import AxisCurve, Compensation, Motions
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_positions, check_size, check_table

LIMITS = FormatLimits(points=2000, directional=False, cross=True, motions=True, zero_at_reference=False)
SIGN = SignRule(1, False, "by manual", False, "the error itself; the kernel can invert it (parameter negate)")
WHAT = "ISG volumetric CSV"
NAME = "volcomp.csv"
ANGLE_DECIMALS = 3


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write error motions (or one-axis tables, as the translations that they correct) in one file.

    Raises
    ------
    FormatRefused
        There are products, a grid, motions together with tables, two directions, or motions of one axis at different points.
    """
    check_kinds(comp, LIMITS, WHAT)
    if comp.motions is not None and comp.tables:
        raise FormatRefused(f"{WHAT} cannot hold both error motions and tables", f"give one of them; {NOTHING}")
    curves = _curves(comp, settings)
    lines = ["// error motions, actual - nominal; arguments mm, errors mm and rad"]
    square = {} if comp.motions is None else {n: v for n, v in comp.motions.squareness_rad.items() if v}
    blocks = []
    if square:
        numbers = SIGN.to_file(-np.array(list(square.values())), np.zeros(len(square)))
        blocks.append([" ".join(square), " ".join(short(v, settings.decimals + ANGLE_DECIMALS) for v in numbers)])
    blocks += [_block(axis, mine, settings) for axis in AXES if (mine := {n: c for n, c in curves.items() if c.axis == axis})]
    for k, block in enumerate(blocks):
        lines += (["#"] if k else []) + block
    return (TextFile(NAME, "\n".join(lines) + "\n"),)


def _curves(comp: Compensation, settings: FormatSettings) -> dict[str, AxisCurve]:
    """Return the curves to write by name, in ISO order."""
    if comp.motions is not None:
        found = {n: AxisCurve(c.axis, c.position_mm, SIGN.to_file(-c.value, c.position_mm)) for n, c in comp.motions.curves.items()}
    else:
        found = {}
        for t in comp.tables:
            check_table(t, LIMITS, WHAT, settings.reference_mm, settings.step_mm)
            found[f"E{t.output}{t.axis}"] = AxisCurve(t.axis, t.position_mm, SIGN.to_file(t.forward_mm, t.position_mm))
    return {name: found[name] for name in PLACES if name in found}


def _block(axis: str, mine: dict[str, AxisCurve], settings: FormatSettings) -> list[str]:
    position = next(iter(mine.values())).position_mm
    check_positions(position, LIMITS, f"{WHAT}, {axis}")
    for name, curve in mine.items():
        if not np.array_equal(curve.position_mm, position):
            raise FormatRefused(
                f"{WHAT}: the motions of {axis} have different points, but share one column of positions", f"use the same points; {NOTHING}"
            )
        check_size(position, curve.value, LIMITS, f"{WHAT}, {name}")
    decimals = [settings.decimals + (ANGLE_DECIMALS if PLACES[n][1] > 2 else 0) for n in mine]
    lines = [" ".join([axis, *mine])]
    for k, p in enumerate(position):
        lines.append(" ".join([short(p, 6), *(short(c.value[k], d) for c, d in zip(mine.values(), decimals, strict=True))]))
    return lines


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the error motions of a file; ``settings.machine`` has the kinematic chain that is configured in the kernel.

    Raises
    ------
    TableFileError
        A heading has an unknown name or two position columns (2-D tables are not supported), a row has another length, or positions do
        not increase.
    FormatRefused
        No machine was given.
    """
    if settings.machine is None:
        raise FormatRefused(f"{WHAT}: the correction depends on the machine's kinematic chain, and no machine is given", "give the machine")
    file = files[0]
    curves: dict[str, AxisCurve] = {}
    square: dict[str, float] = {}
    for head, rows in _blocks(file):
        _take(file, head, rows, curves, square)
    if not curves and not square:
        raise file.wrong(1, "there is no table")
    return Compensation(motions=Motions(settings.machine, curves, square))


Row = tuple[int, list[str]]


def _blocks(file: TextFile) -> list[tuple[Row, list[Row]]]:
    """Split the file into headings with their rows."""
    blocks: list[tuple[Row, list[Row]]] = []
    fresh = True
    for line, text in file.lines():
        bare = text.partition("//")[0].strip()
        if bare == "#":
            fresh = True
        elif bare and fresh:
            blocks.append(((line, bare.split()), []))
            fresh = False
        elif bare:
            blocks[-1][1].append((line, bare.split()))
    return blocks


def _take(file: TextFile, head: Row, rows: list[Row], curves: dict[str, AxisCurve], square: dict[str, float]) -> None:
    line, names = head
    arguments = [n for n in names if n in AXES]
    strange = [n for n in names if n not in AXES and n not in PLACES and n not in SQUARENESS]
    if strange or len(arguments) > 1 or len(set(names)) != len(names):
        problem = f"{strange[0]} is unknown" if strange else "two position columns or a repeated name"
        raise file.wrong(line, f"heading {' '.join(names)}: {problem}")
    again = [n for n in names if n in curves or n in square]
    if again or not rows:
        raise file.wrong(line, f"{again[0]} appears in two blocks" if again else "there are no rows under this heading")
    for n, cells in rows:
        if len(cells) != len(names):
            raise file.wrong(n, f"{len(cells)} values for {len(names)} columns")
    table = np.array([[file.number(n, w, c) for w, c in zip(cells, names, strict=True)] for n, cells in rows])
    if not arguments:
        if len(rows) != 1 or not set(names) <= set(SQUARENESS):
            raise file.wrong(rows[0][0], "a block without a position column must have one row, with only C0Y, B0Z or A0Z")
        square.update({n: -float(v) for n, v in zip(names, SIGN.from_file(table[0], np.zeros(len(names))), strict=True)})
        return
    axis = arguments[0]
    position = table[:, names.index(axis)]
    increasing(file, position.tolist(), [n for n, _ in rows])
    for k, name in enumerate(names):
        if name == axis:
            continue
        if name not in PLACES or AXES[PLACES[name][0]] != axis:
            raise file.wrong(line, f"{name} is not an error motion of {axis}")
        curves[name] = AxisCurve(axis, position, -SIGN.from_file(table[:, k], position))
