"""Parameter-offset (Abbe) transformation of all ten types from one derivation (math.md 2.1; P (9), (10), (A3), (A6), (A9)).

An instrument cannot stand at the origin: along axis j it measures the deviation on the line through (Xo, Yo, Zo), which holds the axis' own
function AND levers times angular errors. Rule G gives what it sees for any chain. Because rule G is linear, the part that the angular
errors alone cause IS the transformation: subtract it and the functions refer to the origin. So the ten printed sets of rules are one
function here, and the terms that the paper lost (the slopes m[.], XoEy(Y) in (A3), signs in (A6), (A9), math.md 3) cannot get lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.line_fit import straight_line
from abbe.models.geometry.chain import deviation_mm
from abbe.models.machine import lever_masks
from abbe.models.notation.pahk import PahkType, motions_from_pahk, pahk_machine, parameter_signs
from abbe.models.papers.pahk.volume_map import ParameterTables, Triple

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Axes whose lines alpha, beta1, beta2 compare."""


@dataclass(frozen=True)
class OffsetSetup:
    """Positions of the measuring lines.

    Parameters
    ----------
    offset_mm : array, shape (3,) or (3 lines, 3)
        (Xo, Yo, Zo): commanded position of the axes that stand still, one for all three lines or one per measured line. Squareness takes
        the slopes of both lines at their own offsets, as math.md 2.1 asks where they share no point.
    probe_mm : array, shape (3,)
        Probe offset (Xp, Yp, Zp).
    table_point_mm : array, shape (3,), optional
        A reflector fixed on the table at this point of the workpiece frame. Lines of workpiece-side axes then use it as lever (less the
        travel of carriages nearer the workpiece) and the terms "own travel x own angle" of math.md 2.1 vanish. Without it the
        functional point is the probe tip. Lines of tool-side axes are always of the tip.

    Raises
    ------
    ValueError
        Wrong shapes or numbers that are not finite.
    """

    offset_mm: F2
    probe_mm: F1 = field(default_factory=lambda: np.zeros(3))
    table_point_mm: F1 | None = None

    def __post_init__(self) -> None:
        """Check and normalise once: one offset per line."""
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
    """Commanded positions of the measuring line of an axis, shape (n_axis, 3): that axis over its table, the others at the offset."""
    x = tables.positions_mm[axis]
    axes: F2 = np.repeat(setup.offset_mm[axis][None], x.size, axis=0)
    axes[:, axis] = x
    return axes


def line_deviation_mm(kind: PahkType, tables: ParameterTables, setup: OffsetSetup, axis: int, still_rad: F2 | None = None) -> F2:
    """Deviation (actual minus nominal, rule G) along the measuring line of an axis.

    Parameters
    ----------
    axis : int
        0, 1, 2 for the line along X, Y, Z.
    still_rad : array, shape (3 axes, 3), optional
        E of each axis at the offset where it stands still. Default: linear between the tabulated values.

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
    # What the resting axes are displaced by is the same all along the line: no measurement of this line sees it.
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
    """Readings of instruments on the lines of a set-up for parameters that refer to the origin.

    Definition (math.md 2.1): positioning is the deviation along the line less its value at the start; straightness the deviation across
    less its least-squares line, as the table's own motion on a workpiece-side axis; squareness minus the sum of the two slopes, in the
    type's sign of alpha. Angles are the same everywhere.

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
    """Corrections of values measured off the origin: the Abbe terms of P (9), (10), (A3), (A6), (A9), from the angular errors only.

    Derived from rule G in place of the printed sets, which lack the slope terms of squareness and have wrong signs in (A6), (A9) (math.md
    2.1 and 3); agrees with math.md 2.1 for all ten types.

    Parameters
    ----------
    kind, tables, setup, still_rad
        As in `as_measured`; translations and squareness of ``tables`` play no part.

    Returns
    -------
    ParameterTables
        ``d_mm`` (mm, Pahk's signs, same grid; straightness terms with their least-squares line removed) and ``squareness_rad`` (alpha,
        beta1, beta2): the terms.

    Raises
    ------
    ValueError
        An offset beyond the tables without ``still_rad``.
    """
    nothing = replace(tables, d_mm=_zeros(tables), squareness_rad=np.zeros(3))
    measured = as_measured(kind, nothing, setup, still_rad)
    return replace(measured, d_mm=(-measured.d_mm[0], -measured.d_mm[1], -measured.d_mm[2]), squareness_rad=-measured.squareness_rad)


def refer_to_origin(kind: PahkType, measured: ParameterTables, setup: OffsetSetup, still_rad: F2 | None = None) -> ParameterTables:
    """Parameters referred to the origin from what was measured on offset lines: measured + `offset_terms` (P (9), (10), (A3), (A6), (A9)).

    Inverse of `as_measured` for functions in its normal form (positioning zero at the start, straightness without least-squares line).
    Arguments, units, signs and errors as there; errata as in `offset_terms`.
    """
    terms = offset_terms(kind, measured, setup, still_rad)
    d = [m + t for m, t in zip(measured.d_mm, terms.d_mm, strict=True)]
    return replace(measured, d_mm=(d[0], d[1], d[2]), squareness_rad=measured.squareness_rad + terms.squareness_rad)


def _zeros(tables: ParameterTables) -> Triple:
    return np.zeros_like(tables.d_mm[0]), np.zeros_like(tables.d_mm[1]), np.zeros_like(tables.d_mm[2])
