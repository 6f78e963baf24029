"""A machine whose 18 error motions are tables at evenly spaced positions, prepared so that its deviation costs few operations.

Rule G's levers are sums of travels and constants (math.md 2). What belongs to constants (tool minus pivot) is linear in the table's values,
so it goes into the translation tables once, for a few nodes, instead of being worked out at a million points. What is left for a point is:
look up, add up the angles from the workpiece towards the tool, and let each travel be turned by the sum that stands before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.machine import Machine, levers_mm, split_chain

Positions = Callable[[F1], ArrayLike]


@dataclass(frozen=True, eq=False)
class Segments:
    """Straight pieces of the tables, ready to be summed; all tuples and rows in the order X, Y, Z.

    Parameters
    ----------
    order : tuple of 3
        Axis indices from the workpiece to the tool.
    own : tuple of 3
        Whether an axis' own travel is part of its lever (work side).
    needed : tuple of 3
        Components 0..5 of each axis that the deviation depends on; the others have no lever.
    first_mm, length_mm, cells_per_mm : arrays, shape (3,)
    offset, slope : tuples of 3 arrays, shape (6, nodes)
        In the cell that begins at node i the value is offset[:, i] + slope[:, i] * (position - first), EX EY EZ with the arm from pivot to
        tool included; the last node's slope is zero.
    square : array, shape (3, 3)
        Translation per travel of the axis (row) that squareness adds.
    """

    order: tuple[int, int, int]
    own: tuple[bool, bool, bool]
    needed: tuple[tuple[int, ...], ...]
    first_mm: F1
    length_mm: F1
    cells_per_mm: F1
    offset: tuple[F2, ...]
    slope: tuple[F2, ...]
    square: F2


@dataclass(frozen=True, eq=False)
class TableMachine:
    """Nominal machine, error tables and squareness; between the nodes straight lines, outside them the end value (as `numpy.interp`).

    Parameters
    ----------
    machine : Machine
    range_mm : array, shape (3, 2)
        Position of the first and the last node of X, Y, Z; the nodes between are evenly spaced.
    tables : 3 arrays, shape (nodes, 6), nodes >= 2
        EX EY EZ (mm) and EA EB EC (rad) of the X, Y, Z carriage at the nodes, ISO signs; as many nodes per axis as one likes.
    squareness_rad : array, shape (3,)
        C0Y, B0Z, A0Z. They act on the commanded position counted from axis zero, as in `abbe.models.functions.motions.ErrorMotions`, and go
        on outside the tables.

    Raises
    ------
    ValueError
        A shape is wrong, a number is not finite, or a range is empty.
    """

    machine: Machine
    range_mm: F2
    tables: tuple[F2, F2, F2]
    squareness_rad: F1 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check and copy once: the prepared pieces must not go stale."""
        if len(self.tables) != 3:
            raise ValueError(f"table machine: expected 3 tables, one per axis, got {len(self.tables)}")
        range_mm, squareness = _finite("range_mm", self.range_mm, (3, 2)), _finite("squareness_rad", self.squareness_rad, (3,))
        tables = tuple(_finite(f"table {a}", t, (max(2, len(np.atleast_1d(t))), 6)) for a, t in zip("XYZ", self.tables, strict=True))
        if (range_mm[:, 1] <= range_mm[:, 0]).any():
            raise ValueError("table machine: every range_mm must run from its smaller to its larger position")
        for name, value in (("range_mm", range_mm), ("tables", tables), ("squareness_rad", squareness)):
            object.__setattr__(self, name, value)

    @cached_property
    def segments(self) -> Segments:
        """The tables as straight pieces with the constant arms worked in."""
        work, tool = split_chain(self.machine.chain)
        order = (*work, *tool)
        own = (0 in work, 1 in work, 2 in work)
        length = self.range_mm[:, 1] - self.range_mm[:, 0]
        cells = np.array([t.shape[0] - 1 for t in self.tables])
        arm = levers_mm(self.machine, np.zeros((1, 3)))[0]
        pieces = [self._pieces(a, length[a] / cells[a], arm[a]) for a in range(3)]
        square = np.zeros((3, 3))
        for (axis, component, sign), value in zip(SQUARENESS.values(), self.squareness_rad, strict=True):
            square[axis, component] += sign * value
        return Segments(
            order=(order[0], order[1], order[2]),
            own=own,
            needed=tuple(_needed(order[order.index(a) + (not own[a]) :]) for a in range(3)),
            first_mm=self.range_mm[:, 0].copy(),
            length_mm=length,
            cells_per_mm=cells / length,
            offset=tuple(p[0] for p in pieces),
            slope=tuple(p[1] for p in pieces),
            square=square,
        )

    def _pieces(self, axis: int, step_mm: float, arm_mm: F1) -> tuple[F2, F2]:
        values = self.tables[axis].copy()
        values[:, :3] += np.cross(values[:, 3:], arm_mm)
        slope = np.zeros_like(values)
        slope[:-1] = np.diff(values, axis=0) / step_mm
        offset = values - slope * (np.arange(len(values)) * step_mm)[:, None]
        return np.ascontiguousarray(offset.T), np.ascontiguousarray(slope.T)

    def motions(self, axes_mm: ArrayLike) -> F3:
        """Error motions at commanded positions, the plain way, squareness included.

        For `abbe.models.geometry.chain.deviation_mm`, whose result the fast kernels repeat, and for the exact chain.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)
            Commanded X, Y, Z. Where one is NaN or infinite, that axis' motions are NaN.

        Returns
        -------
        array, shape (n, 3 axes X Y Z, 6)
            EX EY EZ (mm), EA EB EC (rad), ISO 230-1 signs.

        Raises
        ------
        ValueError
            Another shape than (n, 3).
        """
        given = np.asarray(axes_mm, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != 3:
            raise ValueError(f"table machine: axes_mm must have shape (n, 3), got {given.shape}")
        positions = np.where(np.isfinite(given), given, np.nan)
        out: F3 = np.empty((positions.shape[0], 3, 6))
        for a, table in enumerate(self.tables):
            nodes = np.linspace(self.range_mm[a, 0], self.range_mm[a, 1], table.shape[0])
            for c in range(6):
                out[:, a, c] = np.interp(positions[:, a], nodes, table[:, c])
            out[:, a, :3] += positions[:, a, None] * self.segments.square[a]
        return out


def sampled(
    machine: Machine, functions: Mapping[str, Positions], squareness_rad: Mapping[str, float] | None = None, nodes: int = 51
) -> TableMachine:
    """Tables over the strokes from functions of position, e.g. from ``functions`` and ``squareness_rad`` of an `ErrorMotions`.

    Parameters
    ----------
    machine : Machine
    functions : mapping
        ``"EXX"`` .. ``"ECZ"``: positions in mm, shape (nodes,), to values in mm or rad; missing ones are zero.
    squareness_rad : mapping, optional
        ``"C0Y"``, ``"B0Z"``, ``"A0Z"``; missing ones are zero.
    nodes : int
        Evenly spaced positions per axis, ends included. Between them the tables are straight: a function that bends is met the better the
        more there are (error at most curvature times spacing squared over 8).

    Raises
    ------
    ValueError
        An unknown name (direction-dependent ``@reverse`` functions have no place in one table), or values that are not finite.
    """
    square = dict(squareness_rad or {})
    unknown = [k for k in functions if k not in PLACES] + [k for k in square if k not in SQUARENESS]
    if unknown:
        raise ValueError(f"table machine: {unknown[0]!r} is not an error motion or squareness that one table can hold")
    if nodes < 2:
        raise ValueError(f"table machine: nodes = {nodes}, expected 2 or more")
    tables = np.zeros((3, nodes, 6))
    for name, function in functions.items():
        axis, component = PLACES[name]
        tables[axis, :, component] = function(np.linspace(machine.stroke_mm[axis, 0], machine.stroke_mm[axis, 1], nodes))
    angles = np.array([square.get(name, 0.0) for name in SQUARENESS])
    return TableMachine(machine, machine.stroke_mm, (tables[0], tables[1], tables[2]), angles)


def _needed(travels: tuple[int, ...]) -> tuple[int, ...]:
    """Translations always; an angle when it turns one of the travels, that is, one across its own direction."""
    return (0, 1, 2, *(3 + c for c in range(3) if any(a != c for a in travels)))


def _finite(name: str, values: ArrayLike, shape: tuple[int, ...]) -> F2:
    copy = np.array(values, dtype=np.float64)
    if copy.shape != shape or not np.isfinite(copy).all():
        raise ValueError(f"table machine: {name} must be finite numbers of shape {shape}, got shape {copy.shape}")
    copy.setflags(write=False)
    return copy
