"""A campaign compressed to normal equations of the unknowns, per fold and instrument.

All later work is in the space of the unknowns (a few hundred), however many readings there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3

I1 = NDArray[np.int64]
KINDS = ("bar", "laser")
"""Instruments whose noise is estimated separately."""


@dataclass(frozen=True)
class PlannedReadings:
    """Whitened, scaled readings of all runs on top of each other.

    Attributes
    ----------
    a : array, shape (n, p)
        Design; every row divided by its expected noise, every column multiplied by the unknown's reference size.
    y : array, shape (n,)
        Readings minus the prediction at the expansion point, divided by their expected noise.
    run, fold, kind : arrays of int, shape (n,)
        Which run, which fold (set-ups that are held out together) and which of `KINDS` each row is of.
    """

    a: F2
    y: F1
    run: I1
    fold: I1
    kind: I1


@dataclass(frozen=True)
class InformationSums:
    """Normal equations per kind of instrument: A^T W A (k, p, p), A^T W y (k, p), y^T W y (k,), sum of weights (k,)."""

    gram: F3
    moment: F2
    square: F1
    count: F1

    def minus(self, other: InformationSums) -> InformationSums:
        """The sums without a part of the readings."""
        return InformationSums(self.gram - other.gram, self.moment - other.moment, self.square - other.square, self.count - other.count)

    def turned(self, root: F2, blocks: tuple[NDArray[np.intp], ...]) -> InformationSums:
        """The sums for other unknowns: the old ones are ``root`` @ the new ones; ``root`` is the unit matrix but for its blocks."""
        gram = self.gram.copy()
        for at in blocks:
            gram[:, :, at] = gram[:, :, at] @ root[np.ix_(at, at)]
        for at in blocks:
            gram[:, at, :] = root[np.ix_(at, at)].T @ gram[:, at, :]
        return InformationSums(gram, self.moment @ root, self.square, self.count)

    def decimated(self, factor: F1) -> InformationSums:
        """The sums with fewer effective readings by ``factor``, shape (k,), because neighbours are correlated."""
        f: F1 = 1.0 / factor
        return InformationSums(self.gram * f[:, None, None], self.moment * f[:, None], self.square * f, self.count * f)


@dataclass(frozen=True)
class Grams:
    """A^T A of every (fold, kind) with all weights 1, computed once: shape (folds, kinds, p, p)."""

    parts: NDArray[np.float64]


def grams(r: PlannedReadings) -> Grams:
    """Gram matrices of all folds and kinds of instrument."""
    folds, p = int(r.fold.max()) + 1, r.a.shape[1]
    out = np.zeros((folds, len(KINDS), p, p))
    for f in range(folds):
        for k in range(len(KINDS)):
            rows = r.a[(r.fold == f) & (r.kind == k)]
            if rows.size:
                used = np.flatnonzero(rows.any(axis=0))  # most set-up unknowns belong to other folds
                part = rows[:, used]
                out[f, k][np.ix_(used, used)] = part.T @ part
    return Grams(out)


def sums(r: PlannedReadings, g: Grams, weight: F1) -> tuple[InformationSums, ...]:
    """Normal equations of every fold for given weights of the readings (1: as it is, 0: not used), shape (n,)."""
    found = []
    for f in range(g.parts.shape[0]):
        gram, moment, square, count = g.parts[f].copy(), [], [], []
        for k in range(len(KINDS)):
            at = (r.fold == f) & (r.kind == k)
            w, y = weight[at], r.y[at]
            downweighted = np.flatnonzero(at & (weight < 1.0))
            if downweighted.size:
                out = r.a[downweighted]
                gram[k] -= (out * (1.0 - weight[downweighted])[:, None]).T @ out
            moment.append((w * y) @ r.a[at])
            square.append(float(w @ y**2))
            count.append(float(w.sum()))
        found.append(InformationSums(gram, np.array(moment), np.array(square), np.array(count)))
    return tuple(found)


def total(parts: tuple[InformationSums, ...]) -> InformationSums:
    """All folds together."""
    return InformationSums(
        np.sum([s.gram for s in parts], axis=0),
        np.sum([s.moment for s in parts], axis=0),
        np.sum([s.square for s in parts], axis=0),
        np.sum([s.count for s in parts], axis=0),
    )
