"""Geometry and probe together: the corrected point of a touch (math.md 7; P (17))."""

from __future__ import annotations

from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.papers.probe.frame import finite_vectors, to_probe
from abbe.models.papers.probe.lobing import LobingMap

Reading17 = Literal["approach", "outward"]
"""What M in P (17) may mean: the direction in which the probe approaches the part, or the part's outward normal."""
UNIT = 1e-6


def probe_error_mm(lobing: LobingMap, frame: F3, outward: F2) -> F1:
    """Probe error of touches: the map is indexed by the OUTWARD unit normal (part to ball centre) in the probe frame, n' = Tp^T n.

    Parameters
    ----------
    frame : array, shape (3, 3) or (n, 3, 3)
        Tp of `abbe.models.papers.probe.frame.probe_frame`.
    outward : array, shape (n, 3)

    Raises
    ------
    ValueError
        A direction is no unit vector, or points where the map has no data.
    """
    return lobing.at(to_probe(frame, unit_vectors(outward)))


def combined_deviation_mm(deviation_mm: F2, probe_mm: F1, outward: F2) -> F2:
    """Actual minus reading of the ball centre: geometry plus probe, delta + Probe n.

    A positive Probe means a reading too near the part, so it moves the corrected ball centre outward. One value per touched point.

    Parameters
    ----------
    deviation_mm : array, shape (n, 3)
        Actual minus reading from the geometry alone.
    probe_mm : array, shape (n,)
        `probe_error_mm`.
    outward : array, shape (n, 3)
        Unit normal from part to ball centre.

    Raises
    ------
    ValueError
        Shapes do not agree, or a direction is no unit vector.
    """
    off, n, value = finite_vectors(deviation_mm), unit_vectors(outward), np.asarray(probe_mm, dtype=np.float64)
    if off.shape != n.shape or value.shape != n.shape[:-1] or not np.isfinite(value).all():
        raise ValueError(f"combined model: deviations {off.shape}, directions {n.shape} and probe errors {value.shape} do not fit together")
    return off + value[..., None] * n


def printed_eq17_mm(deviation_mm: F2, probe_mm: F1, outward: F2, m: Reading17) -> F2:
    """P (17), delta - Probe M, for either meaning of M; the map is indexed by the outward direction in both.

    ``"approach"`` (M = -n) is `combined_deviation_mm`. ``"outward"`` (M = n) moves the point the wrong way; it stands here because the
    text does not say which is meant (math.md 3, CONV).

    Raises
    ------
    ValueError
        As `combined_deviation_mm`, or ``m`` is neither.
    """
    if m not in ("approach", "outward"):
        raise ValueError(f"eq (17): M is 'approach' or 'outward', got {m!r}")
    direction = np.asarray(outward, dtype=np.float64) * (-1.0 if m == "approach" else 1.0)
    return combined_deviation_mm(deviation_mm, -np.asarray(probe_mm, dtype=np.float64), direction)


def contact_point_mm(reading_mm: F2, combined_mm: F2, effective_radius_mm: float, outward: F2) -> F2:
    """Touched point on the part: reading + combined deviation - effective radius along the outward normal.

    Parameters
    ----------
    reading_mm, combined_mm, outward : arrays, shape (n, 3)
    effective_radius_mm : float

    Raises
    ------
    ValueError
        Not finite, or a direction is no unit vector.
    """
    if not np.isfinite(effective_radius_mm):
        raise ValueError("contact point: the effective radius must be finite")
    return finite_vectors(reading_mm) + finite_vectors(combined_mm) - effective_radius_mm * unit_vectors(outward)


def unit_vectors(value: F2) -> F2:
    """Vectors that are of length one.

    Raises
    ------
    ValueError
        One is not, or is not finite.
    """
    v = finite_vectors(value)
    if (np.abs(np.linalg.norm(v, axis=-1) - 1.0) > UNIT).any():
        raise ValueError("touching direction: expected unit vectors")
    return v
