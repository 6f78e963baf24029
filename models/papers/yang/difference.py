"""How far two volumetric models differ over the working volume, with the confidence interval of the mean (Yang and Kim 2.2, Table 1).

The paper draws 100 random points, takes mean and standard deviation, and repeats that 100 times; its interval is x ± t s / sqrt(N), N =
10 000. The text says Student's t, the printed figures are those of the normal law's 1.96 (math.md 8): both are here, by name. The mean of
standard deviations is too small (by 20 % for repeats of two points): "student" pools variances, "normal" averages as the paper does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.probability import t_quantile

Model = Callable[[F2], F2]
"""Positions (n, 3), mm, to errors (n, 3), mm."""
Law = Literal["student", "normal"]
PRINTED_NORMAL = 1.96
"""Factor behind the printed intervals of Table 1."""


@dataclass(frozen=True)
class RadiusDifference:
    """Mean and standard deviation of the difference per axis, shape (3,), mm, and the interval of the mean, shape (3, 2), mm."""

    mean_mm: F1
    sd_mm: F1
    interval_mm: F2
    samples: int


def confidence_interval(
    mean: F1, sd: F1, n: int, *, law: Law = "student", level: float = 0.95, degrees_of_freedom: int | None = None
) -> F2:
    """Two-sided interval of the mean of ``n`` samples, shape (..., 2), unit of ``mean``.

    Parameters
    ----------
    mean, sd : array, shape (...)
        Sample mean and standard deviation, 0 or more.
    n : int
        Samples behind the mean.
    law : "student" | "normal"
        ``student``: t with n - 1 (or ``degrees_of_freedom``), as the paper says. ``normal``: the factor 1.96 of its figures.
    level : float
        Confidence level; the printed 1.96 exists for 0.95 only.
    degrees_of_freedom : int, optional
        Of ``sd``, where it was pooled over several means.

    Raises
    ------
    ValueError
        n no number of 2 or more, level outside (0, 1), sd negative or not finite, no degree of freedom, unknown law, or "normal" with
        another level than 0.95.
    """
    if not 2 <= n < np.inf or not 0.0 < level < 1.0:
        raise ValueError(f"confidence interval: n = {n} must be 2 or more and the level {level} between 0 and 1")
    if not (np.isfinite(sd) & (np.asarray(sd) >= 0.0)).all():
        raise ValueError("confidence interval: standard deviations must be finite and not negative")
    free = n - 1 if degrees_of_freedom is None else degrees_of_freedom
    if not free >= 1:
        raise ValueError(f"confidence interval: {free} degrees of freedom, 1 or more are needed")
    if law == "normal":
        if level != 0.95:
            raise ValueError("confidence interval: the printed factor 1.96 holds for a level of 0.95 only")
        factor = PRINTED_NORMAL
    elif law == "student":
        factor = float(t_quantile(0.5 + 0.5 * level, free))
    else:
        raise ValueError(f"confidence interval: law {law!r} must be 'student' or 'normal'")
    half = factor * np.asarray(sd, dtype=np.float64) / np.sqrt(n)
    return np.stack([mean - half, mean + half], axis=-1)


def model_difference(
    complete: Model, simplified: Model, stroke_mm: F2, *, seed: int, points: int = 100, repeats: int = 100, law: Law = "student"
) -> RadiusDifference:
    """Mean difference of two models over random points of the volume, by the paper's procedure 1) to 4).

    Parameters
    ----------
    complete, simplified : callable
        Positions (n, 3) to errors (n, 3); the difference is complete - simplified, eq (3).
    stroke_mm : array, shape (3, 2)
        Volume in which the points are drawn, uniformly.
    seed : int
        Seed of the sampler.
    points, repeats : int
        Points per repeat; number of repeats.
    law : "student" | "normal"
        ``student`` (default): standard deviation from the mean of the repeats' variances, t with repeats (points - 1) degrees of freedom.
        ``normal``: the paper's own way, the mean of the repeats' standard deviations and 1.96; its intervals are too short, noticeably so
        where a repeat has few points.

    Raises
    ------
    ValueError
        Fewer than two points, no repeat, or as `confidence_interval`.
    """
    if points < 2 or repeats < 1:
        raise ValueError(f"model difference: {points} points in {repeats} repeats are too few")
    rng = np.random.default_rng(seed)
    low, high = np.asarray(stroke_mm, dtype=np.float64).T
    samples_mm = rng.uniform(low, high, size=(repeats * points, 3))
    off = (complete(samples_mm) - simplified(samples_mm)).reshape(repeats, points, 3)
    mean: F1 = off.mean(axis=(0, 1))
    variance = off.var(axis=1, ddof=1)
    sd: F1 = np.sqrt(variance).mean(axis=0) if law == "normal" else np.sqrt(variance.mean(axis=0))
    interval = confidence_interval(mean, sd, points * repeats, law=law, degrees_of_freedom=repeats * (points - 1))
    return RadiusDifference(mean, sd, interval, points * repeats)
