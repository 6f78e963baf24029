"""Cubic response surface of one error component: fit, coefficients, analysis of variance, prediction with uncertainty.

Source: Kwon 2004 (26)-(28). The degrees of freedom follow from the points.
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
"""Scatter below this share of the rms of the values is rounding of the computation (2e-13, or 3e-11 mm for 150 mm)."""
MARGIN = 0.1
"""Default margin for predictions outside the measured range, as a share of the half width (0.1 mm for +-1 mm)."""


@dataclass(frozen=True, slots=True)
class Anova:
    """Analysis of variance about the mean, as in Table 2 with its errata corrected.

    Attributes
    ----------
    ss_reg, ss_res, ss_tot : float
        Sums of squares, unit of the values squared.
    df_reg, df_res : int
        rank - 1 and N - rank.
    f, p : float
        (ss_reg/df_reg) / (ss_res/df_res), and the probability of a larger F by chance. The paper wrongly calls F the ratio of residual to
        regression. Without residual, F is infinite and p 0; if the values do not vary, both are NaN (`undefined`).
    r2 : float
        ss_reg / (ss_reg + ss_res); 0 if the values do not vary.
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
        """Mean square (variance) of the residual."""
        return self.ss_res / self.df_res

    @property
    def residual_sd(self) -> float:
        """Standard deviation of the residual, in the unit of the values."""
        return float(np.sqrt(self.ms_res))

    @property
    def undefined(self) -> str:
        """Reason why F is undefined; empty if F is defined."""
        return "the values do not vary beyond rounding, so F is 0/0" if np.isnan(self.f) else ""

    def critical(self, alpha: float = 0.01) -> float:
        """Return the F that chance exceeds with probability alpha."""
        return critical_f(self.df_reg, self.df_res, alpha)

    def significant(self, alpha: float = 0.01) -> bool:
        """Return whether the regression explains more than chance at the level alpha; False if F is `undefined`."""
        return bool(self.p < alpha)


def anova(values: F1, fitted: F1, rank: int) -> Anova:
    """Return the analysis of variance of a least-squares fit that contains a constant.

    Sums below n (ROUNDING x rms of the values)^2 are rounding and count as zero.

    Parameters
    ----------
    values, fitted : arrays, shape (n,)
    rank : int
        Rank of the regressor matrix, the constant included.

    Raises
    ------
    SurfaceNotDetermined
        The rank is below 2 or leaves no residual degree of freedom.
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
    """Return the analysis of variance of given sums, e.g. printed ones; the total defaults to the sum of the other two.

    Raises
    ------
    SurfaceNotDetermined
        Degrees of freedom are below 1.
    ValueError
        A sum is negative or not finite.
    """
    if df_reg < 1 or df_res < 1:
        raise SurfaceNotDetermined(
            f"analysis of variance: {df_reg} degrees of freedom of the regression and {df_res} of the residual, both must be 1 or more"
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
    """Return F(df_reg, df_res, alpha), the value that chance exceeds with probability alpha."""
    if not 0.0 < alpha < 1.0 or df_reg < 1 or df_res < 1:
        raise ValueError(
            f"critical F: alpha must lie in (0, 1), got {alpha:g}; degrees of freedom must be 1 or more, got {df_reg} and {df_res}"
        )
    return float(scipy.special.fdtri(df_reg, df_res, 1.0 - alpha))


@dataclass(frozen=True)
class SurfacePrediction:
    """Prediction of a surface at points.

    Attributes
    ----------
    value, u_surface, u_reading : array, shape (n,)
        Value, its standard uncertainty, and the standard uncertainty of a new reading there, which includes the residual scatter.
    """

    value: F1
    u_surface: F1
    u_reading: F1


@dataclass(frozen=True)
class SphereSurface:
    """A fitted cubic response surface.

    Attributes
    ----------
    layout : Layout
        Planes of the points, rank and terms.
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
        """Coefficients of the raw monomials of X, Y, Z in mm, shape (p,); if the points lie on planes, valid on and between them only."""
        value: F1 = term_matrix(self.terms, self.shift_mm, self.scale_mm) @ self.scaled
        return value

    @property
    def u_coefficients(self) -> F1:
        """Standard uncertainty of `coefficients`, shape (p,)."""
        m = term_matrix(self.terms, self.shift_mm, self.scale_mm)
        return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", m, self.unscaled_cov, m) * self.anova.ms_res))

    def predict(self, points_mm: F2, margin: float = MARGIN) -> SurfacePrediction:
        """Return value and uncertainty at points.

        Parameters
        ----------
        points_mm : array, shape (n, 3)
        margin : float
            Allowed distance of X and Y outside the measured range, as a share of the range's half width (also of Z, if the planes face X or
            Y). There is no margin across the planes or in height, where nothing was measured.

        Raises
        ------
        ExtrapolationRefused
            A point lies off the measured plane, beyond the outer ones of several planes, above or below all measured heights, or beyond the
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
    """Fit a cubic surface by least squares, with the terms that the planes of the points allow.

    Points on one plane Z = a + bX + cY allow the ten monomials of X and Y: there the 20 coefficients of (27) have rank 10, and P'P of (28)
    has no inverse. Two or three parallel planes, also tilted or upright ones, allow 16 or 19 terms. Too few lines within a plane (X^3 on
    three columns) are refused.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    values : array, shape (n,)
        One error component.
    tolerance_mm : float, optional
        Largest distance of a point from its plane; default as in `layout`.

    Raises
    ------
    SurfaceNotDetermined
        There are not more points than terms, or the points do not determine a combination of terms (singular value below RANK_TOLERANCE
        times the largest); the error lists these terms.
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
