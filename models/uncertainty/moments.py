"""Mean and covariance of results that come in chunks and are not kept."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2


class Moments:
    """Running sums about a fixed point near the mean, so that no digits are lost."""

    def __init__(self, about: F1) -> None:
        self._about = about
        self._first = np.zeros(about.size)
        self._second = np.zeros((about.size, about.size))
        self.count = 0

    def add(self, results: F2) -> None:
        """Take in results, shape (trials, p)."""
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
