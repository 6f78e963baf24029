"""Scatter: residuals of a surface against the repeatability of the machine (Kwon 2004, 4.2, Figs 13 and 14)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3

COVERAGE = 2.0
"""The paper states repeatability as 2 standard deviations."""


@dataclass(frozen=True)
class Repeatability:
    """Scatter of repeated cycles.

    Attributes
    ----------
    sd_mm : array, shape (positions, 3)
        Standard deviation (n - 1) at every position, X, Y, Z.
    largest_2sd_mm : array, shape (3,)
        Two standard deviations at the worst position: the paper's "+-2 S at most".
    pooled_sd_mm : array, shape (3,)
        Root mean variance over the positions.
    dof : int
        Degrees of freedom of ``pooled_sd_mm``: positions x (cycles - 1).
    """

    sd_mm: F2
    largest_2sd_mm: F1
    pooled_sd_mm: F1
    dof: int


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Residuals of one component beside the repeatability.

    Attributes
    ----------
    sd_mm, largest_mm : float
        Standard deviation with the residual degrees of freedom; largest absolute residual.
    ratio : float
        Residual variance over repeatability variance.
    p : float
        Probability of a larger ratio if the surface lacked nothing: small means that scatter alone does not explain the residuals.
    """

    sd_mm: float
    largest_mm: float
    ratio: float
    p: float


def repeatability(readings_mm: F3) -> Repeatability:
    """Scatter of repeated visits.

    Parameters
    ----------
    readings_mm : array, shape (cycles, positions, 3)
        Measured positions, the same commands in every cycle; the paper made 6 cycles.

    Raises
    ------
    ValueError
        Fewer than 2 cycles, another shape, or a value that is not finite.
    """
    r = np.asarray(readings_mm, dtype=np.float64)
    if r.ndim != 3 or r.shape[0] < 2 or r.shape[1] < 1 or r.shape[2] != 3 or not np.isfinite(r).all():
        raise ValueError(f"repeatability: expected finite readings of shape (2 or more cycles, positions, 3), got {r.shape}")
    variance = r.var(axis=0, ddof=1)
    sd = np.sqrt(variance)
    return Repeatability(sd, COVERAGE * sd.max(axis=0), np.sqrt(variance.mean(axis=0)), r.shape[1] * (r.shape[0] - 1))


def residual_statistics(residual_mm: F1, df_res: int, repeat_sd_mm: float, repeat_dof: int) -> ResidualStatistics:
    """Whether the residuals of a surface are more than repeatability (test of lack of fit for single readings).

    Parameters
    ----------
    residual_mm : array, shape (n,)
    df_res : int
        N - rank of the surface.
    repeat_sd_mm, repeat_dof
        Pooled standard deviation of the same component and its degrees of freedom.

    Raises
    ------
    ValueError
        A number of degrees of freedom is below 1, the repeatability is not positive and finite, or the residuals are none or not finite.
    """
    if df_res < 1 or repeat_dof < 1 or not 0.0 < repeat_sd_mm < np.inf:
        raise ValueError("residual figures: degrees of freedom must be 1 or more and the repeatability positive and finite")
    residual = np.asarray(residual_mm, dtype=np.float64)
    if residual.ndim != 1 or residual.size == 0 or not np.isfinite(residual).all():
        raise ValueError(f"residual figures: expected finite residuals of shape (n,), got shape {residual.shape} or a value not finite")
    variance = float((residual**2).sum()) / df_res
    ratio = variance / repeat_sd_mm**2
    return ResidualStatistics(
        float(np.sqrt(variance)), float(np.abs(residual).max()), ratio, float(scipy.special.fdtrc(df_res, repeat_dof, ratio))
    )
