"""Cubic response surface of one error component: fit, coefficients, analysis of variance, prediction with uncertainty.

Source: Kwon 2004 (26)-(28), math.md 6. The degrees of freedom follow from the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.papers.kwon.errors import ExtrapolationRefused, SurfaceNotDetermined
from abbe.models.papers.kwon.kinematics import poses
from abbe.models.papers.kwon.layout import RANK_TOLERANCE, Exponents, Layout, centring, layout, regressors, term_matrix, term_name
from abbe.models.solvers.least_squares import analyse

ROUNDING = 1000.0 * float(np.finfo(np.float64).eps)
"""Scatter below this share of the root mean square of the values is what the computation itself leaves (2e-13; 3e-11 mm of 150 mm)."""
MARGIN = 0.1
"""How far outside the measured range a surface may be asked for by default, as a share of the half width (of +-1 mm: 0.1 mm)."""


@dataclass(frozen=True, slots=True)
class Anova:
    """Table 2 corrected: regression and residual about the mean.

    Attributes
    ----------
    ss_reg, ss_res, ss_tot : float
        Sums of squares, unit of the values squared.
    df_reg, df_res : int
        rank - 1 and N - rank.
    f, p : float
        (SSR/df_reg) / (SSE/df_res) and the probability of a larger F by chance. The paper calls F the ratio of residual to regression:
        it is the other way round. Infinite and 0 for no residual at all; both NaN where the values do not vary (`undefined`).
    r2 : float
        SSR / (SSR + SSE); 0 where the values do not vary.
    """

    ss_reg: float
    ss_res: float
    ss_tot: float
    df_reg: int
    df_res: int
    f: float
    p: float
    r2: float

    @property
    def ms_reg(self) -> float:
        """Mean square of the regression."""
        return self.ss_reg / self.df_reg

    @property
    def ms_res(self) -> float:
        """Mean square of the residual: the remaining variance."""
        return self.ss_res / self.df_res

    @property
    def residual_sd(self) -> float:
        """Remaining standard deviation, in the unit of the values."""
        return float(np.sqrt(self.ms_res))

    @property
    def undefined(self) -> str:
        """Reason why there is no F, in one line; empty if there is one."""
        return "the values do not vary beyond rounding: there is nothing to explain, F is 0/0" if np.isnan(self.f) else ""

    def critical(self, alpha: float = 0.01) -> float:
        """F that chance exceeds with probability alpha."""
        return critical_f(self.df_reg, self.df_res, alpha)

    def significant(self, alpha: float = 0.01) -> bool:
        """Whether the regression explains more than chance would, at the level alpha; never where F is `undefined`."""
        return bool(self.p < alpha)


def anova(values: F1, fitted: F1, rank: int) -> Anova:
    """Analysis of variance of a least-squares fit that contains a constant.

    Sums that rounding alone could make, below n (ROUNDING x root mean square of the values)^2, are zero.

    Parameters
    ----------
    values, fitted : arrays, shape (n,)
    rank : int
        Rank of the regressor matrix, the constant included.

    Raises
    ------
    SurfaceNotDetermined
        rank is below 2 or leaves no residual degree of freedom.
    ValueError
        Shapes differ or a value is not finite.
    """
    y, fit = np.asarray(values, dtype=np.float64), np.asarray(fitted, dtype=np.float64)
    if y.ndim != 1 or y.shape != fit.shape:
        raise ValueError(f"analysis of variance: values {y.shape} and fitted values {fit.shape} do not fit together")
    if not (np.isfinite(y).all() and np.isfinite(fit).all()):
        raise ValueError("analysis of variance: values and fitted values must be finite")
    mean = y.mean() if y.size else 0.0
    noise = ROUNDING**2 * float((y**2).sum())
    sums = (float((v**2).sum()) for v in (fit - mean, y - fit, y - mean))
    ss_reg, ss_res, total = (s if s > noise else 0.0 for s in sums)
    return anova_from_sums(ss_reg, ss_res, rank - 1, y.size - rank, total)


def anova_from_sums(ss_reg: float, ss_res: float, df_reg: int, df_res: int, ss_tot: float | None = None) -> Anova:
    """Analysis of variance from given sums, e.g. printed ones; the total is their sum when it is not given.

    Raises
    ------
    SurfaceNotDetermined
        A number of degrees of freedom is below 1.
    ValueError
        A sum is negative or not finite.
    """
    if df_reg < 1 or df_res < 1:
        raise SurfaceNotDetermined(
            f"analysis of variance: {df_reg} regression and {df_res} residual degrees of freedom, both must be 1 or more"
        )
    if not (np.isfinite([ss_reg, ss_res]).all() and ss_reg >= 0.0 and ss_res >= 0.0):
        raise ValueError("analysis of variance: sums of squares must be finite and not negative")
    both = ss_reg + ss_res
    if both == 0.0:
        return Anova(0.0, 0.0, ss_tot or 0.0, df_reg, df_res, float("nan"), float("nan"), 0.0)
    f = (ss_reg / df_reg) / (ss_res / df_res) if ss_res > 0.0 else float("inf")
    p = float(scipy.special.fdtrc(df_reg, df_res, f)) if np.isfinite(f) else 0.0
    return Anova(ss_reg, ss_res, both if ss_tot is None else ss_tot, df_reg, df_res, f, p, ss_reg / both)


def critical_f(df_reg: int, df_res: int, alpha: float = 0.01) -> float:
    """F(df_reg, df_res, alpha): the value that chance exceeds with probability alpha."""
    if not 0.0 < alpha < 1.0 or df_reg < 1 or df_res < 1:
        raise ValueError(f"critical F: alpha {alpha:g} must lie in (0, 1) and {df_reg}, {df_res} degrees of freedom be 1 or more")
    return float(scipy.special.fdtri(df_reg, df_res, 1.0 - alpha))


@dataclass(frozen=True)
class SurfacePrediction:
    """Surface at some points.

    Attributes
    ----------
    value, u_surface, u_reading : array, shape (n,)
        Value; its standard uncertainty; standard uncertainty of one new reading there (surface and residual scatter together).
    """

    value: F1
    u_surface: F1
    u_reading: F1


@dataclass(frozen=True)
class SphereSurface:
    """A fitted surface.

    Attributes
    ----------
    layout : Layout
        Where the points lie: plane, rank, terms.
    shift_mm, scale_mm : array, shape (3,)
        Centre and half width used for the fit.
    scaled : array, shape (p,)
        Coefficients of the centred and scaled monomials.
    unscaled_cov : array, shape (p, p)
        (X'X)^-1 of the centred and scaled monomials; times ``anova.ms_res`` it is the covariance of ``scaled``.
    residual : array, shape (n,)
        Value minus surface.
    anova : Anova
    """

    layout: Layout
    shift_mm: F1
    scale_mm: F1
    scaled: F1
    unscaled_cov: F2
    residual: F1
    anova: Anova

    @property
    def terms(self) -> tuple[Exponents, ...]:
        """Exponents of X, Y, Z, in the order of `coefficients`."""
        return self.layout.terms

    @property
    def coefficients(self) -> F1:
        """Coefficients of the raw monomials of X, Y, Z in mm, shape (p,). On planes they hold on and between those planes only."""
        value: F1 = term_matrix(self.terms, self.shift_mm, self.scale_mm) @ self.scaled
        return value

    @property
    def u_coefficients(self) -> F1:
        """Standard uncertainty of `coefficients`, shape (p,)."""
        m = term_matrix(self.terms, self.shift_mm, self.scale_mm)
        return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", m, self.unscaled_cov, m) * self.anova.ms_res))

    def predict(self, points_mm: F2, margin: float = MARGIN) -> SurfacePrediction:
        """Value and uncertainty at points.

        Parameters
        ----------
        points_mm : array, shape (n, 3)
        margin : float
            How far X and Y (Z too, where the planes face X or Y) may lie outside the measured range, as a share of its half width. There
            is not a margin across the planes or in height: nothing was measured there.

        Raises
        ------
        ExtrapolationRefused
            A point lies off the measured plane, beyond the outer ones of several, above or below all measured heights, or beyond the
            margin.
        ValueError
            The margin is negative.
        """
        p = poses("points_mm", points_mm)
        self._refuse_beyond(p, margin)
        x = regressors((p - self.shift_mm) / self.scale_mm, self.terms)
        share = np.einsum("ni,ij,nj->n", x, self.unscaled_cov, x)
        variance = self.anova.ms_res
        return SurfacePrediction(x @ self.scaled, np.sqrt(share * variance), np.sqrt((1.0 + share) * variance))

    def _refuse_beyond(self, p: F2, margin: float) -> None:
        if not 0.0 <= margin < np.inf:
            raise ValueError(f"surface: the margin must not be negative, got {margin:g}")
        at, planes = self.layout, self.layout.planes
        axis = 2 if planes is None else planes.axis
        levels = (at.low_mm[2], at.high_mm[2]) if planes is None else (planes.levels_mm[0], planes.levels_mm[-1])
        offset = p[:, 2] if planes is None else planes.offset_mm(p)
        bad = np.flatnonzero(np.maximum(levels[0] - offset, offset - levels[1]) > at.tolerance_mm)
        if bad.size:
            raise ExtrapolationRefused(
                f"point row {bad[0]}{_more(bad)}: {'XYZ'[axis]} = {p[bad[0], axis]:.6g} mm was not measured; {at.plane_text}"
            )
        reach = 0.5 * margin * (at.high_mm - at.low_mm) + at.tolerance_mm
        outside = (p < at.low_mm - reach) | (p > at.high_mm + reach)
        outside[:, axis] = False
        bad = np.flatnonzero(outside.any(axis=1))
        if bad.size:
            k = int(outside[bad[0]].argmax())
            measured = f"measured from {at.low_mm[k]:.6g} to {at.high_mm[k]:.6g} mm"
            raise ExtrapolationRefused(
                f"point row {bad[0]}{_more(bad)}: {'XYZ'[k]} = {p[bad[0], k]:.6g} mm was not measured; {measured}, margin {margin:g}"
            )


def fit_surface(points_mm: F2, values: F1, tolerance_mm: float | None = None) -> SphereSurface:
    """Least-squares cubic surface with the terms that the points can carry.

    Points on one plane Z = a + bX + cY give the ten monomials of X and Y and the plane is reported; 20 coefficients of (27) have only
    rank 10 there and P'P of (28) has no inverse (math.md 3, K (28)). Two or three parallel planes, tilted or upright ones too, give 16 or
    19 terms; the planes alone decide that. Too few lines within a plane (X^3 on three columns) are refused, not fitted with fewer terms.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    values : array, shape (n,)
        One error component.
    tolerance_mm : float, optional
        How far a point may be off a plane and still lie on it; default as in `layout`: 1/200 of the second largest half width.

    Raises
    ------
    SurfaceNotDetermined
        There are not more points than terms, or the points do not determine a combination of terms (its singular value is below
        ``RANK_TOLERANCE`` times the largest one); the error lists the terms that cannot be separated.
    ValueError
        Shapes differ or a value is not finite.
    """
    p, y = poses("points_mm", points_mm), np.asarray(values, dtype=np.float64)
    if y.shape != (p.shape[0],) or not np.isfinite(y).all():
        raise ValueError(f"surface: {p.shape[0]} points need as many finite values, got shape {y.shape}")
    point_layout = layout(p, tolerance_mm)
    shift, scale = centring(p)
    x = regressors((p - shift) / scale, point_layout.terms)
    u, s, vt = np.linalg.svd(x, full_matrices=False)
    if y.size <= len(point_layout.terms) or int((s > RANK_TOLERANCE * s[0]).sum()) < len(point_layout.terms):
        raise SurfaceNotDetermined(_why(x, point_layout))
    scaled = vt.T @ ((u.T @ y) / s)
    fitted = x @ scaled
    return SphereSurface(point_layout, shift, scale, scaled, (vt.T / s**2) @ vt, y - fitted, anova(y, fitted, len(point_layout.terms)))


def _more(bad: NDArray[np.intp]) -> str:
    return f" and {bad.size - 1} more" if bad.size > 1 else ""


def _why(x: F2, point_layout: Layout) -> str:
    head = f"surface: {point_layout.n} points for {len(point_layout.terms)} terms"
    if point_layout.n <= len(point_layout.terms):
        return f"{head}, there must be more points than terms"
    hidden = analyse(tuple(term_name(t) for t in point_layout.terms), x, tolerance=RANK_TOLERANCE).hidden
    return (
        f"{head}, but {hidden[0].text} ({point_layout.plane_text})"
        if hidden
        else f"{head} hardly determine them ({point_layout.plane_text})"
    )
