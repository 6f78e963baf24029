"""Heidenhain KinematicsComp: all 18 error motions of X, Y and Z, with squareness, in columns C1 to C6 of the axes' .COM files.

Columns by the scheme that HEIDENHAIN recommends (iTNC 530 HSCI manual p. 680): C1 to C6 are EXX EYX EZX EAX EBX ECX for X, and likewise
for Y and Z. The control's kinematics description places them before the axis that they affect (pp. 670 to 686: column COMPTAB, at most 100
entries); the machine's builder enters this order. Squareness stands in the straightness of the axis that is out of square, as a straight
line; the control then needs no entry for it. Errors are written as measured, mm and degrees. The manual's pages that could be read state
neither the sign nor the unit of the angles: verify the 10 µm step first, also at an angle (docs/reference/formats.md). Lost motion goes
into the control's own backlash parameter.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.motions import PLACES
from abbe.models.geometry.chain import squareness_motions
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, fixed, increasing
from abbe.service.formats.heidenhain import POSITION_DECIMALS, assigned, assignment, body, check_fine
from abbe.service.formats.model import AxisCurve, Compensation, Motions
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_positions, check_size

LIMITS = FormatLimits(points=256, own=False, motions=True, zero_at_reference=False)
SIGN = SignRule(1, False, "by manual", False, "the error as measured, +e; angles in degrees; neither stated in the pages read")
WHAT = "Heidenhain KinematicsComp"
COLUMNS = tuple(f"C{k}" for k in range(1, 7))
ANGLE_DECIMALS = 3
SQUARE = ("C0Y", "B0Z", "A0Z")


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write one .COM per axis with any motion, and CONFIG.CMA, whose only line is the active one.

    Raises
    ------
    FormatRefused
        There are tables, motions of one axis have different points or points finer than 0.1 µm, or a motion exceeds a limit.
    """
    check_kinds(comp, LIMITS, WHAT)
    assert comp.motions is not None
    names, files = {}, []
    for a, axis in enumerate(AXES):
        position = _positions(comp.motions, axis)
        values = _values(comp.motions, a, position)
        if not values.any() and not any(c.axis == axis for c in comp.motions.curves.values()):
            continue
        check_fine(position, axis, WHAT)
        for column in range(6):
            check_size(position, values[:, column], LIMITS, f"{WHAT}, {axis} C{column + 1}")
        names[axis] = f"{axis}.COM"
        files.append(TextFile(names[axis], _com(axis, position, values, settings)))
    return (*files, assignment(names))


def _positions(motions: Motions, axis: str) -> F1:
    mine = [c for c in motions.curves.values() if c.axis == axis]
    position = mine[0].position_mm if mine else motions.machine.stroke_mm[AXES.index(axis)]
    check_positions(position, LIMITS, f"{WHAT}, {axis}")
    if any(not np.array_equal(c.position_mm, position) for c in mine):
        raise FormatRefused(
            f"{WHAT}: the motions of {axis} have different points, but share one column of positions", f"use the same points; {NOTHING}"
        )
    return position


def _values(motions: Motions, a: int, position: F1) -> F2:
    """Return the six motions of an axis at its positions, mm and rad, shape (n, 6)."""
    out = np.zeros((position.size, 6))
    for name, curve in motions.curves.items():
        axis, component = PLACES[name]
        if axis == a:
            out[:, component] = curve.value
    places = np.zeros((position.size, 3))
    places[:, a] = position
    angles = np.array([motions.squareness_rad.get(n, 0.0) for n in SQUARE])
    return np.asarray(out + (squareness_motions(places, motions.machine.stroke_mm[:, 0]) @ angles)[:, a])


def _com(axis: str, position: F1, values: F2, settings: FormatSettings) -> str:
    numbers = SIGN.to_file(-values, position[:, None])
    numbers[:, 3:] = np.degrees(numbers[:, 3:])
    decimals = [settings.decimals] * 3 + [settings.decimals + ANGLE_DECIMALS] * 3
    lines = [f"BEGIN {axis}.COM MM", "NR   AXISPOS      " + "".join(f"{c:<14}" for c in COLUMNS).rstrip()]
    for k, p in enumerate(position):
        cells = "".join(f"{fixed(v, d):<14}" for v, d in zip(numbers[k], decimals, strict=True))
        lines.append(f"{k:<5}{fixed(p, POSITION_DECIMALS):<13}{cells}".rstrip())
    return "\n".join([*lines, "[END]"]) + "\n"


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the tables that the active line of the .CMA names; ``settings.machine`` has the chain of the kinematics description.

    Raises
    ------
    TableFileError
        As `abbe.service.formats.heidenhain.read`; or the columns are not C1 to C6.
    FormatRefused
        No machine was given.
    """
    if settings.machine is None:
        raise FormatRefused(f"{WHAT}: the correction depends on the machine's kinematic chain, and no machine is given", "give the machine")
    curves: dict[str, AxisCurve] = {}
    for axis, file in assigned(files):
        columns, rows = body(file)
        if columns != ["NR", "AXISPOS", *COLUMNS]:
            raise file.wrong(2, f"columns {' '.join(columns)}, expected NR AXISPOS {' '.join(COLUMNS)}")
        if not 2 <= len(rows) <= LIMITS.points:
            raise file.wrong(2, f"{len(rows)} points, the control holds 2 to {LIMITS.points}")
        for line, cells in rows:
            if len(cells) != len(columns):
                raise file.wrong(line, f"{len(cells)} values for {len(columns)} columns")
        table = np.array([[file.number(line, w, c) for w, c in zip(cells, columns, strict=True)] for line, cells in rows])
        increasing(file, table[:, 1].tolist(), [n for n, _ in rows])
        values = -SIGN.from_file(table[:, 2:], table[:, 1:2])
        values[:, 3:] = np.radians(values[:, 3:])
        mine = {PLACES[n][1]: n for n in PLACES if AXES[PLACES[n][0]] == axis}
        curves |= {mine[k]: AxisCurve(axis, table[:, 1], values[:, k]) for k in range(6)}
    return Compensation(motions=Motions(settings.machine, curves, {}))
