"""Knowledge of an input as a distribution (GUM-S1 6): normal, rectangular, or Student's t for a figure from few repeats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2


class Moments:
    """Running sums about a fixed point near the mean, so that no digits are lost."""

    def __init__(self, about: F1) -> None:
        self._about = about
        self._first = np.zeros(about.size)
        self._second = np.zeros((about.size, about.size))
        self.count = 0

    def add(self, results: F2) -> None:
        """Add results, shape (trials, p)."""
        d = results - self._about
        self._first += d.sum(axis=0)
        self._second += d.T @ d
        self.count += len(d)

    @property
    def mean(self) -> F1:
        """Mean of all results so far, shape (p,)."""
        return np.asarray(self._about + self._first / self.count)

    @property
    def covariance(self) -> F2:
        """Covariance with n - 1, shape (p, p)."""
        if self.count < 2:
            raise ValueError("moments: a covariance needs two results or more")
        return np.asarray((self._second - np.outer(self._first, self._first) / self.count) / (self.count - 1))


Shape = Literal["normal", "rectangular", "t"]


@dataclass(frozen=True, slots=True)
class Distribution:
    """A distribution about zero.

    Attributes
    ----------
    shape : "normal" | "rectangular" | "t"
        Normal: a standard uncertainty is known. Rectangular: only limits are known. t: mean of few repeats (GUM-S1 6.4.9).
    u : float
        Normal, rectangular: the standard deviation (a rectangle has the half-width u sqrt 3). t: the scale s / sqrt(n) of n repeats with
        standard deviation s; the standard deviation of the distribution is then u sqrt(dof / (dof - 2)).
    dof : float
        Degrees of freedom of t, above 2, so that it has a variance.

    Raises
    ------
    ValueError
        Another shape, a negative or infinite u, or t with 2 degrees of freedom or fewer.
    """

    shape: Shape = "normal"
    u: float = 1.0
    dof: float = float("inf")

    def __post_init__(self) -> None:
        """Refuse parameters without a finite variance."""
        if self.shape not in ("normal", "rectangular", "t"):
            raise ValueError(f"distribution {self.shape!r}: must be 'normal', 'rectangular' or 't'")
        if not (np.isfinite(self.u) and self.u >= 0):
            raise ValueError(f"distribution: u is {self.u}, must be a number of 0 or more")
        if self.shape == "t" and not self.dof > 2:
            raise ValueError(f"distribution: t needs more than 2 degrees of freedom to have a variance, got {self.dof}")

    @property
    def sd(self) -> float:
        """Standard deviation."""
        if self.shape == "t" and np.isfinite(self.dof):
            return float(self.u * np.sqrt(self.dof / (self.dof - 2.0)))
        return self.u

    def fill(self, rng: np.random.Generator, out: NDArray[Any]) -> None:
        """Fill an array of any shape, double or single precision, with draws."""
        kind: Any = out.dtype.type
        if self.shape == "t" and np.isfinite(self.dof):
            out[...] = rng.standard_t(self.dof, out.shape)
            out *= self.u
        elif self.shape == "rectangular":
            rng.random(out=out, dtype=kind)
            out -= 0.5
            out *= float(self.u * np.sqrt(12.0))
        else:
            rng.standard_normal(out=out, dtype=kind)
            if self.u != 1.0:
                out *= self.u


NORMAL = Distribution()
"""Standard normal."""
