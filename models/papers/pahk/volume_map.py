"""Deviation of a machine over its working volume, as a deformed grid (math.md 2; P (4), (7), (A2), (A5), (A8))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import Machine
from abbe.models.notation.pahk import PahkType, pahk_machine
from abbe.models.papers.pahk.tables import ParameterTables

Form = Literal["first", "vector", "zyx", "small"]
"""First order (rule G), or the exact chain with one of the rotations of `abbe.models.geometry.chain.exact_deviation_mm`."""


@dataclass(frozen=True)
class VolumetricMap:
    """Nominal grid and what becomes of it.

    Parameters
    ----------
    axes_mm : array, shape (nodes, nodes, nodes, 3)
        Commanded positions, X first.
    deviation_mm : array, same shape
        Actual minus nominal.
    tool_mm : array, shape (3,)
    """

    axes_mm: F3
    deviation_mm: F3
    tool_mm: F1

    @property
    def nominal_mm(self) -> F3:
        """Where the functional point should be."""
        return self.axes_mm + self.tool_mm

    @property
    def deformed_mm(self) -> F3:
        """Where the functional point is."""
        return self.nominal_mm + self.deviation_mm

    def exaggerated_mm(self, factor: float) -> F3:
        """The deformed grid with the deviation multiplied, for drawing."""
        return self.nominal_mm + factor * self.deviation_mm


def chain_deviation_mm(machine: Machine, axes_mm: F2, motions: F3, form: Form = "first") -> F2:
    """Deviation in one of the four forms; shapes and errors as in `abbe.models.geometry.chain.deviation_mm`."""
    if form == "first":
        return deviation_mm(machine, axes_mm, motions)
    return exact_deviation_mm(machine, axes_mm, motions, rotation=form)


def volumetric_map(
    kind: PahkType, tables: ParameterTables, nodes: int, probe_mm: F1 | None = None, *, box_mm: F2 | None = None, form: Form = "first"
) -> VolumetricMap:
    """Deviation on a product grid.

    Parameters
    ----------
    nodes : int
        Per axis, 2 or more.
    probe_mm : array, shape (3,), optional
    box_mm : array, shape (3, 2), optional
        Part of the volume. Default: the whole range of the tables.
    form : "first", "vector", "zyx" or "small"

    Returns
    -------
    VolumetricMap

    Raises
    ------
    ValueError
        Fewer than two nodes, or the box reaches beyond the tables.
    """
    if nodes < 2:
        raise ValueError(f"volumetric map: {nodes} nodes per axis, it takes at least 2")
    machine = pahk_machine(kind, tables.stroke_mm, probe_mm)
    axes = volume_grid(machine.stroke_mm if box_mm is None else np.asarray(box_mm, dtype=np.float64), nodes)
    off = chain_deviation_mm(machine, axes, tables.motions(kind, axes), form)
    shape = (nodes, nodes, nodes, 3)
    return VolumetricMap(axes.reshape(shape), off.reshape(shape), machine.tool_mm)
