"""What every contestant computes: one machine with 21 errors in tables, a million scattered points, a 100 x 100 x 100 grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F2, F3
from abbe.models.machine import AXES, Machine
from tests.experiments.kernel.table_machine import TableMachine, sampled

CASES = ("scattered", "grid")
STROKE_MM = np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]])
NODES = 51
SIDE = 100
TOOL_MM = np.array([35.0, -20.0, -150.0])
"""Sideways as well, as with an angle head: straight down, rotation of the tool side about Z would change nothing (rule G)."""


@dataclass(frozen=True)
class Case:
    """``points`` in rows; for the grid also its three axes (X slowest, Z fastest)."""

    name: str
    tables: TableMachine
    points: F2
    axes: tuple[np.ndarray, ...]

    def table_values(self) -> F3:
        """The 18 tables at the points, shape (18, n), X's six first, as a user of numpy gets them: one `numpy.interp` each.

        On the grid only the 3 x 100 positions are looked up and then repeated, which is what a user who thinks does.
        """
        out = np.empty((18, len(self.points)))
        for a, table in enumerate(self.tables.tables):
            nodes = np.linspace(*self.tables.range_mm[a], len(table))
            for c in range(6):
                if self.name == "scattered":
                    out[6 * a + c] = np.interp(self.points[:, a], nodes, table[:, c])
                else:
                    shape = [1, 1, 1]
                    shape[a] = SIDE
                    out[6 * a + c].reshape(SIDE, SIDE, SIDE)[:] = np.interp(self.axes[a], nodes, table[:, c]).reshape(shape)
        return out

    def even_look_up(self) -> Callable[[], F3]:
        """The same table values by someone who knows that the nodes are even: one index per axis, straight pieces prepared beforehand."""
        pieces = []
        for a, table in enumerate(self.tables.tables):
            first, last = self.tables.range_mm[a]
            step = (last - first) / (len(table) - 1)
            slope = np.concatenate([np.diff(table, axis=0) / step, np.zeros((1, 6))]).T.copy()
            pieces.append((first, last - first, step, table.T - slope * step * np.arange(len(table)), slope))

        def values() -> F3:
            out = np.empty((18, len(self.points)))
            for a, (first, length, step, offset, slope) in enumerate(pieces):
                along = np.clip(self.points[:, a] - first, 0.0, length)
                cell = (along * (1.0 / step)).astype(np.intp)
                for c in range(6):
                    row = out[6 * a + c]
                    np.take(slope[c], cell, out=row, mode="clip")
                    row *= along
                    row += offset[c][cell]
            return out

        return values


def make(name: str, n: int = 1_000_000) -> Case:
    """Errors of a good machine: a few um and tens of urad. The chain is usual; pivots are zero, which spares only the peers work."""
    machine = Machine("w-X-Y-b-Z-t", STROKE_MM, tool_mm=TOOL_MM)
    rng = np.random.default_rng(21)
    functions = {}
    for a, axis in enumerate(AXES):
        for c, letter in enumerate("XYZABC"):
            size = rng.uniform(2e-3, 6e-3) if c < 3 else rng.uniform(5e-6, 25e-6)
            functions[f"E{letter}{axis}"] = _wave(size, rng.uniform(0.5, 2.5), STROKE_MM[a])
    tables = sampled(machine, functions, {"C0Y": 15e-6, "B0Z": -20e-6, "A0Z": 10e-6}, NODES)
    axes = tuple(np.linspace(*s, SIDE) for s in STROKE_MM)
    if name == "grid":
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    else:
        points = rng.uniform(STROKE_MM[:, 0], STROKE_MM[:, 1], (n, 3))
    return Case(name, tables, points, axes)


def _wave(size, periods, stroke):
    return lambda x: size * np.sin(2.0 * np.pi * periods * (x - stroke[0]) / (stroke[1] - stroke[0]))
