"""Random error of the tool from the random errors of the 21 parameters (P (5), (8)).

A parameter may act through more than one lever: in MB1, Ey(X) enters dX with (Z + Zp). Such coefficients must be added before they are
squared. Erratum: the paper squares Z and Zp separately, which is wrong if both are non-zero (`printed_eq5_mm`).

A random error R may be one or two standard deviations (its coverage); results have the coverage of the inputs. Pahk's "repeatability" is
the largest 2 sigma over the positions; `RandomErrors.in_coverage` converts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.chain import motion_jacobian, squareness_jacobian
from abbe.models.geometry.propagation import checked_covariance
from abbe.models.machine import Machine
from abbe.models.notation.pahk import PahkType, pahk_machine, parameter_signs, squareness_slopes

PARAMETERS = (*(f"{f}{i}({j})" for f in "dE" for j in "XYZ" for i in "xyz"), "alpha", "beta1", "beta2")
"""Order of the 21 parameters: dx(X) dy(X) dz(X) dx(Y) ... Ez(Z), alpha, beta1, beta2."""

REPEATABILITY_COVERAGE = 2.0
"""Pahk's "repeatability" is twice the standard deviation (P, section 4)."""


@dataclass(frozen=True)
class RandomErrors:
    """Random errors R of the 21 parameters at one position.

    Parameters
    ----------
    d_mm, e_rad : arrays, shape (3 axes j, 3 directions i)
        R of d_i(j) and of E_i(j).
    squareness_rad : array, shape (3,)
        R of alpha, beta1, beta2.
    coverage : float
        Number of standard deviations in each R: 1 for sigma, 2 for Pahk's repeatability.

    Raises
    ------
    ValueError
        A shape is wrong, a number is negative or not finite, or the coverage is not positive.
    """

    d_mm: F2
    e_rad: F2
    squareness_rad: F1
    coverage: float

    def __post_init__(self) -> None:
        """Check the numbers and turn them into arrays."""
        for name, shape in (("d_mm", (3, 3)), ("e_rad", (3, 3)), ("squareness_rad", (3,))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not (np.isfinite(value) & (value >= 0.0)).all():
                raise ValueError(f"random errors: {name} must hold finite numbers, not negative, in shape {shape}")
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.coverage) and self.coverage > 0.0):
            raise ValueError(f"random errors: coverage {self.coverage} must be positive")

    @property
    def vector(self) -> F1:
        """The 21 numbers in the order of PARAMETERS, shape (21,)."""
        return np.concatenate([self.d_mm.ravel(), self.e_rad.ravel(), self.squareness_rad])

    def in_coverage(self, coverage: float) -> RandomErrors:
        """Return the same random errors as another multiple of sigma."""
        k = coverage / self.coverage
        return RandomErrors(self.d_mm * k, self.e_rad * k, self.squareness_rad * k, coverage)


def parameter_jacobian(kind: PahkType, axes_mm: F2, probe_mm: F1 | None = None) -> F3:
    """Return the derivative of the deviation (rule G) with respect to Pahk's 21 parameters, one combined coefficient each.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    probe_mm : array, shape (3,), optional

    Returns
    -------
    array, shape (n, 3 components, 21), mm per mm and mm per rad, order of PARAMETERS.
    """
    axes = np.asarray(axes_mm, dtype=np.float64)
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3), probe_mm)
    motion = motion_jacobian(machine, axes) * parameter_signs(kind)
    n = axes.shape[0]
    square = np.einsum("nj,jik->nik", axes, squareness_slopes(kind))
    return np.concatenate([motion[..., :3].reshape(n, 3, 9), motion[..., 3:].reshape(n, 3, 9), square], axis=2)


def iso_parameter_jacobian(machine: Machine, axes_mm: F2, tool_mm: F1 | F2 | None = None) -> F3:
    """Return the `parameter_jacobian` of any chain in ISO names: translations EXX EYX EZX EXY ..., rotations EAX ... ECZ, C0Y, B0Z, A0Z.

    Returns
    -------
    array, shape (n, 3, 21)
    """
    axes = np.asarray(axes_mm, dtype=np.float64)
    motion = motion_jacobian(machine, axes, tool_mm)
    n = axes.shape[0]
    return np.concatenate([motion[..., :3].reshape(n, 3, 9), motion[..., 3:].reshape(n, 3, 9), squareness_jacobian(axes)], axis=2)


def quadrature_mm(jacobian: F3, random: RandomErrors) -> F2:
    """Return RX, RY, RZ for independent parameters, the root of the sum of (coefficient x R)^2, with the coverage of ``random``.

    Parameters
    ----------
    jacobian : array, shape (n, 3, 21)
        `parameter_jacobian` or `iso_parameter_jacobian`.

    Returns
    -------
    array, shape (n, 3), mm
    """
    part = jacobian * random.vector
    return np.asarray(np.sqrt((part * part).sum(axis=2)))


def propagate(jacobian: F3, covariance: F2) -> F3:
    """Return the covariance J C J^T of the deviation at each position, for parameters that may be correlated.

    Parameters
    ----------
    jacobian : array, shape (n, 3, 21)
    covariance : array, shape (21, 21)
        Covariance of the parameters (mm, rad) in the order of the Jacobian.

    Returns
    -------
    array, shape (n, 3, 3), mm^2. For a diagonal ``covariance`` the roots of the diagonal are `quadrature_mm`.

    Raises
    ------
    ValueError
        ``covariance`` is not a covariance (`abbe.models.geometry.propagation.checked_covariance`).
    """
    c = checked_covariance(covariance, jacobian.shape[-1])
    return np.asarray(jacobian @ c @ np.swapaxes(jacobian, 1, 2))


def printed_eq5_mm(axes_mm: F2, probe_mm: F1, random: RandomErrors) -> F2:
    """Return RX, RY, RZ of MB1 as printed in P (5), with Z and Zp squared separately: WRONG with a probe offset, for comparison only.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    probe_mm : array, shape (3,)

    Returns
    -------
    array, shape (n, 3), mm
    """
    x, _, z = (np.asarray(axes_mm, dtype=np.float64)[:, k] ** 2 for k in range(3))
    xp, yp, zp = (float(v) ** 2 for v in np.asarray(probe_mm, dtype=np.float64))
    d, e, (alpha, beta1, beta2) = random.d_mm**2, random.e_rad**2, random.squareness_rad**2
    ex, ey, ez = e[:, 0], e[:, 1], e[:, 2]
    rx = d[:, 0].sum() + z * (beta1 + ey[0] + ey[1]) + yp * ez.sum() + zp * ey.sum()
    ry = d[:, 1].sum() + x * (alpha + ez[1]) + z * (beta2 + ex[1] + ex[0]) + xp * ez.sum() + zp * ex.sum()
    rz = d[:, 2].sum() + x * ey[1] + xp * ey.sum() + yp * ex.sum()
    return np.asarray(np.sqrt(np.stack([rx, ry, rz], axis=1)))
