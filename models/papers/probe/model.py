"""A tilting touch probe: frame, angles, error map, and the corrected point of a touch (P (11)-(17)).

The error map interpolates between directions of a grid and refuses directions outside it.

Errata of P: the columns of Tp are the probe's axes, so (12) must read v = Tp v', v' = Tp^T v, as in (14); "cosB=0" in Tp means cosB; in
(15), (16) phi is the colatitude from z' and theta the longitude, which the text calls longitude and latitude; (16) needs atan2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3

PERIOD = 2.0 * np.pi
EDGE_RAD = 1e-9
"""Tolerance, for rounding, of a direction on the outermost measured circle."""
Reading17 = Literal["approach", "outward"]
"""Two meanings of M in P (17): the direction in which the probe approaches the part, or the part's outward normal."""
UNIT = 1e-6


def probe_frame(tilt_rad: F1, roll_rad: F1) -> F3:
    """Return Tp, P (11) = Rz(B) Ry(-A): its columns are the axes e'x, e'y, e'z of the probe in machine coordinates.

    At A = 0 the cross product for e'y in (11) vanishes; the limit Rz(B) is used, so that B still turns the map.

    Parameters
    ----------
    tilt_rad, roll_rad : arrays, shape (n,), or numbers
        Angles A and B.

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
    """Transform vectors from machine coordinates to the probe frame, v' = Tp^T v (P (14)); shapes (..., 3, 3) and (..., 3)."""
    out: F2 = np.einsum("...ji,...j->...i", np.asarray(frame, dtype=np.float64), finite_vectors(machine))
    return out


def to_machine(frame: F3, probe: F2) -> F2:
    """Transform vectors from the probe frame to machine coordinates, v = Tp v'; shapes (..., 3, 3) and (..., 3).

    Erratum: P (12) prints this product as the transformation to the probe frame.
    """
    out: F2 = np.einsum("...ij,...j->...i", np.asarray(frame, dtype=np.float64), finite_vectors(probe))
    return out


def direction_angles(probe: F2) -> tuple[F1, F1]:
    """Return colatitude from z' in [0, pi] and longitude in [0, 2 pi) of directions in the probe frame (P (15), (16), corrected).

    Parameters
    ----------
    probe : array, shape (..., 3)
        Any length but zero. At the pole the longitude has no meaning.

    Raises
    ------
    ValueError
        A direction has length zero or is not finite.
    """
    v = finite_vectors(probe)
    size = np.linalg.norm(v, axis=-1)
    if (size == 0.0).any():
        raise ValueError("probe direction: a vector of length zero has no direction")
    # acos(z'/|v|) would lose half the digits near the pole.
    colatitude = np.arctan2(np.hypot(v[..., 0], v[..., 1]), v[..., 2])
    longitude = np.mod(np.arctan2(v[..., 1], v[..., 0]), 2.0 * np.pi)
    return np.asarray(colatitude), np.asarray(np.where(longitude >= 2.0 * np.pi, 0.0, longitude))


def direction(colatitude_rad: F1, longitude_rad: F1) -> F2:
    """Return the unit vectors of colatitudes and longitudes in the probe frame, shape (..., 3); inverse of `direction_angles`."""
    ph, th = np.broadcast_arrays(np.asarray(colatitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64))
    return np.stack([np.sin(ph) * np.cos(th), np.sin(ph) * np.sin(th), np.cos(ph)], axis=-1)


def finite_vectors(value: F2) -> F2:
    """Return vectors as float64; ValueError if the shape is not (..., 3) or a number is not finite."""
    v = np.asarray(value, dtype=np.float64)
    if v.ndim == 0 or v.shape[-1] != 3 or not np.isfinite(v).all():
        raise ValueError(f"probe: expected finite vectors of shape (..., 3), got {v.shape}")
    return v


@dataclass(frozen=True)
class LobingMap:
    """Probe error as a function of the touching direction, on a grid of colatitudes and longitudes, with one value at the pole.

    Parameters
    ----------
    colatitude_rad : array, shape (m,)
        Circles, increasing, above 0 and at most pi.
    longitude_rad : array, shape (k,)
        Increasing, within one turn; the map is periodic.
    values_mm : array, shape (m, k)
        Probe(phi, theta): positive if the reading is too near the centre of the sphere (the probe triggers late).
    pole_mm : float
        Value at the pole.

    Raises
    ------
    ValueError
        A shape or an order is wrong, or a number is not finite.
    """

    colatitude_rad: F1
    longitude_rad: F1
    values_mm: F2
    pole_mm: float

    def __post_init__(self) -> None:
        """Check the numbers and turn them into arrays."""
        for name in ("colatitude_rad", "longitude_rad", "values_mm"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        ph, th, v = self.colatitude_rad, self.longitude_rad, self.values_mm
        if ph.ndim != 1 or th.ndim != 1 or ph.size < 1 or th.size < 2 or v.shape != (ph.size, th.size):
            raise ValueError(f"lobing map: values {v.shape} do not fit {ph.shape} circles and {th.shape} longitudes")
        if not (np.isfinite(ph).all() and np.isfinite(th).all() and np.isfinite(v).all() and np.isfinite(self.pole_mm)):
            raise ValueError("lobing map: all numbers must be finite")
        if ph[0] <= 0.0 or ph[-1] > np.pi or (np.diff(ph) <= 0.0).any() or (np.diff(th) <= 0.0).any() or th[-1] - th[0] >= PERIOD:
            raise ValueError("lobing map: circles must increase within (0, pi], longitudes within one turn")

    def at_angles(self, colatitude_rad: F1, longitude_rad: F1) -> F1:
        """Return the probe error at colatitudes and longitudes, by bilinear interpolation, periodic in longitude.

        Parameters
        ----------
        colatitude_rad, longitude_rad : arrays, shape (n,), or numbers

        Returns
        -------
        array, shape (n,), mm

        Raises
        ------
        ValueError
            An angle is not finite, or a direction lies beyond the outermost circle, where there are no data.
        """
        ph, th = np.broadcast_arrays(np.asarray(colatitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64))
        if not (np.isfinite(ph).all() and np.isfinite(th).all()):
            raise ValueError("lobing map: colatitude and longitude must be finite")
        outermost = float(self.colatitude_rad[-1])
        beyond = (ph < 0.0) | (ph > outermost + EDGE_RAD)
        if beyond.any():
            place = f"colatitude {np.rad2deg(ph[beyond].max()):.3f} degrees"
            raise ValueError(f"lobing map: {int(beyond.sum())} directions beyond the outermost circle ({place}): no data there")
        circles, table = self._closed()
        i, u = _cell(circles, np.minimum(ph, outermost))
        turn = np.append(self.longitude_rad, self.longitude_rad[0] + PERIOD)
        k, w = _cell(turn, self.longitude_rad[0] + np.mod(th - self.longitude_rad[0], PERIOD))
        inner = (1.0 - w) * table[i, k] + w * table[i, k + 1]
        outer = (1.0 - w) * table[i + 1, k] + w * table[i + 1, k + 1]
        return np.asarray((1.0 - u) * inner + u * outer)

    def at(self, probe_direction: F2) -> F1:
        """Return the probe error for OUTWARD directions (part to ball centre) in the probe frame, (..., 3); errors as in `at_angles`."""
        return self.at_angles(*direction_angles(probe_direction))

    def _closed(self) -> tuple[F1, F2]:
        """Return the circles with the pole in front, and the values with the pole's row and the first longitude repeated at the end."""
        rows = np.vstack([np.full(self.longitude_rad.size, self.pole_mm), self.values_mm])
        return np.concatenate([[0.0], self.colatitude_rad]), np.hstack([rows, rows[:, :1]])


def _cell(nodes: F1, at: F1) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.intp]], F1]:
    """Return the index of the node before each position, and the position as a share of the interval to the next node."""
    k = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, nodes.size - 2)
    return k, np.asarray((at - nodes[k]) / (nodes[k + 1] - nodes[k]))


def probe_error_mm(lobing: LobingMap, frame: F3, outward: F2) -> F1:
    """Return the probe error of touches from the map, at the OUTWARD unit normal (part to ball centre) in the probe frame, n' = Tp^T n.

    Parameters
    ----------
    frame : array, shape (3, 3) or (n, 3, 3)
        Tp from `probe_frame`.
    outward : array, shape (n, 3)

    Raises
    ------
    ValueError
        A direction is not a unit vector, or lies outside the map.
    """
    return lobing.at(to_probe(frame, unit_vectors(outward)))


def combined_deviation_mm(deviation_mm: F2, probe_mm: F1, outward: F2) -> F2:
    """Return actual minus reading of the ball centre from geometry and probe, delta + Probe n.

    A positive Probe means a reading too near the part, so the correction moves the ball centre outward.

    Parameters
    ----------
    deviation_mm : array, shape (n, 3)
        Actual minus reading from the geometry alone.
    probe_mm : array, shape (n,)
        From `probe_error_mm`.
    outward : array, shape (n, 3)
        Unit normal from part to ball centre.

    Raises
    ------
    ValueError
        Shapes do not agree, or a direction is not a unit vector.
    """
    off, n, value = finite_vectors(deviation_mm), unit_vectors(outward), np.asarray(probe_mm, dtype=np.float64)
    if off.shape != n.shape or value.shape != n.shape[:-1] or not np.isfinite(value).all():
        raise ValueError(f"combined model: deviations {off.shape}, directions {n.shape} and probe errors {value.shape} do not fit together")
    return off + value[..., None] * n


def printed_eq17_mm(deviation_mm: F2, probe_mm: F1, outward: F2, m: Reading17) -> F2:
    """Evaluate P (17), delta - Probe M, for either meaning of M, because the paper does not state which one it means.

    ``"approach"`` (M = -n) equals `combined_deviation_mm`. ``"outward"`` (M = n) moves the point the wrong way. In both cases the probe
    error holds at the outward direction.

    Raises
    ------
    ValueError
        As in `combined_deviation_mm`, or ``m`` has another value.
    """
    if m not in ("approach", "outward"):
        raise ValueError(f"eq (17): m must be 'approach' or 'outward', got {m!r}")
    direction = np.asarray(outward, dtype=np.float64) * (-1.0 if m == "approach" else 1.0)
    return combined_deviation_mm(deviation_mm, -np.asarray(probe_mm, dtype=np.float64), direction)


def contact_point_mm(reading_mm: F2, combined_mm: F2, effective_radius_mm: float, outward: F2) -> F2:
    """Return the touched point on the part: reading + combined deviation - effective radius along the outward normal.

    Parameters
    ----------
    reading_mm, combined_mm, outward : arrays, shape (n, 3)
        Reading of the ball centre, `combined_deviation_mm`, and unit normals from part to ball centre.
    effective_radius_mm : float

    Raises
    ------
    ValueError
        A number is not finite, or a direction is not a unit vector.
    """
    if not np.isfinite(effective_radius_mm):
        raise ValueError("contact point: the effective radius must be finite")
    return finite_vectors(reading_mm) + finite_vectors(combined_mm) - effective_radius_mm * unit_vectors(outward)


def unit_vectors(value: F2) -> F2:
    """Return vectors as float64; ValueError if one is not a unit vector or not finite."""
    v = finite_vectors(value)
    if (np.abs(np.linalg.norm(v, axis=-1) - 1.0) > UNIT).any():
        raise ValueError("touching direction: expected unit vectors")
    return v
