"""Parameter functions of a machine as tables over the travel of each axis, in Pahk's signs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.notation.pahk import PahkType, motions_from_pahk

Triple = tuple[F2, F2, F2]
"""One table per axis X, Y, Z, each of shape (n_j, 3 directions): the numbers of positions may differ."""


@dataclass(frozen=True)
class ParameterTables:
    """The 21 parameters of math.md 2: d_i(j) and E_i(j) at tabulated positions, and three squareness errors.

    Parameters
    ----------
    positions_mm : three arrays, shape (n_j,)
        Increasing commanded positions of X, Y, Z; at least two of each.
    d_mm : three arrays, shape (n_j, 3)
        d_x, d_y, d_z of the axis: positioning along it, straightness across, Pahk's signs (`abbe.models.notation.pahk.parameter_signs`).
    e_rad : three arrays, shape (n_j, 3)
        E_x, E_y, E_z of the axis, Pahk's signs.
    squareness_rad : array, shape (3,)
        alpha (XY), beta1 (XZ), beta2 (YZ) in the sign of the type.

    Raises
    ------
    ValueError
        Shapes do not agree, positions do not increase, or something is not finite.
    """

    positions_mm: tuple[F1, F1, F1]
    d_mm: Triple
    e_rad: Triple
    squareness_rad: F1 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check and normalise once."""
        for name in ("positions_mm", "d_mm", "e_rad"):
            object.__setattr__(self, name, tuple(np.asarray(v, dtype=np.float64) for v in getattr(self, name)))
        object.__setattr__(self, "squareness_rad", np.asarray(self.squareness_rad, dtype=np.float64))
        sizes = [len(v) for v in (self.positions_mm, self.d_mm, self.e_rad)]
        if sizes != [3, 3, 3] or self.squareness_rad.shape != (3,):
            raise ValueError("parameter tables: expected tables of X, Y and Z and three squareness errors")
        for axis, x, d, e in zip("XYZ", self.positions_mm, self.d_mm, self.e_rad, strict=True):
            if x.ndim != 1 or x.size < 2 or d.shape != (x.size, 3) or e.shape != (x.size, 3):
                raise ValueError(
                    f"parameter tables of {axis}: positions {x.shape} need d and E of shape (n, 3), got {d.shape} and {e.shape}"
                )
            if not (np.isfinite(x).all() and np.isfinite(d).all() and np.isfinite(e).all() and (np.diff(x) > 0.0).all()):
                raise ValueError(f"parameter tables of {axis}: positions must increase and everything must be finite")
        if not np.isfinite(self.squareness_rad).all():
            raise ValueError("parameter tables: squareness must be finite")

    @property
    def stroke_mm(self) -> F2:
        """First and last tabulated position, shape (3, 2)."""
        return np.array([[x[0], x[-1]] for x in self.positions_mm])

    def at(self, axes_mm: F2) -> tuple[F3, F3]:
        """d and E at commanded positions, linear between the tabulated ones.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)

        Returns
        -------
        d_mm, e_rad : arrays, shape (n, 3 axes, 3 directions)

        Raises
        ------
        ValueError
            A position lies outside its table: nothing is extrapolated.
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
        """ISO motions at commanded positions, shape (n, 3 axes, 6), squareness included (`abbe.models.notation.pahk.motions_from_pahk`)."""
        d, e = self.at(axes_mm)
        return motions_from_pahk(kind, np.asarray(axes_mm, dtype=np.float64), d, e, self.squareness_rad)
