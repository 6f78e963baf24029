"""Analysis of variance of a fitted surface, with the degrees of freedom that the points really give (math.md 6, ANOVA)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1
from abbe.models.papers.kwon.errors import SurfaceNotDetermined

ROUNDING = 1000.0 * float(np.finfo(np.float64).eps)
"""Scatter below this share of the root mean square of the values is what the computation itself leaves (2e-13; 3e-11 mm of 150 mm)."""


@dataclass(frozen=True, slots=True)
class Anova:
    """Table 2 as it should be: regression and residual about the mean.

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
        """Mean square of the residual: the variance left."""
        return self.ss_res / self.df_res

    @property
    def residual_sd(self) -> float:
        """Standard deviation left, in the unit of the values."""
        return float(np.sqrt(self.ms_res))

    @property
    def undefined(self) -> str:
        """Why there is no F, in one line; empty where there is one."""
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
