"""Projection of readings and candidates onto the complement of the model's unknowns (Frisch-Waugh-Lovell)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

ROWS = 2048
"""Readings per block of a product, so that no second matrix of all readings and unknowns exists."""


@dataclass(frozen=True)
class SignalProjection:
    """Whitened readings and the operator that projects the unknowns out of them.

    With T = [root @ columns^T @ diag(weight); rows], shape (p + k, n), the operator is M = 1 - T^T T; with flat priors M is a projection.
    T is as large as the columns, so only its factors are stored, and the columns belong to the simulation.

    Attributes
    ----------
    y : array, shape (n,)
        Whitened gap between readings and the present simulation.
    columns : array, shape (n, p); weight : array, shape (n,)
        Whitened columns of the unknowns are ``columns`` times ``weight``, reading by reading.
    root : array, shape (p, p), lower triangle.
    more : array, shape (k, n): rows of T for further columns.
    moment : array, shape (p + k,) = T @ y.
    """

    y: F1
    columns: F2
    weight: F1
    root: F2
    more: F2
    moment: F1

    @classmethod
    def nothing(cls, n: int) -> SignalProjection:
        """The identity on n readings, all zero."""
        return cls(np.zeros(n), np.zeros((n, 0)), np.ones(n), np.zeros((0, 0)), np.zeros((0, n)), np.zeros(0))

    @classmethod
    def of(cls, y: F1, columns: F2, gram: F2, prior_sd: F1, weight: F1 | None = None) -> SignalProjection:
        """Project out ``columns`` (n, p) times ``weight``, with Gram matrix ``gram``; the unknowns have independent priors."""
        scaled = gram * prior_sd[:, None] * prior_sd
        scaled.flat[:: len(gram) + 1] += 1.0
        root = scipy.linalg.solve_triangular(np.linalg.cholesky(scaled), np.diag(prior_sd), lower=True)
        projection = cls(y, columns, np.ones(y.size) if weight is None else weight, root, np.zeros((0, y.size)), np.zeros(0))
        return replace(projection, moment=projection.seen(y[:, None])[:, 0])

    def seen(self, columns: F2) -> F2:
        """T @ columns, shape (p + k, columns)."""
        return np.concatenate([self.root @ (self.columns.T @ (columns * self.weight[:, None])), self.more @ columns])

    def spread(self, amounts: F2) -> F2:
        """T^T @ amounts, shape (n, columns)."""
        p = len(self.root)
        return np.asarray((self.columns @ (self.root.T @ amounts[:p])) * self.weight[:, None] + self.more.T @ amounts[p:])

    def left(self, columns: F2) -> F2:
        """M @ columns, shape (n, k)."""
        return columns - self.spread(self.seen(columns))

    @cached_property
    def residual(self) -> F1:
        """M @ y, the whitened residual."""
        return np.asarray(self.y - self.spread(self.moment[:, None])[:, 0])

    @cached_property
    def leverage(self) -> F1:
        """Leverage: share of every reading's noise that the fit absorbs."""
        out: F1 = np.einsum("kn,kn->n", self.more, self.more)
        for start in range(0, self.y.size, ROWS):
            at = slice(start, start + ROWS)
            part = self.root @ (self.columns[at] * self.weight[at, None]).T
            out[at] += np.einsum("pn,pn->n", part, part)
        return out

    @property
    def chi2(self) -> float:
        """y^T M y."""
        return float(self.y @ self.y - self.moment @ self.moment)

    def rows(self, columns: F2, prior_sd: F1) -> F2:
        """Rows of T that project out more columns (n, k), shape (k, n)."""
        return rows_of(self.left(columns), columns, prior_sd)

    def without(self, columns: F2, prior_sd: F1) -> SignalProjection:
        """The projection with more columns projected out."""
        rows = self.rows(columns, prior_sd)
        return replace(self, more=np.concatenate([self.more, rows]), moment=np.concatenate([self.moment, rows @ self.y]))


def rows_of(left: F2, columns: F2, prior_sd: F1) -> F2:
    """Rows that project out columns, given the columns after projection (``left``); the unknowns have independent priors."""
    gram = columns.T @ left + np.diag(prior_sd**-2.0)
    return np.asarray(scipy.linalg.solve_triangular(scipy.linalg.cholesky(0.5 * (gram + gram.T), lower=True), left.T, lower=True))
