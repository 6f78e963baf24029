"""Analysis of printed response-surface coefficients: the plane on which they were fitted, their form on a plane, their sums on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.kwon.layout import CUBIC, IN_PLANE, Exponents, regressors, term_name

INDEX = {term: i for i, term in enumerate(CUBIC)}
LADDER: tuple[tuple[int, int], ...] = tuple((INDEX[(i, j, k + 1)], INDEX[(i, j, k)]) for i, j, k in CUBIC if (i, j, k + 1) in INDEX)
"""Pairs of coefficients whose quotient is Z in a minimum-norm solution on one plane: beta_3/beta_0, beta_5/beta_1, ..."""


@dataclass(frozen=True)
class ImpliedPlane:
    """Plane on which minimum-norm coefficients were fitted.

    Attributes
    ----------
    z_mm, mean_mm, sd_mm : float
        Median, mean and standard deviation of the quotients.
    ratios_mm : tuple of ((component, upper index, lower index), quotient)
        Quotients of the coefficient pairs in `LADDER`.
    """

    z_mm: float
    mean_mm: float
    sd_mm: float
    ratios_mm: tuple[tuple[tuple[int, int, int], float], ...]


@dataclass(frozen=True, slots=True)
class GridSums:
    """A surface on a square grid.

    Attributes
    ----------
    n : int
    largest : float
        Largest absolute value, unit of the surface.
    ss_mean, ss_zero : float
        Sum of squares about the mean and about zero.
    """

    n: int
    largest: float
    ss_mean: float
    ss_zero: float


def minimum_norm(in_plane: F1, z_mm: float) -> F1:
    """Return the 20 coefficients of smallest norm that equal an in-plane cubic on the plane Z = z, as a pseudo-inverse in (28) does.

    On one plane the columns of (27) are in-plane monomials times 1, z, z^2, z^3. So an in-plane coefficient is divided in the proportion
    z^k / sum z^2k, and neighbouring coefficients have the quotient z.

    Parameters
    ----------
    in_plane : array, shape (10,)
        Order of IN_PLANE.
    z_mm : float

    Returns
    -------
    array, shape (20,), order of CUBIC
    """
    beta = np.zeros(len(CUBIC))
    for value, (i, j, _) in zip(_sized(in_plane, len(IN_PLANE)), IN_PLANE, strict=True):
        rows = [INDEX[(i, j, k)] for k in range(4 - i - j)]
        powers = float(z_mm) ** np.arange(len(rows))
        beta[rows] = value * powers / (powers @ powers)
    return beta


def in_plane_coefficients(beta: F1, z_mm: float) -> F1:
    """Return the coefficients of the ten monomials of X, Y to which 20 coefficients reduce on the plane Z = z, in the order of IN_PLANE."""
    values = _sized(beta, len(CUBIC))
    return np.array([sum(values[INDEX[(i, j, k)]] * z_mm**k for k in range(4 - i - j)) for i, j, _ in IN_PLANE])


def implied_plane(beta: F2, leave_out: tuple[tuple[int, int], ...] = ()) -> ImpliedPlane:
    """Return the plane that the quotients of neighbouring coefficients imply.

    Parameters
    ----------
    beta : array, shape (20,) or (m, 20)
        One row per error component.
    leave_out : tuple of (component row, coefficient index)
        Damaged coefficients; every quotient with them is left out.

    Raises
    ------
    ValueError
        The shape is wrong, or no quotient is left.
    """
    rows = np.atleast_2d(np.asarray(beta, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != len(CUBIC):
        raise ValueError(f"implied plane: expected 20 coefficients per row, got shape {rows.shape}")
    bad = set(leave_out)
    pairs = [(c, up, low) for c in range(rows.shape[0]) for up, low in LADDER if (c, up) not in bad and (c, low) not in bad]
    ratios = tuple((pair, float(rows[pair[0], pair[1]] / rows[pair[0], pair[2]])) for pair in pairs if rows[pair[0], pair[2]] != 0.0)
    if not ratios:
        raise ValueError("implied plane: no coefficient is left to divide by")
    z = np.array([r for _, r in ratios])
    spread = float(z.std(ddof=1)) if z.size > 1 else 0.0
    return ImpliedPlane(float(np.median(z)), float(z.mean()), spread, ratios)


def square_grid(half_mm: float = 1.0, step_mm: float = 0.25, z_mm: float = 0.0) -> F2:
    """Return grid points of the square |x|, |y| <= half at one height, y fastest, shape (n, 3); the paper has +-1 mm, step 0.25 mm."""
    steps = round(2.0 * half_mm / step_mm)
    if steps < 1 or abs(steps * step_mm - 2.0 * half_mm) > 1e-9 * half_mm:
        raise ValueError(f"square grid: {step_mm:g} mm does not divide {2.0 * half_mm:g} mm")
    line = np.linspace(-half_mm, half_mm, steps + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, float(z_mm))])


def grid_sums(in_plane: F1, half_mm: float = 1.0, step_mm: float = 0.25) -> GridSums:
    """Return the largest value and the sums of squares of an in-plane cubic on a square grid, to compare with a printed ANOVA."""
    values = regressors(square_grid(half_mm, step_mm), IN_PLANE) @ _sized(in_plane, len(IN_PLANE))
    return GridSums(values.size, float(np.abs(values).max()), float(((values - values.mean()) ** 2).sum()), float((values**2).sum()))


def coefficients_from_planes(first: F1, z1_mm: float, second: F1, z2_mm: float, digits: int) -> F1:
    """Recover printed coefficients with few digits from their exact in-plane form on two planes.

    The method starts with the highest power of Z. The two planes determine its coefficient as if the lower powers were zero; the
    coefficient is rounded to the printed digits and subtracted. This works while lower powers contribute less than the rounding, as in a
    minimum-norm solution far from Z = 0. beta_0 falls below the rounding of float64, and only its order of magnitude is right.

    Parameters
    ----------
    first, second : arrays, shape (10,)
        In-plane coefficients at z1, z2 (order of IN_PLANE).
    digits : int
        Significant digits in print.

    Returns
    -------
    array, shape (20,)
    """
    a, b = _sized(first, len(IN_PLANE)), _sized(second, len(IN_PLANE))
    if z1_mm == z2_mm or z1_mm == 0.0 or z2_mm == 0.0:
        raise ValueError("coefficients from planes: the two planes must differ from each other and from Z = 0")
    beta = np.zeros(len(CUBIC))
    for (i, j, _), at1, at2 in zip(IN_PLANE, a, b, strict=True):
        left1, left2 = float(at1), float(at2)
        for k in range(3 - i - j, 0, -1):
            top = _rounded((left2 / z2_mm ** (k - 1) - left1 / z1_mm ** (k - 1)) / (z2_mm - z1_mm), digits)
            beta[INDEX[(i, j, k)]] = top
            left1, left2 = left1 - top * z1_mm**k, left2 - top * z2_mm**k
        beta[INDEX[(i, j, 0)]] = _rounded(left1, digits)
    return beta


def ladder_name(pair: tuple[int, int]) -> str:
    """Return the name of a quotient of LADDER: ``X Z / X``."""
    return f"{term_name(CUBIC[pair[0]])} / {term_name(CUBIC[pair[1]])}"


def in_plane_label(term: Exponents) -> str:
    """Return the short key of an in-plane monomial: ``X2Y1``."""
    return f"X{term[0]}Y{term[1]}"


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits - 1}e}")


def _sized(values: F1, size: int) -> F1:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"surface coefficients: expected {size} finite numbers, got shape {array.shape}")
    return array
