"""Physical proof of sign, axis and unit of a control's corrections, by a ball-bar that stays mounted while a table changes.

Sign, axis and unit are conventions of the control; reading a table back does not show them. A new table changes the reading by
u . (new correction - old correction), u being the unit vector from cup to spindle.

- `sign_proof`, before the first real table: a small known step in the table of each axis shifts the tool by S and every reading by u . S.
  Many readings determine the three components of S.
- `probe`, for every table that is activated: compares readings at the same positions before and after. One position at which the reading
  does not change as expected refutes the table, even if the expected change is too small to prove the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables
from abbe.models.machine import AXES

FLOOR_MM, SHARE = 0.002, 0.2
"""Tolerance of a response: the larger of an absolute value (`FLOOR_MM`) and a share of the expected change (`SHARE`)."""
KNOWN_RATIOS = ((1000.0, "µm taken for mm"), (25.4, "mm taken for inch"), (1e-3, "mm taken for µm"), (1 / 25.4, "inch taken for mm"))


def step_tables(base: NineTables, axis: int, step_mm: float, low_mm: float, high_mm: float) -> NineTables:
    """Return the tables with a step added to the own-axis table of one axis; the first grid position is not changed.

    Parameters
    ----------
    base : NineTables
        The tables in force.
    axis : int
        0, 1, 2 for X, Y, Z.
    step_mm : float
        Added correction.
    low_mm, high_mm : float
        Range in which the correction has the whole step. It rises over the grid interval below the range and stays constant above it.

    Raises
    ------
    ValueError
        No grid interval lies below ``low_mm``, or ``high_mm`` lies beyond the grid.
    """
    grid = base.position_mm[axis]
    rise = int(np.searchsorted(grid, low_mm, side="right")) - 1
    if rise < 1 or high_mm > grid[-1]:
        raise ValueError(
            f"table of {AXES[axis]}: the range of the step, {low_mm:g} to {high_mm:g} mm, must lie on the grid and leave one grid interval "
            f"below it; the grid runs from {grid[0]:g} to {grid[-1]:g} mm"
        )
    curves = [c.copy() for c in base.correction_mm]
    curves[axis][rise:, axis] += step_mm
    return NineTables(base.position_mm, (curves[0], curves[1], curves[2]), base.u_mm)


@dataclass(frozen=True)
class Shift:
    """Displacement of the tool, shape (3,), mm, and its covariance, shape (3, 3), mm^2."""

    shift_mm: F1
    covariance_mm2: F2

    @property
    def u_mm(self) -> F1:
        """Standard uncertainty of each component, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance_mm2)))


def bar_shift(directions: F2, before_mm: F1, with_step_mm: F1, after_mm: F1, u_mm: float, share: float = 0.5) -> Shift:
    """Fit the shift of the tool to ball-bar readings at the same positions before, with, and after the step.

    Parameters
    ----------
    directions : array, shape (n, 3)
        Unit vectors from the cup to the tool.
    before_mm, with_step_mm, after_mm : array, shape (n,)
        Readings; positive means longer. A drift at a constant rate cancels.
    u_mm : float
        Standard uncertainty of one reading; if the residuals scatter more, their scatter is used.
    share : float
        Time of the readings with the step, as a share of the time between those before and after.

    Raises
    ------
    ValueError
        The directions do not separate the three components from a change of the bar's length.
    """
    change = with_step_mm - (1.0 - share) * before_mm - share * after_mm
    known = np.column_stack([directions, np.ones(len(directions))])
    if len(directions) < 6 or np.linalg.matrix_rank(known, tol=0.1) < 4:
        raise ValueError("sign proof: six or more positions are needed, spread over the hemisphere")
    found, *_ = np.linalg.lstsq(known, change, rcond=None)
    left, free = change - known @ found, len(change) - 4
    scatter = float(left @ left) / free if free > 0 else 0.0
    # A quarter of the drift, of bar length and cup, counts as uneven.
    drifted, *_ = np.linalg.lstsq(known, after_mm - before_mm, rcond=None)
    covariance = max(1.5 * u_mm**2, scatter) * np.linalg.inv(known.T @ known) + np.diag((0.25 * drifted) ** 2 / 3.0)
    return Shift(np.asarray(found[:3], dtype=np.float64), covariance[:3, :3])


@dataclass(frozen=True)
class SignProof:
    """Result of a step in each of X, Y and Z.

    ``response``, shape (3, 3): element [i, a] is component i of the shift over the step written for axis a; ``u``: its standard
    uncertainty. ``faults``: one sentence for each axis that does not respond as written; empty if sign, axis and unit are proved.
    """

    step_mm: float
    response: F2
    u: F2
    faults: tuple[str, ...]

    @property
    def proved(self) -> bool:
        """Whether sign, axis and unit are proved, so that tables may be written."""
        return not self.faults


def sign_proof(step_mm: float, shifts: tuple[Shift, Shift, Shift]) -> SignProof:
    """Judge the shifts that a step in X, in Y and in Z causes: a positive correction must move its own axis in the positive direction.

    A response whose expanded uncertainty exceeds half the tolerance is a fault as well, because it proves nothing.
    """
    response = np.column_stack([s.shift_mm for s in shifts]) / step_mm
    u = np.column_stack([s.u_mm for s in shifts]) / step_mm
    allowed = max(FLOOR_MM / step_mm, SHARE)
    faults = [text for a in range(3) if (text := _fault(a, response[:, a], u[:, a], allowed))]
    return SignProof(step_mm, response, u, tuple(faults))


def _fault(axis: int, moved: F1, u: F1, allowed: float) -> str:
    wanted = np.eye(3)[axis]
    name = AXES[axis]
    if 2.0 * u.max() > 0.5 * allowed * max(1.0, float(np.abs(moved).max())):
        return f"{name}: the response has an uncertainty of {200.0 * u.max():.0f} % (k = 2) and proves nothing; repeat the step"
    if (np.abs(moved - wanted) <= allowed).all():
        return ""
    main = int(np.argmax(np.abs(moved)))
    if abs(moved[main]) <= allowed:
        return f"{name}: the step has no effect: is compensation switched on, and the axis referenced?"
    faults = [] if main == axis else [f"it moves {AXES[main]}"]
    faults += ["the sign is reversed"] if moved[main] < 0.0 else []
    size = abs(float(moved[main]))
    if abs(size - 1.0) > allowed:
        why = next((f": {text}" for ratio, text in KNOWN_RATIOS if abs(size / ratio - 1.0) < SHARE), "")
        faults.append(f"it moves by {size:.3g} times the step{why}")
    other = np.delete(moved, main)
    if np.abs(other).max() > allowed:
        faults.append("other axes move with it")
    return f"{name}: {', '.join(faults)}"


SHOWN = 3
OBSERVED_MM = 0.003
"""An axis counts as observed only if its tables change some reading by at least this much, mm: drift within the tolerance could hide the
reversed sign of a smaller change."""


@dataclass(frozen=True)
class Probe:
    """Result of a sign probe.

    Parameters
    ----------
    expected_mm, measured_mm : array, shape (n,)
        Change of the reading at every position; positive means longer.
    observed : tuple of bool
        For X, Y, Z: whether the effect of the table on this axis is large enough at some position to show a wrong sign.
    agrees : bool
        Whether the reading changed as expected at every position, within the larger of 2 um and 20 % of the largest expected change.
    """

    expected_mm: F1
    measured_mm: F1
    observed: tuple[bool, bool, bool]
    agrees: bool

    @property
    def text(self) -> str:
        """Measured and expected changes, µm, at the positions with the largest difference or, if all agree, the largest expected change."""
        off = np.abs(self.measured_mm - self.expected_mm)
        order = np.argsort(-np.nan_to_num(np.abs(self.expected_mm) if self.agrees else off, nan=np.inf), kind="stable")[:SHOWN]
        pairs = ", ".join(f"{1e3 * self.measured_mm[k]:+.1f} ({1e3 * self.expected_mm[k]:+.1f} expected)" for k in order)
        axes = [axis for axis, observed in zip(AXES, self.observed, strict=True) if not observed]
        blind = f"; too small to prove the sign of {', '.join(axes)}" if axes else ""
        return f"the ball-bar's reading changed by {pairs} um{blind}"


def expected_changes(places_mm: F2, centre_mm: F1, old: NineTables | None, new: NineTables) -> F2:
    """Return the expected change of the ball-bar's reading by the new corrections of X, Y and Z, shape (n, 3), mm.

    Parameters
    ----------
    places_mm : array, shape (n, 3)
        Commanded positions.
    centre_mm : array, shape (3,)
        Centre of the sphere: the cup, which stays in place when the table changes.
    old, new : NineTables
        Tables active before (None: no table) and after.
    """
    out = places_mm - centre_mm
    change = new.correction_at(places_mm) - (0.0 if old is None else old.correction_at(places_mm))
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None] * change, dtype=np.float64)


def probe(each_mm: F2, before_mm: F1, after_mm: F1) -> Probe:
    """Compare the change of the ball-bar's readings with the change expected from the tables.

    Parameters
    ----------
    each_mm : array, shape (n, 3)
        From `expected_changes`.
    before_mm, after_mm : array, shape (n,)
        Readings at the same positions.

    Raises
    ------
    ValueError
        The arrays differ in length.
    """
    if not len(each_mm) == len(before_mm) == len(after_mm) > 0:
        raise ValueError(
            f"sign probe: {len(each_mm)} expected changes, {len(before_mm)} readings before and {len(after_mm)} after; one of each per "
            "position is needed"
        )
    measured, expected = after_mm - before_mm, each_mm.sum(axis=1)
    allowed = max(FLOOR_MM, SHARE * float(np.abs(expected).max()))
    # A reversed sign changes the reading by twice the expected change, which must exceed the tolerance.
    largest = np.abs(each_mm).max(axis=0)
    x, y, z = ((largest >= OBSERVED_MM) & (2.0 * largest > 1.5 * allowed)).tolist()
    return Probe(expected, measured, (x, y, z), bool((np.abs(measured - expected) <= allowed).all()))
