"""What is left of readings and of candidates when everything that the model may still change has been taken out (Frisch-Waugh-Lovell)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2

ROWS = 2048
"""Readings that are looked at together: a second matrix of all unknowns at all readings is never made."""


@dataclass(frozen=True)
class SignalSpace:
    """Whitened readings and what has been taken out of them.

    What takes out the unknowns is T = [root @ columns^T @ diag(weight); rows], shape (p + k, n): M = 1 - T^T T; with flat priors M is a
    projection. T is a matrix as large as the columns and is not kept: its factors are, and the columns belong to the simulation.

    Attributes
    ----------
    y : array, shape (n,)
        Whitened gap between readings and the present simulation.
    columns : array, shape (n, p); weight : array, shape (n,)
        Whitened columns of the unknowns are ``columns`` times ``weight``, reading by reading.
    root : array, shape (p, p), lower triangle.
    more : array, shape (k, n): rows of what was taken out besides.
    moment : array, shape (p + k,) = T @ y.
    """

    y: F1
    columns: F2
    weight: F1
    root: F2
    more: F2
    moment: F1

    @classmethod
    def nothing(cls, n: int) -> SignalSpace:
        """Nothing is taken out of n readings that are all zero."""
        return cls(np.zeros(n), np.zeros((n, 0)), np.ones(n), np.zeros((0, 0)), np.zeros((0, n)), np.zeros(0))

    @classmethod
    def of(cls, y: F1, columns: F2, gram: F2, prior_sd: F1, weight: F1 | None = None) -> SignalSpace:
        """Take out ``columns`` (n, p) times ``weight``, with ``gram`` of these products, whose unknowns have independent priors."""
        scaled = gram * prior_sd[:, None] * prior_sd
        scaled.flat[:: len(gram) + 1] += 1.0
        root = linalg.solve_triangular(np.linalg.cholesky(scaled), np.diag(prior_sd), lower=True)
        space = cls(y, columns, np.ones(y.size) if weight is None else weight, root, np.zeros((0, y.size)), np.zeros(0))
        return replace(space, moment=space.seen(y[:, None])[:, 0])

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
        """M @ y: whitened gap that is left."""
        return np.asarray(self.y - self.spread(self.moment[:, None])[:, 0])

    @cached_property
    def leverage(self) -> F1:
        """Share of every reading's noise that the unknowns take with them."""
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
        """What taking out more columns (n, k) adds to T, shape (k, n)."""
        return rows_of(self.left(columns), columns, prior_sd)

    def without(self, columns: F2, prior_sd: F1) -> SignalSpace:
        """The space with more columns taken out."""
        rows = self.rows(columns, prior_sd)
        return replace(self, more=np.concatenate([self.more, rows]), moment=np.concatenate([self.moment, rows @ self.y]))


def rows_of(left: F2, columns: F2, prior_sd: F1) -> F2:
    """Rows that take out columns, given what the space leaves of them; their unknowns have independent priors."""
    gram = columns.T @ left + np.diag(prior_sd**-2.0)
    return np.asarray(linalg.solve_triangular(linalg.cholesky(0.5 * (gram + gram.T), lower=True), left.T, lower=True))
