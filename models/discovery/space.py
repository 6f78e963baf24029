"""What is left of readings and of candidates when everything that the model may still change has been taken out (Frisch-Waugh-Lovell)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from models.arrays import F1, F2


@dataclass(frozen=True)
class Space:
    """Whitened readings and what has been taken out of them.

    Attributes
    ----------
    y : array, shape (n,)
        Whitened gap between readings and the present simulation.
    taken : array, shape (p, n)
        M = 1 - taken^T taken takes out the unknowns; with flat priors M is a projection.
    moment : array, shape (p,) = taken @ y.
    """

    y: F1
    taken: F2
    moment: F1

    @classmethod
    def of(cls, y: F1, columns: F2, gram: F2, prior_sd: F1) -> Space:
        """Take out whitened ``columns`` (n, p), with ``gram`` = columns^T columns, whose unknowns have independent priors."""
        scaled = gram * prior_sd[:, None] * prior_sd
        scaled.flat[:: len(gram) + 1] += 1.0
        inverse = linalg.solve_triangular(np.linalg.cholesky(scaled), np.diag(prior_sd), lower=True)
        taken = inverse @ columns.T
        return cls(y, taken, taken @ y)

    def left(self, columns: F2) -> F2:
        """M @ columns, shape (n, k)."""
        return columns - self.taken.T @ (self.taken @ columns)

    @cached_property
    def taken_short(self) -> NDArray[np.float32]:
        """``taken`` with seven digits, for the many trials of a refinement."""
        return self.taken.astype(np.float32)

    @cached_property
    def residual(self) -> F1:
        """M @ y: whitened gap that is left."""
        return np.asarray(self.y - self.taken.T @ self.moment)

    @property
    def leverage(self) -> F1:
        """Share of every reading's noise that the unknowns take with them."""
        return np.asarray(np.einsum("pn,pn->n", self.taken, self.taken))

    @property
    def chi2(self) -> float:
        """y^T M y."""
        return float(self.y @ self.y - self.moment @ self.moment)

    def rows(self, columns: F2, prior_sd: F1) -> F2:
        """What taking out more columns (n, k) adds to ``taken``, shape (k, n)."""
        return rows_of(self.left(columns), columns, prior_sd)

    def without(self, columns: F2, prior_sd: F1) -> Space:
        """The space with more columns taken out."""
        rows = self.rows(columns, prior_sd)
        return replace(self, taken=np.concatenate([self.taken, rows]), moment=np.concatenate([self.moment, rows @ self.y]))


def rows_of(left: F2, columns: F2, prior_sd: F1) -> F2:
    """Rows that take out columns, given what the space leaves of them; their unknowns have independent priors."""
    gram = columns.T @ left + np.diag(prior_sd**-2.0)
    return np.asarray(linalg.solve_triangular(linalg.cholesky(0.5 * (gram + gram.T), lower=True), left.T, lower=True))
