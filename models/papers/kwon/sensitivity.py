"""What an error of each geometric parameter of each leg does to the ball centre (math.md 6, last lines of the kinematics)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2, F3
from abbe.models.papers.kwon.geometry import PER_LEG, Geometry
from abbe.models.papers.kwon.kinematics import forward, links, solve_links


def parameter_jacobian(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> dict[str, F3]:
    """dP/d(parameter of a leg) at fixed commands, for every name of PER_LEG.

    From l.l = l^2 for each leg: l.dP = l dl + l.b dR - l.p dr + lambda_hat l.t_b dthb - r_hat l.t_p dthp + l_z dz, with b, p the unit
    vectors of rail and corner and t_b, t_p those turned by +90 degrees about z (math.md 6, there for theta_p = theta_b, so p = b).
    An offset of the command is dR with the sign reversed; errors of theta, l_up, l_dw, l_e act through R, r and dz: no column of their own.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm : array, shape (n, 3)
    p_mm : array, shape (n, 3), optional
        Position that belongs to the commands; computed when not given.

    Returns
    -------
    dict of arrays, shape (n, 3 coordinates, 3 legs), mm per mm or mm per rad

    Raises
    ------
    ParallelSingularity
        det[l1 l2 l3] = 0.
    """
    v = links(geometry, lambda_mm, forward(geometry, lambda_mm) if p_mm is None else p_mm)
    b, p = geometry.rails, geometry.corners
    lambda_hat = geometry.reach_mm - lambda_mm
    pulls: dict[str, F2] = {
        "R": (v * b).sum(axis=2),
        "r": -(v * p).sum(axis=2),
        "l": np.broadcast_to(geometry.l_mm, v.shape[:2]),
        "thb": lambda_hat * (v * _turned(b)).sum(axis=2),
        "thp": -geometry.r_hat_mm * (v * _turned(p)).sum(axis=2),
        "dz": v[..., 2],
    }
    return {name: solve_links(v, pulls[name]) for name in PER_LEG}


def parameter_names() -> tuple[str, ...]:
    """Names of the 18 columns of `parameter_design`: R1 R2 R3 r1 .. dz3."""
    return tuple(f"{name}{leg}" for name in PER_LEG for leg in (1, 2, 3))


def parameter_design(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> F3:
    """`parameter_jacobian` side by side, shape (n, 3 coordinates, 18)."""
    parts = parameter_jacobian(geometry, lambda_mm, p_mm)
    return np.concatenate([parts[name] for name in PER_LEG], axis=2)


def _turned(unit: F2) -> F2:
    """Turned by +90 degrees about z."""
    return np.stack([-unit[:, 1], unit[:, 0], np.zeros(unit.shape[0])], axis=1)
