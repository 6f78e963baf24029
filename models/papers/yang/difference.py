"""Difference of two volumetric models over the working volume, with the confidence interval of the mean (Yang and Kim 2.2, Table 1).

The paper draws 100 random points, takes mean and standard deviation, and repeats this 100 times; its interval is x ± t s / sqrt(N) with
N = 10 000. The text names Student's t, but the figures result from 1.96 of the normal distribution; both are available by name. A mean of
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
"""Maps positions (n, 3), mm, to errors (n, 3), mm."""
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
    """Return the two-sided confidence interval of the mean of ``n`` samples, shape (..., 2), unit of ``mean``.

    Parameters
    ----------
    mean, sd : array, shape (...)
        Sample mean and standard deviation, 0 or more.
    n : int
        Number of samples.
    law : "student" | "normal"
        ``student``: t with ``degrees_of_freedom``, as in the paper's text. ``normal``: the factor 1.96 of its figures.
    level : float
        Confidence level; with "normal" only 0.95.
    degrees_of_freedom : int, optional
        Degrees of freedom of ``sd``; default n - 1.

    Raises
    ------
    ValueError
        n is below 2 or infinite, the level is outside (0, 1), an sd is negative or not finite, the degrees of freedom are 0, the law is
        unknown, or the level with "normal" is not 0.95.
    """
    if not 2 <= n < np.inf or not 0.0 < level < 1.0:
        raise ValueError(f"confidence interval: n = {n} must be 2 or more and the level {level} between 0 and 1")
    if not (np.isfinite(sd) & (np.asarray(sd) >= 0.0)).all():
        raise ValueError("confidence interval: standard deviations must be finite and not negative")
    free = n - 1 if degrees_of_freedom is None else degrees_of_freedom
    if not free >= 1:
        raise ValueError(f"confidence interval: {free} degrees of freedom given, 1 or more needed")
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
    """Return the mean difference of two models over random points of the volume, by the paper's procedure 1) to 4).

    Parameters
    ----------
    complete, simplified : callable
        The two models; the difference is complete - simplified, (3).
    stroke_mm : array, shape (3, 2)
        Volume in which the points are drawn, uniformly.
    seed : int
        Seed of the sampler.
    points, repeats : int
        Points per repeat; number of repeats.
    law : "student" | "normal"
        ``student``: standard deviation from the mean variance of the repeats, t with repeats (points - 1) degrees of freedom. ``normal``:
        as in the paper, the mean standard deviation of the repeats and 1.96; the intervals are too short if a repeat has few points.

    Raises
    ------
    ValueError
        Fewer than two points, no repeat, or as `confidence_interval`.
    """
    if points < 2 or repeats < 1:
        raise ValueError(f"model difference: {points} points in {repeats} repeats given, at least 2 points and 1 repeat needed")
    rng = np.random.default_rng(seed)
    low, high = np.asarray(stroke_mm, dtype=np.float64).T
    samples_mm = rng.uniform(low, high, size=(repeats * points, 3))
    off = (complete(samples_mm) - simplified(samples_mm)).reshape(repeats, points, 3)
    mean: F1 = off.mean(axis=(0, 1))
    variance = off.var(axis=1, ddof=1)
    sd: F1 = np.sqrt(variance).mean(axis=0) if law == "normal" else np.sqrt(variance.mean(axis=0))
    interval = confidence_interval(mean, sd, points * repeats, law=law, degrees_of_freedom=repeats * (points - 1))
    return RadiusDifference(mean, sd, interval, points * repeats)
