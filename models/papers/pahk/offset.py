"""Parameter-offset (Abbe) transformation of all ten types from one derivation (P (9), (10), (A3), (A6), (A9)).

An instrument cannot stand at the origin. Along axis j it measures the deviation on the line through (Xo, Yo, Zo). This deviation contains
the functions of the axis AND angular errors times levers. Rule G (docs/explanation/conventions.md) gives it for any chain. Rule G is
linear, so the part caused by angular errors alone can be subtracted; the rest refers to the origin. One function thus replaces ten printed
sets of rules, which have errata: missing slopes m[.], a missing XoEy(Y) in (A3), wrong signs in (A6), (A9).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.polynomial import straight_line
from abbe.models.geometry.chain import deviation_mm
from abbe.models.machine import lever_masks
from abbe.models.notation.pahk import PahkType, motions_from_pahk, pahk_machine, parameter_signs
from abbe.models.papers.pahk.volume_map import ParameterTables, Triple

PAIRS = ((0, 1), (0, 2), (1, 2))
"""The two axes of alpha, beta1 and beta2."""


@dataclass(frozen=True)
class OffsetSetup:
    """Positions of the measuring lines.

    Parameters
    ----------
    offset_mm : array, shape (3,) or (3 lines, 3)
        (Xo, Yo, Zo): commanded position of the axes at rest, one for all three lines or one per line. Squareness uses the slope of each
        line at its own offset.
    probe_mm : array, shape (3,)
        Probe offset (Xp, Yp, Zp).
    table_point_mm : array, shape (3,), optional
        Position, in the workpiece frame, of a reflector fixed on the table. Lines of workpiece-side axes then refer to the reflector (less
        the travel of carriages nearer the workpiece), which removes the terms "own travel x own angle". By default, and always for lines of
        tool-side axes, the functional point is the probe tip.

    Raises
    ------
    ValueError
        Wrong shapes or numbers that are not finite.
    """

    offset_mm: F2
    probe_mm: F1 = field(default_factory=lambda: np.zeros(3))
    table_point_mm: F1 | None = None

    def __post_init__(self) -> None:
        """Check the numbers and expand the offset to one per line."""
        offset = np.asarray(self.offset_mm, dtype=np.float64)
        points = [np.asarray(p, dtype=np.float64) for p in (self.probe_mm, self.table_point_mm) if p is not None]
        if offset.shape not in ((3,), (3, 3)) or any(p.shape != (3,) for p in points):
            raise ValueError("setup: offset_mm must have shape (3,) or (3, 3), probe_mm and table_point_mm (3,)")
        if not all(np.isfinite(p).all() for p in (offset, *points)):
            raise ValueError("setup: all numbers must be finite")
        object.__setattr__(self, "offset_mm", np.broadcast_to(offset, (3, 3)).copy())
        object.__setattr__(self, "probe_mm", points[0])
        if self.table_point_mm is not None:
            object.__setattr__(self, "table_point_mm", points[1])


def line_positions_mm(tables: ParameterTables, setup: OffsetSetup, axis: int) -> F2:
    """Return the commanded positions of the measuring line of an axis, shape (n_axis, 3): the other axes stand at the offset."""
    x = tables.positions_mm[axis]
    axes: F2 = np.repeat(setup.offset_mm[axis][None], x.size, axis=0)
    axes[:, axis] = x
    return axes


def line_deviation_mm(kind: PahkType, tables: ParameterTables, setup: OffsetSetup, axis: int, still_rad: F2 | None = None) -> F2:
    """Return the deviation (actual minus nominal, rule G) along the measuring line of an axis.

    Parameters
    ----------
    axis : int
        0, 1, 2 for the line along X, Y, Z.
    still_rad : array, shape (3 axes, 3), optional
        E of each axis at its offset position. Default: interpolated linearly in the tables.

    Returns
    -------
    array, shape (n_axis, 3), mm, in the workpiece's frame.

    Raises
    ------
    ValueError
        An offset lies outside the tables and ``still_rad`` is not given.
    """
    axes = line_positions_mm(tables, setup, axis)
    n = axes.shape[0]
    d, e = np.zeros((n, 3, 3)), np.empty((n, 3, 3))
    # The displacement by the axes at rest is constant along the line, so no measurement of the line shows it.
    e[:] = tables.at(axes)[1] if still_rad is None else np.asarray(still_rad, dtype=np.float64)
    d[:, axis], e[:, axis] = tables.d_mm[axis], tables.e_rad[axis]
    motions = motions_from_pahk(kind, axes, d, e, tables.squareness_rad)
    off = deviation_mm(pahk_machine(kind, tables.stroke_mm, setup.probe_mm), axes, motions)
    if setup.table_point_mm is not None and kind.work_side[axis]:
        mask = lever_masks(kind.chain)[axis]
        tip = axes * mask + setup.probe_mm
        fixed = setup.table_point_mm - axes * (1.0 - mask)
        off = off + np.cross(motions[:, axis, 3:], fixed - tip)
    return off


def as_measured(kind: PahkType, tables: ParameterTables, setup: OffsetSetup, still_rad: F2 | None = None) -> ParameterTables:
    """Return the parameters as instruments measure them on the lines of a set-up, from parameters that refer to the origin.

    Positioning is the deviation along the line less its value at the start. Straightness is the deviation across the line less its
    least-squares line; for a workpiece-side axis it is the table's own motion. Squareness is minus the sum of the two slopes, with the sign
    of alpha of the type. Angles are the same on all lines.

    Parameters
    ----------
    still_rad : array, shape (3 axes, 3), optional
        As in `line_deviation_mm`.

    Returns
    -------
    ParameterTables
        ``d_mm`` and ``squareness_rad`` as measured, the rest unchanged.
    """
    signs = parameter_signs(kind)
    offsets: list[F2] = []
    slopes = np.zeros((3, 3))  # [line, direction]
    for j in range(3):
        x = tables.positions_mm[j]
        off = line_deviation_mm(kind, tables, setup, j, still_rad)
        off = off - off[0]
        for i in set(range(3)) - {j}:
            slope, start = straight_line(x, off[:, i])
            slopes[j, i] = slope
            off[:, i] = signs[j, i] * (off[:, i] - start - slope * x)
        offsets.append(off)
    obtuse = np.array([-(slopes[a, b] + slopes[b, a]) for a, b in PAIRS])
    squareness: F1 = obtuse * np.array([kind.alpha_sign, 1.0, 1.0])
    return replace(tables, d_mm=(offsets[0], offsets[1], offsets[2]), squareness_rad=squareness)


def offset_terms(kind: PahkType, tables: ParameterTables, setup: OffsetSetup, still_rad: F2 | None = None) -> ParameterTables:
    """Return the corrections of values measured off the origin: the Abbe terms of P (9), (10), (A3), (A6), (A9).

    The corrections come from rule G and depend only on the angular errors. Errata of the printed sets: missing slope terms of squareness,
    wrong signs in (A6), (A9).

    Parameters
    ----------
    kind, tables, setup, still_rad
        As in `as_measured`; translations and squareness of ``tables`` have no effect.

    Returns
    -------
    ParameterTables
        Corrections in ``d_mm`` (Pahk's signs, same grid; straightness without its least-squares line) and in ``squareness_rad``.

    Raises
    ------
    ValueError
        An offset lies outside the tables and ``still_rad`` is not given.
    """
    nothing = replace(tables, d_mm=_zeros(tables), squareness_rad=np.zeros(3))
    measured = as_measured(kind, nothing, setup, still_rad)
    return replace(measured, d_mm=(-measured.d_mm[0], -measured.d_mm[1], -measured.d_mm[2]), squareness_rad=-measured.squareness_rad)


def refer_to_origin(kind: PahkType, measured: ParameterTables, setup: OffsetSetup, still_rad: F2 | None = None) -> ParameterTables:
    """Refer parameters measured on offset lines to the origin, by adding `offset_terms` (P (9), (10), (A3), (A6), (A9)).

    This inverts `as_measured` for positioning that is zero at the start and straightness without a least-squares line. Arguments, units,
    signs and errors are those of `as_measured`.
    """
    terms = offset_terms(kind, measured, setup, still_rad)
    d = [m + t for m, t in zip(measured.d_mm, terms.d_mm, strict=True)]
    return replace(measured, d_mm=(d[0], d[1], d[2]), squareness_rad=measured.squareness_rad + terms.squareness_rad)


def _zeros(tables: ParameterTables) -> Triple:
    return np.zeros_like(tables.d_mm[0]), np.zeros_like(tables.d_mm[1]), np.zeros_like(tables.d_mm[2])
