"""Frame of a tilting touch probe and the angles that index its error map (math.md 7; P (11)-(16)).

Errata of P (math.md 3): Tp has the probe's axes as columns, so (12) must read v = Tp v', v' = Tp^T v, as (14) has it; "cosB=0" in Tp is
cosB; in (15), (16) phi is the colatitude from z' and theta the longitude (the text has them as longitude and latitude); (16) needs atan2.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3


def probe_frame(tilt_rad: F1, roll_rad: F1) -> F3:
    """Tp: axes e'x, e'y, e'z of the probe in machine coordinates as columns, P (11) = Rz(B) Ry(-A).

    At A = 0 the vector product in (11) that makes e'y vanishes; the limit Rz(B) is taken, so that B still turns the map.

    Parameters
    ----------
    tilt_rad, roll_rad : arrays, shape (n,), or numbers
        A and B.

    Returns
    -------
    array, shape (n, 3, 3); (3, 3) for two numbers. Orthonormal, determinant +1.

    Raises
    ------
    ValueError
        An angle is not finite.
    """
    a, b = np.broadcast_arrays(np.asarray(tilt_rad, dtype=np.float64), np.asarray(roll_rad, dtype=np.float64))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("probe frame: tilt and roll must be finite")
    sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
    x = np.stack([ca * cb, ca * sb, sa], axis=-1)
    y = np.stack([-sb, cb, np.zeros_like(sb)], axis=-1)
    z = np.stack([-sa * cb, -sa * sb, ca], axis=-1)
    return np.stack([x, y, z], axis=-1)


def to_probe(frame: F3, machine: F2) -> F2:
    """Components in the probe frame of vectors given in machine coordinates, v' = Tp^T v (P (14)); shapes (..., 3, 3) and (..., 3)."""
    out: F2 = np.einsum("...ji,...j->...i", np.asarray(frame, dtype=np.float64), finite_vectors(machine))
    return out


def to_machine(frame: F3, probe: F2) -> F2:
    """Components in machine coordinates of vectors given in the probe frame, v = Tp v'; shapes (..., 3, 3) and (..., 3).

    P (12) prints this product as the way into the probe frame; the columns of Tp are the probe's axes, so it is the way out (math.md 3).
    """
    out: F2 = np.einsum("...ij,...j->...i", np.asarray(frame, dtype=np.float64), finite_vectors(probe))
    return out


def direction_angles(probe: F2) -> tuple[F1, F1]:
    """Colatitude from z' in [0, pi] and longitude in [0, 2 pi) of directions in the probe frame (P (15), (16) with their errata).

    Parameters
    ----------
    probe : array, shape (..., 3)
        Any length but zero. At the pole the longitude is that of atan2, and means nothing.

    Raises
    ------
    ValueError
        A direction has no length or is not finite.
    """
    v = finite_vectors(probe)
    size = np.linalg.norm(v, axis=-1)
    if (size == 0.0).any():
        raise ValueError("probe direction: a vector of length zero has no direction")
    # The same angle as acos(z'/|v|), without its loss of half the digits near the pole.
    colatitude = np.arctan2(np.hypot(v[..., 0], v[..., 1]), v[..., 2])
    longitude = np.mod(np.arctan2(v[..., 1], v[..., 0]), 2.0 * np.pi)
    return np.asarray(colatitude), np.asarray(np.where(longitude >= 2.0 * np.pi, 0.0, longitude))


def direction(colatitude_rad: F1, longitude_rad: F1) -> F2:
    """Unit vectors of colatitude and longitude in the probe frame, shape (..., 3); inverse of `direction_angles`."""
    ph, th = np.broadcast_arrays(np.asarray(colatitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64))
    return np.stack([np.sin(ph) * np.cos(th), np.sin(ph) * np.sin(th), np.cos(ph)], axis=-1)


def finite_vectors(value: F2) -> F2:
    """Array of vectors, shape (..., 3).

    Raises
    ------
    ValueError
        Another shape, or something that is not finite.
    """
    v = np.asarray(value, dtype=np.float64)
    if v.ndim == 0 or v.shape[-1] != 3 or not np.isfinite(v).all():
        raise ValueError(f"probe: expected finite vectors of shape (..., 3), got {v.shape}")
    return v
