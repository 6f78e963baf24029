"""The 21 error functions as powers of u = position / travel, the form in which the papers' reference vectors state a machine (math.md 4.6).

Positioning and angles have powers 1..d, straightness 2..d, squareness one value: 18 d - 3 coefficients. Both papers' letters fit: delta_ij
and eps_ij (Yang), delta_i(J) and alpha_i(J) (Wang); `abbe.models.notation` converts their signs.
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
    """Coefficient of u_j**power in delta_ij ("d", mm), eps_ij ("e", rad) or, "S" with power 1, the squareness of axes i and j (rad)."""

    kind: Kind
    i: int
    j: int
    power: int

    @property
    def name(self) -> str:
        """Name as the vector files write it: ``dxx^1``, ``ezy^2``, ``Sxy^1``."""
        return f"{self.kind}{'xyz'[self.i]}{'xyz'[self.j]}^{self.power}"


@dataclass(frozen=True)
class ErrorArrays:
    """Values at n positions.

    ``d`` and ``e``, shape (n, 3, 3): ``[:, i, j]`` in direction (about axis) i of the motion along j, mm and rad; ``s``, shape (3,):
    squareness xy, xz, yz in rad.
    """

    d: F3
    e: F3
    s: F1


def monomials(degree: int) -> tuple[Monomial, ...]:
    """All 18 degree - 3 monomials: delta_ij by moving axis, then eps_ij by moving axis, then squareness (order of the reference vectors).

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
    """Error functions of given coefficients.

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients: mm for translations; rad for angles and squareness, times ``1 / angle_scale``.
    u : array, shape (n, 3)
        Position over travel of each axis.
    angle_scale : float
        Factor on the coefficients of angles and squareness: 1/500 for those of the reference vectors, which are stated times 500 mm.

    Raises
    ------
    ValueError
        Numbers of terms and coefficients differ.
    """
    if theta.shape != (len(terms),):
        raise ValueError(f"error functions: {len(terms)} terms need as many coefficients, got shape {theta.shape}")
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
    """Functions with one coefficient 1 and the others 0, for every coefficient in as few batches as possible: a design needs them all.

    Returns
    -------
    list of (terms, arrays)
        ``terms``: which of the terms; ``arrays``: their values one term after the other, k n positions for k terms. Squareness, which has
        one value per batch, comes in batches of one term.
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
