"""The 10 µm step: an error of +10 µm at one place in every format, with the number in the file and the expected motion.

Written to a machine and measured there, it proves sign, axis, unit and scale of a control before the first real table (controllers.md 5.7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.service.formats import skew
from abbe.service.formats.files import FormatSettings
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, Lattice, Motions, ProductTable, correction_at
from abbe.service.formats.registry import FORMATS, Format

STEP_MM = 0.010
POSITION_MM = np.array([0.0, 50.0, 100.0, 150.0, 200.0])
AT = 2
"""Index of the place of the step."""
MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 200.0]] * 3))
SETTINGS = FormatSettings(reference_mm=(0.0, 0.0, 0.0), decimals=4, machine=MACHINE)


@dataclass(frozen=True, slots=True)
class Proof:
    """One row: format, kind of table, lines of the file that differ from a table of zeros, place, and correction there (mm)."""

    format: str
    what: str
    lines: tuple[str, ...]
    axis: str
    at_mm: tuple[float, float, float]
    direction: int
    added_mm: float


def proofs(form: Format) -> tuple[Proof, ...]:
    """Rows of all kinds of table of a format."""
    out = []
    for what, axis, at, way, step, nothing in _cases(form):
        files, zeros = form.write(step, SETTINGS), form.write(nothing, SETTINGS)
        blank = {line for f in zeros for line in f.text.splitlines()}
        lines = tuple(line for f in files for line in f.text.splitlines() if line not in blank)
        added = correction_at(form.read(files, SETTINGS), np.array([at]), np.full((1, 3), float(way)))[0, AXES.index(axis)]
        out.append(Proof(form.key, what, lines, axis, at, way, float(added)))
    return tuple(out)


def all_proofs() -> tuple[Proof, ...]:
    """Rows of all formats."""
    return tuple(p for f in FORMATS.values() for p in proofs(f))


Case = tuple[str, str, tuple[float, float, float], int, Compensation, Compensation]


def _cases(form: Format) -> list[Case]:
    """Cases of a format: kind, output axis, place, direction, the step (a correction of −10 µm there), and the same without the step."""
    spike = np.where(np.arange(POSITION_MM.size) == AT, -STEP_MM, 0.0)
    place = float(POSITION_MM[AT])
    cases: list[Case] = []
    if form.limits.lost_motion:
        lost = [Compensation(lost_motion_mm={"X": v, "Y": 1.0}) for v in (STEP_MM, 0.0)]
        cases.append(("lost motion of X", "X", (place, 0.0, 0.0), -1, lost[0], lost[1]))
    if form.limits.lines:
        ends = POSITION_MM[[0, -1]]
        for axis, output in skew.PAIRS if form.limits.cross else ():
            line = [Compensation((AxisTable(axis, output, ends, v, v),)) for v in (-STEP_MM / 100.0 * ends, 0.0 * ends)]
            at = tuple(float(place) if a == axis else 0.0 for a in AXES)
            cases.append((f"{output} over {axis}, 100 µrad", output, (at[0], at[1], at[2]), 1, line[0], line[1]))
        return cases
    for able, output, what in ((form.limits.own, "X", "X over X"), (form.limits.cross, "Y", "Y over X")):
        if able:
            tables = [Compensation((AxisTable("X", output, POSITION_MM, v, v),)) for v in (spike, 0.0 * spike)]
            cases.append((what, output, (place, 0.0, 0.0), 1, tables[0], tables[1]))
    if form.limits.own and form.limits.directional:
        zero = 0.0 * spike
        pair = [Compensation((AxisTable("X", "X", POSITION_MM, zero, v),)) for v in (spike, zero)]
        cases.append(("X over X, only while moving in −", "X", (place, 0.0, 0.0), -1, pair[0], pair[1]))
    if form.limits.products:
        lever = AxisCurve("Z", POSITION_MM, POSITION_MM)
        both = [Compensation(products=(ProductTable("X", AxisCurve("Y", POSITION_MM, v / 200.0), lever),)) for v in (spike, 0.0 * spike)]
        cases.append(("X over Y times Z", "X", (0.0, place, 200.0), 1, both[0], both[1]))
    if form.limits.motions and not form.limits.own:
        cases += _motions(place)
    if form.limits.lattice:
        nodes = (POSITION_MM[[0, AT, 4]],) * 3
        value = np.zeros((3, 3, 3, 3))
        value[1, 1, 1, 0] = -STEP_MM
        grids = [Compensation(lattice=Lattice(nodes, v)) for v in (value, 0.0 * value)]
        cases.append(("3-D grid, X", "X", (place, place, place), 1, grids[0], grids[1]))
    return cases


def _motions(place: float) -> list[Case]:
    """A straightness, and an angle at a lever: errors of +10 µm and +50 µrad."""
    cases: list[Case] = []
    for name, output, z in (("EYX", "Y", 0.0), ("EBX", "X", 200.0)):
        value = np.where(place == POSITION_MM, STEP_MM if z == 0.0 else STEP_MM / z, 0.0)
        two = [Compensation(motions=Motions(MACHINE, {name: AxisCurve("X", POSITION_MM, v)}, {})) for v in (value, 0.0 * value)]
        cases.append((name if z == 0.0 else f"{name}, 50 µrad", output, (place, 0.0, z), 1, two[0], two[1]))
    return cases
