"""Deviation of a machine over its volume as one solution gives it, with covariance: of all error motions, or of chosen ones.

Only the stored part of a solution is needed: terms, coefficients and their covariance from all sources.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term
from abbe.models.geometry.volume import unit_deviation, volume_frame
from abbe.models.machine import Machine


@dataclass(frozen=True)
class KnownField:
    """A machine's error motions as one solution gives them, with their covariance.

    Parameters
    ----------
    machine : Machine
        Nominal geometry.
    terms : tuple of Term
        Terms of the error motions.
    coefficients : array, shape (P,)
        Their values, mm or rad.
    covariance : array, shape (P, P)
        Their covariance from all sources.
    scatter_mm : float
        Standard deviation that a single approach of a point adds per component.
    """

    machine: Machine
    terms: tuple[Term, ...]
    coefficients: F1
    covariance: F2
    scatter_mm: float = 0.0

    def index(self, names: Iterable[str]) -> list[int]:
        """Indices of the terms of motions (``"EXX"``) and of single parameters (``"EXX.1"``), ascending.

        Raises
        ------
        ValueError
            The solution has no such motion or parameter.
        """
        wanted = set(names)
        known = {t.motion for t in self.terms} | {t.name for t in self.terms}
        strange = sorted(wanted - known)
        if strange:
            raise ValueError(f"the solution has no motion or parameter {', '.join(strange)}")
        return [k for k, t in enumerate(self.terms) if t.motion in wanted or t.name in wanted]

    def per_unit(self, points_mm: F2) -> F3:
        """Deviation at points (m, 3) per unit of each coefficient, best-fit rigid motion over the strokes removed, shape (m, 3, P)."""
        return unit_deviation(self.machine, self.terms, points_mm, None, volume_frame(self.machine))

    def part(self, motions: Iterable[str]) -> KnownField:
        """The same field with only some of its motions; ValueError for an unknown motion."""
        at = self.index(motions)
        terms = tuple(self.terms[k] for k in at)
        return KnownField(self.machine, terms, self.coefficients[at], self.covariance[np.ix_(at, at)], self.scatter_mm)

    def estimate_of(self, names: Iterable[str]) -> F1:
        """Estimated coefficients of these motions and parameters, all others zero, shape (P,); ValueError as in `index`."""
        at = self.index(names)
        out = np.zeros_like(self.coefficients)
        out[at] = self.coefficients[at]
        return out

    def linear(self, values: Mapping[str, float]) -> F1:
        """Coefficients that give these scale errors (``EXX``, mm/mm) and squareness errors (``C0Y``, rad), all others zero, shape (P,).

        Raises
        ------
        ValueError
            The solution has no such parameter.
        """
        out = np.zeros_like(self.coefficients)
        for name, value in values.items():
            scale = name[0] == "E"
            [at] = self.index([f"{name}.1" if scale else name])
            # The function of Legendre order 1 is twice the fraction of the stroke (`abbe.models.geometry.bases.term_values`).
            out[at] = value * self.machine.length_mm["XYZ".index(name[2])] / 2.0 if scale else value
        return out

    def root(self) -> F2:
        """Factor R for random draws, shape (P, P): R R^T is the covariance with negative eigenvalues set to zero."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


@dataclass(frozen=True)
class FieldMap:
    """Deviation at m points, best-fit rigid motion removed: shape (m, 3), mm, and its covariance, shape (m, 3, 3), mm²."""

    points_mm: F2
    deviation_mm: F2
    covariance_mm2: F3


def field_map(known: KnownField, points_mm: F2, motions: Iterable[str] | None = None) -> FieldMap:
    """Deviation at commanded positions, mean of both directions of motion, with covariance.

    Parameters
    ----------
    known : KnownField
    points_mm : array, shape (m, 3)
    motions : iterable of str, optional
        Motions whose joint effect is returned; None: all.

    Raises
    ------
    ValueError
        The solution has no such motion.
    """
    chosen = known if motions is None else known.part(motions)
    d = chosen.per_unit(points_mm)
    m, _, p = d.shape
    spread = (d.reshape(3 * m, p) @ chosen.covariance).reshape(m, 3, p)
    covariance = spread @ np.swapaxes(d, 1, 2) + known.scatter_mm**2 * np.eye(3)
    return FieldMap(points_mm, d @ chosen.coefficients, np.asarray(covariance))
