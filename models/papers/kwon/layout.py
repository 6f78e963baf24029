"""The 20 cubic monomials of the response surface in the order of Kwon's (27), and which of them a set of measured points determines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from abbe.models.arrays import F1, F2
from abbe.models.papers.kwon.kinematics import poses

Exponents = tuple[int, int, int]
CUBIC: tuple[Exponents, ...] = (
    *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
    *((1, 1, 1), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 0, 2), (0, 2, 1), (0, 1, 2), (3, 0, 0), (0, 3, 0), (0, 0, 3)),
)
"""Exponents of X, Y, Z for beta_0 .. beta_19. Erratum: beta_16 belongs to Y Z^2, but the paper prints Z Y^2 twice."""

IN_PLANE: tuple[Exponents, ...] = tuple(
    (i, j, 0) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (3, 0), (0, 3))
)
"""The ten monomials of X and Y."""
MOST_PLANES = 3
"""Largest number of planes to look for: four planes determine a full cubic, fewer do not."""
NO_SLOPE = 1e-12
"""Slopes up to this size are rounding and count as zero."""
STEEPEST = 1.0 + 1e-9
"""A plane faces a coordinate if its slopes over the other two coordinates are at most this; every plane faces at least one coordinate."""
RANK_TOLERANCE = 1e-3
"""Singular values below this share of the largest are taken as zero: a coefficient would be a thousand times less certain than a
reading."""
FLATNESS = 5e-3
"""Default tolerance of a plane, as a share of the second largest half width of X, Y, Z: 5 um for a square of +-1 mm. A stage with errors of
1 um leaves its plane, but so little height gives no information: an error of 10 um per mm of height changes by 0.05 um over it."""


def term_name(term: Exponents) -> str:
    """Return a monomial in usual notation: ``1``, ``X``, ``X Y^2``."""
    parts = [f"{letter}^{k}" if k > 1 else letter for letter, k in zip("XYZ", term, strict=True) if k]
    return " ".join(parts) or "1"


def regressors(points_mm: F2, terms: tuple[Exponents, ...]) -> F2:
    """Return the values of monomials at points: the matrix P_e in (28), for which the paper prints only [X, Y, Z].

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    terms : tuple of (i, j, k)

    Returns
    -------
    array, shape (n, len(terms))
    """
    exponents = np.asarray(terms, dtype=np.int64).reshape(-1, 3)
    powers = np.asarray(points_mm, dtype=np.float64)[:, None, :] ** np.arange(4)[:, None]
    x, y, z = (powers[:, exponents[:, axis], axis] for axis in range(3))
    values: F2 = x * y * z
    return values


def term_matrix(terms: tuple[Exponents, ...], shift_mm: F1, scale_mm: F1) -> F2:
    """Return the matrix M from coefficients of centred and scaled monomials to those of raw ones.

    With u = (x - shift) / scale, sum c_t u^t equals sum (M c)_s x^s over the same terms. The set of terms must contain every divisor of
    each term, as CUBIC, IN_PLANE and CUBIC up to a power of Z do.

    Parameters
    ----------
    terms : tuple of (i, j, k)
    shift_mm, scale_mm : arrays, shape (3,)

    Returns
    -------
    array, shape (len(terms), len(terms))
    """
    row = {t: r for r, t in enumerate(terms)}
    out = np.zeros((len(terms), len(terms)))
    for column, term in enumerate(terms):
        x, y, z = (polynomial.polypow([-c / s, 1.0 / s], k) for k, c, s in zip(term, shift_mm, scale_mm, strict=True))
        for i, j, k in np.ndindex(x.size, y.size, z.size):
            out[row[(i, j, k)], column] += x[i] * y[j] * z[k]
    return out


# Grids of commands lie on one plane, or on two or three parallel ones: horizontal, tilted or upright.


@dataclass(frozen=True)
class Planes:
    """Parallel planes.

    Attributes
    ----------
    axis : int
        Coordinate that the planes face: 2 for Z, 1 for Y, 0 for X.
    slope : array, shape (3,)
        Slope of the planes over the other two coordinates; 0 for the axis itself.
    levels_mm : tuple of float
        Offset (coordinate - slope . point) of each plane, rising, 1 to 3 of them.
    """

    axis: int
    slope: F1
    levels_mm: tuple[float, ...]

    def offset_mm(self, points_mm: F2) -> F1:
        """Return coordinate - slope . point, shape (n,); for points on a plane it is the level of the plane."""
        result: F1 = points_mm[:, self.axis] - points_mm @ self.slope
        return result

    def snapped(self, points_mm: F2) -> F2:
        """Return the points moved along the axis onto the nearest plane, shape (n, 3)."""
        levels = np.asarray(self.levels_mm)
        nearest = levels[np.abs(self.offset_mm(points_mm)[:, None] - levels).argmin(axis=1)]
        moved = points_mm.copy()
        moved[:, self.axis] = nearest + points_mm @ self.slope
        return moved

    @property
    def terms(self) -> tuple[Exponents, ...]:
        """Monomials that the planes can separate: powers of the axis below the number of planes."""
        return tuple(t for t in CUBIC if t[self.axis] < len(self.levels_mm))

    @property
    def tilt_text(self) -> str:
        """Slope of the planes as text, e.g. for `Layout.plane_text`; empty for planes perpendicular to the axis."""
        return "".join(f" {s:+.4g} {letter}" for s, letter in zip(self.slope, "XYZ", strict=True) if s)


def parallel_planes(points_mm: F2, tolerance_mm: float) -> Planes | None:
    """Return the fewest parallel planes (at most 3) on which the points lie, or None.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    tolerance_mm : float
        Largest distance of a point from its plane along the axis. The gap between neighbouring planes must be more than twice that.
    """
    for count in range(1, MOST_PLANES + 1):
        for axis in (2, 1, 0):
            for slope in (np.zeros(3), _common_slope(points_mm, axis, count)):
                levels = _levels((points_mm[:, axis] - points_mm @ slope), tolerance_mm, count)
                if levels and np.abs(slope).max() <= STEEPEST:
                    return Planes(axis, slope, levels)
    return None


def _common_slope(points_mm: F2, axis: int, count: int) -> F1:
    """Return the slope s of ``count`` parallel planes c = s.p + w_k, c being the coordinate of the axis.

    On the planes the product of (c - s.p - w_k) over k vanishes. So c^count is a combination of monomials with lower powers of c, in which
    (other coordinate) c^(count - 1) has the coefficient count x slope.
    """
    middle = points_mm.mean(axis=0)
    size = float(np.abs(points_mm - middle).max()) or 1.0
    top = _monomial({axis: count})
    lower = tuple(t for t in CUBIC if sum(t) <= count and t[axis] < count)
    x = regressors((points_mm - middle) / size, (*lower, top))
    found = np.linalg.lstsq(x[:, :-1], x[:, -1], rcond=1e-9)[0]
    slope = np.zeros(3)
    for other in {0, 1, 2} - {axis}:
        slope[other] = found[lower.index(_monomial({axis: count - 1, other: 1}))] / count
    return np.where(np.abs(slope) > NO_SLOPE, slope, 0.0)


def _monomial(powers: dict[int, int]) -> Exponents:
    return powers.get(0, 0), powers.get(1, 0), powers.get(2, 0)


def _levels(offset_mm: F1, tolerance_mm: float, count: int) -> tuple[float, ...]:
    """Return the middles of ``count`` groups no wider than twice the tolerance, with wider gaps between; empty if there are none."""
    values = np.sort(offset_mm)
    groups = np.split(values, np.flatnonzero(np.diff(values) > 2.0 * tolerance_mm) + 1)
    if len(groups) != count or any(g[-1] - g[0] > 2.0 * tolerance_mm for g in groups):
        return ()
    return tuple(float(g[0] if g[0] == g[-1] else 0.5 * (g[0] + g[-1])) for g in groups)


@dataclass(frozen=True)
class Layout:
    """Arrangement of points, and the terms that can be fitted to them.

    Attributes
    ----------
    n : int
        Number of points.
    rank : int
        Rank of the 20 cubic monomials on centred and scaled coordinates: 10 on one plane, 16 on two, 19 on three, 20 on four.
    planes : Planes or None
        The one, two or three parallel planes on which all points lie, if any.
    low_mm, high_mm : array, shape (3,)
        Range of X, Y, Z.
    terms : tuple of (i, j, k)
        Monomials to fit. On h parallel planes: those whose power of the coordinate normal to the planes is below h (one plane normal to Z:
        the ten in X, Y). Otherwise all 20, which points on other surfaces (crossing planes, a sphere) do not determine.
    tolerance_mm : float
        Largest distance of a point from its plane.
    """

    n: int
    rank: int
    planes: Planes | None
    low_mm: F1
    high_mm: F1
    terms: tuple[Exponents, ...]
    tolerance_mm: float

    @property
    def plane_mm(self) -> F1 | None:
        """Coefficients a (mm), b, c of the plane Z = a + b X + c Y on which all points lie, shape (3,).

        None if they lie on no plane, on several, or on one that faces X or Y (`Planes.axis`).
        """
        at = self.planes
        return np.array([at.levels_mm[0], *at.slope[:2]]) if at and at.axis == 2 and len(at.levels_mm) == 1 else None

    @property
    def heights_mm(self) -> tuple[float, ...]:
        """The Z of the horizontal planes on which all points lie; empty without such planes."""
        return self.planes.levels_mm if self.planes and self.planes.axis == 2 and not self.planes.slope.any() else ()

    @property
    def z_range_mm(self) -> tuple[float, float]:
        """Lowest and highest Z."""
        return float(self.low_mm[2]), float(self.high_mm[2])

    @property
    def plane_text(self) -> str:
        """Statement of the region of the points; for one plane also of the unknown coefficients."""
        at = self.planes
        if at is None:
            return f"points between Z = {self.low_mm[2]:.6g} and {self.high_mm[2]:.6g} mm"
        name, levels = "XYZ"[at.axis], at.levels_mm
        if len(levels) > 1:
            return f"points between {name} = {levels[0]:.6g} and {levels[-1]:.6g}{at.tilt_text} mm, on {len(levels)} planes"
        other = "heights" if at.axis == 2 else f"{name}"
        return f"all points on the plane {name} = {levels[0]:.6g}{at.tilt_text} mm: nothing is known about other {other}"


def layout(points_mm: F2, tolerance_mm: float | None = None) -> Layout:
    """Analyse the arrangement of points, and the terms that can be fitted to them.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Commanded positions at which the errors were measured.
    tolerance_mm : float, optional
        Largest distance of a point from its plane along the axis; default: FLATNESS times the second largest half width.

    Raises
    ------
    ValueError
        There is no point, a coordinate is not finite, or the tolerance is negative.
    """
    p = poses("points_mm", points_mm)
    if p.shape[0] == 0:
        raise ValueError("layout: there is no point")
    if tolerance_mm is not None and not 0.0 <= tolerance_mm < np.inf:
        raise ValueError(f"layout: the tolerance of a plane must not be negative, got {tolerance_mm:g} mm")
    low, high = p.min(axis=0), p.max(axis=0)
    tolerance = FLATNESS * _middle(0.5 * (high - low)) if tolerance_mm is None else float(tolerance_mm)
    planes = parallel_planes(p, tolerance)
    rank = rank_of(p if planes is None else planes.snapped(p))
    return Layout(p.shape[0], rank, planes, low, high, CUBIC if planes is None else planes.terms, tolerance)


def rank_of(points_mm: F2, terms: tuple[Exponents, ...] = CUBIC) -> int:
    """Return the rank of monomials at points, on centred and scaled coordinates with RANK_TOLERANCE."""
    shift, scale = centring(points_mm)
    s = np.linalg.svd(regressors((points_mm - shift) / scale, terms), compute_uv=False)
    return int((s > RANK_TOLERANCE * s[0]).sum())


def centring(points_mm: F2) -> tuple[F1, F1]:
    """Return the middle and the scale of the points along X, Y, Z, shape (3,) each.

    The scale is the half width, but at least FLATNESS times the second largest half width, so that a tiny width is not magnified.
    """
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    half = 0.5 * (high - low)
    scale = np.maximum(half, FLATNESS * _middle(half))
    return 0.5 * (low + high), np.where(scale > 0.0, scale, 1.0)


def _middle(half_mm: F1) -> float:
    return float(np.sort(half_mm)[1])
