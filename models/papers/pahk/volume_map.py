"""Parameter tables of a machine in Pahk's signs, and its deviation over the working volume as a deformed grid (P (4), (7), (A2),
(A5), (A8)).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import Machine
from abbe.models.notation.pahk import PahkType, motions_from_pahk, pahk_machine

Triple = tuple[F2, F2, F2]
"""One table per axis X, Y, Z, each of shape (n_j, 3 directions): the numbers of positions may differ."""
Form = Literal["first", "vector", "zyx", "small"]
"""``first``: first order (rule G); the others: exact chain with this rotation (`abbe.models.geometry.chain.exact_deviation_mm`)."""


@dataclass(frozen=True)
class ParameterTables:
    """Pahk's 21 parameters: d_i(j) and E_i(j) at tabulated positions, and three squareness errors.

    Parameters
    ----------
    positions_mm : three arrays, shape (n_j,)
        Increasing commanded positions of X, Y, Z; at least two of each.
    d_mm : three arrays, shape (n_j, 3)
        d_x, d_y, d_z of the axis (positioning and straightness), Pahk's signs (`abbe.models.notation.pahk.parameter_signs`).
    e_rad : three arrays, shape (n_j, 3)
        E_x, E_y, E_z of the axis, Pahk's signs.
    squareness_rad : array, shape (3,)
        alpha (XY), beta1 (XZ), beta2 (YZ) in the sign of the type.

    Raises
    ------
    ValueError
        Shapes do not agree, positions do not increase, or a number is not finite.
    """

    positions_mm: tuple[F1, F1, F1]
    d_mm: Triple
    e_rad: Triple
    squareness_rad: F1 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check the numbers and turn them into arrays."""
        for name in ("positions_mm", "d_mm", "e_rad"):
            object.__setattr__(self, name, tuple(np.asarray(v, dtype=np.float64) for v in getattr(self, name)))
        object.__setattr__(self, "squareness_rad", np.asarray(self.squareness_rad, dtype=np.float64))
        sizes = [len(v) for v in (self.positions_mm, self.d_mm, self.e_rad)]
        if sizes != [3, 3, 3] or self.squareness_rad.shape != (3,):
            raise ValueError("parameter tables: expected tables of X, Y and Z and three squareness errors")
        for axis, x, d, e in zip("XYZ", self.positions_mm, self.d_mm, self.e_rad, strict=True):
            if x.ndim != 1 or x.size < 2 or d.shape != (x.size, 3) or e.shape != (x.size, 3):
                raise ValueError(
                    f"parameter tables of {axis}: d and E must have one row of 3 numbers per position (2 or more positions); "
                    f"got positions {x.shape}, d {d.shape}, E {e.shape}"
                )
            if not (np.isfinite(x).all() and np.isfinite(d).all() and np.isfinite(e).all() and (np.diff(x) > 0.0).all()):
                raise ValueError(f"parameter tables of {axis}: positions must increase, and all numbers must be finite")
        if not np.isfinite(self.squareness_rad).all():
            raise ValueError("parameter tables: squareness must be finite")

    @property
    def stroke_mm(self) -> F2:
        """First and last tabulated position, shape (3, 2)."""
        return np.array([[x[0], x[-1]] for x in self.positions_mm])

    def at(self, axes_mm: F2) -> tuple[F3, F3]:
        """Return d and E at commanded positions, interpolated linearly.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)

        Returns
        -------
        d_mm, e_rad : arrays, shape (n, 3 axes, 3 directions)

        Raises
        ------
        ValueError
            A position lies outside its table.
        """
        axes = np.asarray(axes_mm, dtype=np.float64)
        lo, hi = self.stroke_mm.T
        if axes.ndim != 2 or axes.shape[1] != 3 or not ((axes >= lo) & (axes <= hi)).all():
            raise ValueError("parameter tables: positions must have shape (n, 3) and lie inside the tables; nothing is extrapolated")
        out = np.empty((2, axes.shape[0], 3, 3))
        for j in range(3):
            for i in range(3):
                out[0, :, j, i] = np.interp(axes[:, j], self.positions_mm[j], self.d_mm[j][:, i])
                out[1, :, j, i] = np.interp(axes[:, j], self.positions_mm[j], self.e_rad[j][:, i])
        return out[0], out[1]

    def motions(self, kind: PahkType, axes_mm: F2) -> F3:
        """Return the ISO motions at commanded positions, squareness included, shape (n, 3 axes, 6)."""
        d, e = self.at(axes_mm)
        return motions_from_pahk(kind, np.asarray(axes_mm, dtype=np.float64), d, e, self.squareness_rad)


@dataclass(frozen=True)
class VolumetricMap:
    """Deviation on a grid over the volume.

    Parameters
    ----------
    axes_mm : array, shape (nodes, nodes, nodes, 3)
        Commanded positions, X first.
    deviation_mm : array, same shape
        Actual minus nominal.
    tool_mm : array, shape (3,)
        Vector from the spindle reference to the functional point.
    """

    axes_mm: F3
    deviation_mm: F3
    tool_mm: F1

    @property
    def nominal_mm(self) -> F3:
        """Nominal positions of the functional point."""
        return self.axes_mm + self.tool_mm

    @property
    def deformed_mm(self) -> F3:
        """Actual positions of the functional point."""
        return self.nominal_mm + self.deviation_mm

    def exaggerated_mm(self, factor: float) -> F3:
        """Return the deformed grid with the deviation multiplied by a factor, for drawing."""
        return self.nominal_mm + factor * self.deviation_mm


def chain_deviation_mm(machine: Machine, axes_mm: F2, motions: F3, form: Form = "first") -> F2:
    """Return the deviation in one of the four forms (`Form`); shapes and errors as in `abbe.models.geometry.chain.deviation_mm`."""
    if form == "first":
        return deviation_mm(machine, axes_mm, motions)
    return exact_deviation_mm(machine, axes_mm, motions, rotation=form)


def volumetric_map(
    kind: PahkType, tables: ParameterTables, nodes: int, probe_mm: F1 | None = None, *, box_mm: F2 | None = None, form: Form = "first"
) -> VolumetricMap:
    """Return the deviation on an equidistant grid.

    Parameters
    ----------
    nodes : int
        Number of nodes per axis, 2 or more.
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
        raise ValueError(f"volumetric map: {nodes} nodes per axis given, at least 2 needed")
    machine = pahk_machine(kind, tables.stroke_mm, probe_mm)
    axes = volume_grid(machine.stroke_mm if box_mm is None else np.asarray(box_mm, dtype=np.float64), nodes)
    off = chain_deviation_mm(machine, axes, tables.motions(kind, axes), form)
    shape = (nodes, nodes, nodes, 3)
    return VolumetricMap(axes.reshape(shape), off.reshape(shape), machine.tool_mm)
