"""The 10 µm step of a format for one machine: tables that move one axis at one place, and the expected reading there.

It proves sign, axis, unit and scale of a control before the first real table. All else is zero. A format without one-axis tables
gets the smallest part that it can hold: an error motion, a node of a grid, a straight line, or lost motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES, Machine
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, Lattice, Motions
from abbe.service.formats.registry import Format
from abbe.service.formats.skew import PAIRS

STEP_MM = 0.010
POINTS = 5


@dataclass(frozen=True, slots=True)
class Step:
    """Tables of a step, and two sentences for the person who measures it."""

    compensation: Compensation
    place: str
    expected: str


def step_of(form: Format, machine: Machine, axis: int, reference_mm: F1) -> Step:
    """Return the step of an axis (0, 1, 2): a correction of -10 µm in the middle of its stroke, zero at the reference.

    If the reference lies there, the step is at the next point of the table.
    """
    name, limits = AXES[axis], form.limits
    grids = tuple(np.linspace(low, high, POINTS).round(4) for low, high in machine.stroke_mm.tolist())
    at = _at(grids[axis], float(reference_mm[axis]))
    spike = np.where(np.arange(POINTS) == at, -STEP_MM, 0.0)
    moved = f"{name} has to move by -10 µm"
    place = f"go to {name} {grids[axis][at]:g} moving in +, with and without the file"
    if limits.own:
        return Step(Compensation((AxisTable(name, name, grids[axis], spike, spike),)), place, moved)
    if limits.motions:
        return Step(Compensation(motions=Motions(machine, {f"E{name}{name}": AxisCurve(name, grids[axis], -spike)}, {})), place, moved)
    if limits.lattice:
        nodes = np.zeros((POINTS, POINTS, POINTS, 3))
        middle = [_at(grids[a], float(reference_mm[a])) for a in range(3)]
        nodes[middle[0], middle[1], middle[2], axis] = -STEP_MM
        there = ", ".join(f"{a} {g[k]:g}" for a, g, k in zip(AXES, grids, middle, strict=True))
        return Step(
            Compensation(lattice=Lattice((grids[0], grids[1], grids[2]), nodes)), f"go to {there}, with and without the file", moved
        )
    if limits.cross:
        over, output = next((pair for pair in PAIRS if pair[1] == name), PAIRS[2])
        ends = machine.stroke_mm[AXES.index(over)]
        line = -STEP_MM * (ends - ends[0]) / np.ptp(ends)
        where = f"go from {over} {ends[0]:g} to {over} {ends[1]:g} along a straight edge, with and without the commands"
        return Step(Compensation((AxisTable(over, output, ends, line, line),)), where, f"{output} has to end 10 µm further in -")
    lost = f"go to {name} {grids[axis][at]:g} moving in -, with and without the settings"
    return Step(Compensation(lost_motion_mm={name: STEP_MM}), lost, f"{name} has to stand 10 µm further in -")


def _at(grid: F1, reference: float) -> int:
    """Index of the point of the step: the middle one, or the next one if the reference is less than a spacing away from the middle."""
    middle = grid.size // 2
    return middle if abs(reference - grid[middle]) >= np.ptp(grid) / (grid.size - 1) - 1e-9 else middle + 1
