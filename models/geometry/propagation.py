"""Uncertainty of the tool's deviation from the covariance of the parameters of the error motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from abbe.models.arrays import F2, F3, F4
from abbe.models.functions.motions import ErrorMotions
from abbe.models.geometry.chain import exact_jacobian, motion_jacobian
from abbe.models.machine import Machine

TOLERANCE = 1e-6
"""Accepted error of a correlation: covariances come from files with six or seven digits."""


def checked_covariance(matrix: ArrayLike, size: int, what: str = "covariance") -> F2:
    """Check a covariance matrix and return it exactly symmetric.

    The check uses correlations, because variances in mm^2 and rad^2 differ by many orders of magnitude. A parameter with variance zero is
    certain and has no correlation.

    Parameters
    ----------
    matrix : array, shape (size, size)
        Variances on the diagonal, in squares of the parameters' units.
    size : int
        Number of parameters.
    what : str
        Name of the matrix in error messages.

    Returns
    -------
    array, shape (size, size)

    Raises
    ------
    ValueError
        The matrix has another shape, a value that is not a finite number, a negative variance, or a covariance with a parameter of variance
        zero; or it deviates by more than `TOLERANCE` of a correlation from a symmetric, positive semidefinite matrix.
    """
    raw = np.asarray(matrix)
    if raw.dtype.kind not in "fiu":
        raise ValueError(f"{what}: expected rows of numbers, got {raw.dtype}")
    c: F2 = raw.astype(np.float64)
    if c.shape != (size, size):
        raise ValueError(f"{what}: {size} parameters need shape ({size}, {size}), got {c.shape}")
    if not np.isfinite(c).all():
        raise ValueError(f"{what}: expected finite numbers")
    variance = np.diag(c)
    if (variance < 0.0).any():
        raise ValueError(
            f"{what}, row {int(np.argmax(variance < 0.0)) + 1}: the variance is negative; expected squares of standard uncertainties"
        )
    certain = (variance == 0.0) & ((c != 0.0).any(axis=0) | (c != 0.0).any(axis=1))
    if certain.any():
        raise ValueError(f"{what}, row {int(np.argmax(certain)) + 1}: the variance is zero, so the whole row and column must be zero")
    _check_correlations(c, np.sqrt(np.where(variance > 0.0, variance, 1.0)), what)
    half: F2 = 0.5 * c
    return half + half.T  # halved first, so that the sum of two large numbers does not overflow


def _check_correlations(c: F2, spread: F2, what: str) -> None:
    with np.errstate(all="ignore"):  # an overflow is refused as a correlation above 1
        scaled = c / spread[:, None] / spread
        if (np.abs(scaled - scaled.T) > TOLERANCE).any():
            raise ValueError(f"{what}: it is not symmetric: row i, column j must hold the same number as row j, column i")
        impossible = not (np.abs(scaled) <= 1.0 + TOLERANCE).all()
    if impossible or (scaled.size and np.linalg.eigvalsh(scaled).min() < -TOLERANCE):
        raise ValueError(f"{what}: not a covariance: some combination of the parameters would have a negative variance")


CHUNK = 8192
"""Maximum number of points in one batch."""

WEIGHTS = 2**20
"""Maximum number of points times parameters in one batch: 8 MB, so that many points and long tables fit into memory."""


@dataclass(frozen=True, slots=True)
class Points:
    """Points at which a deviation is computed.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    direction : array, shape (n, 3), optional
        Sign of the last move of each axis, as `ErrorMotions.motions` takes it.
    tool_mm : array, shape (n, 3), optional
        Tool vector at each point in place of the machine's.
    """

    axes_mm: F2
    direction: F2 | None = None
    tool_mm: F2 | None = None

    def rows(self, which: slice) -> Points:
        """Return a slice of the points."""
        direction = None if self.direction is None else self.direction[which]
        return Points(self.axes_mm[which], direction, None if self.tool_mm is None else self.tool_mm[which])


def sensitivity(machine: Machine, errors: ErrorMotions, names: Sequence[str], at: Points, *, exact: bool = False) -> F3:
    """Return the derivative of the deviation with respect to parameters of the error motions.

    Parameters
    ----------
    names : sequence of str
        Some of `ErrorMotions.parameter_names`.
    at : Points
    exact : bool
        Use finite rotations at the given errors instead of rule G.

    Returns
    -------
    array, shape (n, 3, len(names))
        mm per unit of the parameter.

    Raises
    ------
    ValueError
        A name is not a parameter, or a shape is wrong.
    """
    places, weights = errors.sensitivities(names, at.axes_mm, at.direction)
    slopes = _slopes(machine, errors, at, exact=exact)
    axes, components = np.array(places, dtype=np.intp).reshape(-1, 2).T
    out: F3 = slopes[:, :, axes, components] * weights[:, None, :]
    return out


def deviation_covariance(
    machine: Machine, errors: ErrorMotions, covariance: tuple[Sequence[str], F2], at: Points, *, exact: bool = False
) -> F3:
    """Return the covariance of the three components of the deviation at each point, by the law of propagation (GUM).

    Parameters
    ----------
    covariance : (names, matrix)
        Names of parameters, and their covariance, shape (p, p), in products of their units. Other parameters are taken as certain.
    at, exact
        As in `sensitivity`.

    Returns
    -------
    array, shape (n, 3, 3), mm^2

    Raises
    ------
    ValueError
        The matrix does not fit the names or is not a covariance (`checked_covariance`), or an error as in `sensitivity`.
    """
    names, matrix = covariance
    matrix = checked_covariance(matrix, len(names))
    out: F3 = np.zeros((at.axes_mm.shape[0], 3, 3))
    if len(names) == 0:
        return out
    places, _ = errors.sensitivities(names, np.zeros((0, 3)))
    motion = np.array([6 * axis + component for axis, component in places])
    order = np.argsort(motion, kind="stable")
    acting, first = np.unique(motion[order], return_index=True)
    ordered, matrix = [names[k] for k in order], matrix[np.ix_(order, order)]
    step = max(1, min(CHUNK, WEIGHTS // len(names)))
    for start in range(0, at.axes_mm.shape[0], step):
        some = at.rows(slice(start, start + step))
        _, weights = errors.sensitivities(ordered, some.axes_mm, some.direction)
        of_motions = _motion_covariance(weights, matrix, first)
        slopes = _slopes(machine, errors, some, exact=exact).reshape(-1, 3, 18)[:, :, acting]
        out[start : start + step] = slopes @ of_motions @ slopes.transpose(0, 2, 1)
    return out


def _slopes(machine: Machine, errors: ErrorMotions, at: Points, *, exact: bool) -> F4:
    """Return the derivative of the deviation with respect to each error motion, shape (n, 3, 3, 6)."""
    if exact:
        return exact_jacobian(machine, at.axes_mm, errors.motions(at.axes_mm, at.direction), at.tool_mm)
    return motion_jacobian(machine, at.axes_mm, at.tool_mm)


def _motion_covariance(weights: F2, covariance: F2, first: NDArray[np.intp]) -> F3:
    """Return the covariance of the g error motions with uncertain parameters, shape (n, g, g).

    Each parameter acts in one motion only, so each pair of motions needs only its block of the matrix; symmetry gives half of the pairs.

    Parameters
    ----------
    weights : array, shape (n, p)
        Derivative, with respect to each parameter, of the motion in which it acts; parameters of one motion are adjacent.
    covariance : array, shape (p, p)
        In the same order.
    first : array of int, shape (g,)
        Index of the first parameter of each motion.
    """
    g = first.size
    out: F3 = np.empty((weights.shape[0], g, g))
    for k, start in enumerate(first):
        end = int(first[k + 1]) if k + 1 < g else weights.shape[1]
        share = (weights[:, start:end] @ covariance[start:end, start:]) * weights[:, start:]
        out[:, k, k:] = np.add.reduceat(share, first[k:] - start, axis=1)
        out[:, k:, k] = out[:, k, k:]
    return out
