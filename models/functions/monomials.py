"""The 21 error functions as powers of u = position / travel: the form in which the reference vectors of the papers state a machine.

Positioning and angles have powers 1..d, straightness 2..d, squareness one value: 18 d - 3 coefficients. The indices are those of Yang
(delta_ij, eps_ij) and Wang (delta_i(J), alpha_i(J)); `abbe.models.notation` converts signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3

Kind = Literal["d", "e", "S"]
SQUARENESS = ((0, 1), (0, 2), (1, 2))
"""Axes of the three squareness errors in the order of `ErrorArrays.s`: xy, xz, yz."""


@dataclass(frozen=True, slots=True)
class Monomial:
    """One term of an error motion of axis j: position of the axis to ``power``, in delta_ij (kind "d", mm) or eps_ij ("e", rad).

    Kind "S" is the squareness of axes i and j (rad, power 1).
    """

    kind: Kind
    i: int
    j: int
    power: int

    @property
    def name(self) -> str:
        """Name in the reference-vector files: ``dxx^1``, ``ezy^2``, ``Sxy^1``."""
        return f"{self.kind}{'xyz'[self.i]}{'xyz'[self.j]}^{self.power}"


@dataclass(frozen=True)
class ErrorArrays:
    """Error values at n positions.

    ``d`` (mm) and ``e`` (rad), shape (n, 3, 3): element ``[:, i, j]`` is the error along (about) axis i of the motion along axis j.
    ``s``, shape (3,): squareness xy, xz, yz in rad.
    """

    d: F3
    e: F3
    s: F1


def monomials(degree: int) -> tuple[Monomial, ...]:
    """Return all 18 degree - 3 monomials in the order of the reference vectors: delta_ij and eps_ij by moving axis, then squareness.

    Raises
    ------
    ValueError
        ``degree`` is less than 1.
    """
    if degree < 1:
        raise ValueError(f"degree {degree}: must be 1 or more")
    out: list[Monomial] = []
    for j in range(3):
        for i in range(3):
            out.extend(Monomial("d", i, j, k) for k in range(1 if i == j else 2, degree + 1))
    for j in range(3):
        for i in range(3):
            out.extend(Monomial("e", i, j, k) for k in range(1, degree + 1))
    return (*out, *(Monomial("S", i, j, 1) for i, j in SQUARENESS))


def error_arrays(terms: tuple[Monomial, ...], theta: F1, u: F2, angle_scale: float = 1.0) -> ErrorArrays:
    """Evaluate error functions with given coefficients.

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients: mm for translations, rad / ``angle_scale`` for angles and squareness.
    u : array, shape (n, 3)
        Position over travel of each axis.
    angle_scale : float
        Factor on the coefficients of angles and squareness. The reference vectors multiply these by 500 mm; for them it is 1/500.

    Raises
    ------
    ValueError
        Numbers of terms and coefficients differ.
    """
    if theta.shape != (len(terms),):
        raise ValueError(f"error functions: expected {len(terms)} coefficients, one per term, got shape {theta.shape}")
    n = u.shape[0]
    d, e, s = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros(3)
    for t, c in zip(terms, theta, strict=True):
        if t.kind == "S":
            s[SQUARENESS.index((t.i, t.j))] += c * angle_scale
        elif t.kind == "d":
            d[:, t.i, t.j] += c * u[:, t.j] ** t.power
        else:
            e[:, t.i, t.j] += c * angle_scale * u[:, t.j] ** t.power
    return ErrorArrays(d, e, s)


def individual_terms(terms: tuple[Monomial, ...], u: F2, angle_scale: float = 1.0) -> list[tuple[slice, ErrorArrays]]:
    """Evaluate each term alone with coefficient 1, in as few batches as possible: the columns of a design matrix.

    Parameters are those of `error_arrays`.

    Returns
    -------
    list of (slice, ErrorArrays)
        The terms in the batch, and their values, one term after the other: k n positions for k terms. An `ErrorArrays` has only one set of
        squareness values, so every squareness term is a separate batch.
    """
    n, out = u.shape[0], []
    functions = next((k for k, t in enumerate(terms) if t.kind == "S"), len(terms))
    if functions:
        d, e = np.zeros((functions, n, 3, 3)), np.zeros((functions, n, 3, 3))
        for k, t in enumerate(terms[:functions]):
            (d if t.kind == "d" else e)[k, :, t.i, t.j] = u[:, t.j] ** t.power * (1.0 if t.kind == "d" else angle_scale)
        out.append((slice(0, functions), ErrorArrays(d.reshape(-1, 3, 3), e.reshape(-1, 3, 3), np.zeros(3))))
    singles = [(slice(k, k + 1), error_arrays((terms[k],), np.ones(1), u, angle_scale)) for k in range(functions, len(terms))]
    return out + singles
