"""The translational 3-PUU machine: geometry (nominal or with errors per leg), forward and inverse kinematics, Jacobian, sensitivities.

Source: Kwon 2004 (1)-(11), with errata.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.papers.kwon.errors import (
    CollinearSphereCentres,
    Fault,
    LinksHorizontal,
    NoForwardSolution,
    ParallelSingularity,
    PlatformBelow,
    SerialSingularity,
    UnreachableLeg,
    refuse,
    refuse_first,
)

LEGS = 3
THIRDS = np.array([0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0])
PER_LEG = ("R", "r", "l", "thb", "thp", "dz")
"""Parameters that may differ from leg to leg: short names of fields of `Geometry`, which `FIELDS` lists."""
FIELDS = {"R": "R_mm", "r": "r_mm", "l": "l_mm", "thb": "theta_b_rad", "thp": "theta_p_rad", "dz": "dz_mm"}
COMMON = ("l_up_mm", "l_dw_mm", "theta_rad", "le_mm")
Branch = Literal["outside", "folded"]
"""Base joint farther out than the platform joint (C + root, the machine as built) or farther in (C - root, the folded assembly)."""
SINGULAR = 1e-6
"""Sine or cosine below which links count as horizontal or perpendicular: 0.2 arc seconds, well above the rounding of a root (1e-8)."""


def _zeros() -> F1:
    return np.zeros(LEGS)


@dataclass(frozen=True)
class Geometry:
    """Geometry of the machine: three linear drives, three links of constant length, a platform that only translates (Kwon 2.1, Fig. 2).

    Base frame: origin in the base plane at the middle of the drives, z up, drive 1 along +x. A drive moves its joint by ``lambda`` TOWARDS
    the origin. A single number for a parameter of the legs holds for all legs.

    Parameters
    ----------
    R_mm, r_mm, l_mm : float or array, shape (3,)
        Base radius at lambda = 0, platform radius, link length between its joints.
    l_up_mm, l_dw_mm, theta_rad : float
        Lengths of the upper and lower joint brackets and their constant elevation (theta_up = theta_dw).
    le_mm : float
        Ball centre above the platform.
    theta_b_rad, theta_p_rad : array, shape (3,)
        Directions of the drives and of the platform's corners about z; default 0, 120, 240 degrees.
    dz_mm : float or array, shape (3,)
        Height of the base joints above the base plane.

    Raises
    ------
    ValueError
        A value is not finite, a shape does not fit, or a length that must be positive is zero or negative.
    """

    R_mm: F1
    r_mm: F1
    l_mm: F1
    l_up_mm: float
    l_dw_mm: float
    theta_rad: float
    le_mm: float
    theta_b_rad: F1 = field(default_factory=THIRDS.copy)
    theta_p_rad: F1 = field(default_factory=THIRDS.copy)
    dz_mm: F1 = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        """Expand single numbers to all legs and check the values."""
        for name in FIELDS.values():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape not in ((), (LEGS,)):
                raise ValueError(f"geometry: {name} must be one finite number or one for each of the 3 legs, got shape {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"geometry: {name} must be finite")
            object.__setattr__(self, name, np.broadcast_to(value, (LEGS,)).copy())
        for name in COMMON:
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != () or not np.isfinite(value):
                raise ValueError(f"geometry: {name} must be one finite number for all legs, got shape {value.shape} or a value not finite")
        if (self.R_mm <= 0).any() or (self.r_mm <= 0).any() or (self.l_mm <= 0).any():
            raise ValueError("geometry: R_mm, r_mm and l_mm must be positive")

    @property
    def r_hat_mm(self) -> F1:
        """Horizontal distance from the platform centre to the upper joint, (7), shape (3,)."""
        value: F1 = self.r_mm + self.l_up_mm * np.cos(self.theta_rad)
        return value

    @property
    def reach_mm(self) -> F1:
        """Horizontal distance from the origin to the lower joint at lambda = 0, (8), shape (3,)."""
        value: F1 = self.R_mm - self.l_dw_mm * np.cos(self.theta_rad)
        return value

    @property
    def lift_mm(self) -> F1:
        """Height of the sphere centres, (l_up + l_dw) sin(theta) + l_e + dz, shape (3,)."""
        value: F1 = (self.l_up_mm + self.l_dw_mm) * np.sin(self.theta_rad) + self.le_mm + self.dz_mm
        return value

    @property
    def rails(self) -> F2:
        """Unit vectors along the rails, outwards, shape (3 legs, 3)."""
        return _in_plan(self.theta_b_rad)

    @property
    def corners(self) -> F2:
        """Unit vectors from the platform centre to its corners, shape (3 legs, 3)."""
        return _in_plan(self.theta_p_rad)

    def centres_mm(self, lambda_mm: F2) -> F3:
        """Return the centres (-A, -B, lift) of the spheres on which the ball centre lies, (5), (6), shape (n, 3 legs, 3).

        Parameters
        ----------
        lambda_mm : array, shape (n, 3)
        """
        lambda_hat = self.reach_mm - lambda_mm
        centres: F3 = lambda_hat[..., None] * self.rails - self.r_hat_mm[:, None] * self.corners
        centres[..., 2] = self.lift_mm
        return centres

    def with_errors(self, errors: dict[str, F1]) -> Geometry:
        """Return the machine with deviations (actual - nominal) added.

        Parameters
        ----------
        errors : dict
            Names of PER_LEG to deviations, mm or rad: one number or shape (3,).

        Raises
        ------
        ValueError
            A name is not one of PER_LEG.
        """
        unknown = [name for name in errors if name not in FIELDS]
        if unknown:
            raise ValueError(f"geometry: no parameter is called {unknown[0]!r}; known are {', '.join(PER_LEG)}")
        return replace(self, **{FIELDS[name]: getattr(self, FIELDS[name]) + np.asarray(value) for name, value in errors.items()})


def poses(name: str, value: F2) -> F2:
    """Return a float64 array; ValueError if its shape is not (n, 3) or a number is not finite."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != LEGS:
        raise ValueError(f"{name}: expected numbers of shape (n, 3), got shape {array.shape}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        more = f" and {bad.size - 1} more" if bad.size > 1 else ""
        raise ValueError(f"{name}: row {bad[0]}{more}: every number must be finite")
    return array


def _in_plan(angle_rad: F1) -> F2:
    return np.stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros(LEGS)], axis=1)


def forward(geometry: Geometry, lambda_mm: F2) -> F2:
    """Return the ball centre for commands of the drives: the intersection of three spheres, above their centres.

    The result is exact also for legs that differ. For equal dz it is (4) with the factor 1/2 that the paper lost.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm : array, shape (n, 3)

    Returns
    -------
    array, shape (n, 3), mm, base frame

    Raises
    ------
    CollinearSphereCentres, NoForwardSolution, LinksHorizontal, ParallelSingularity
        With the pose row in the message.
    """
    centre = geometry.centres_mm(poses("lambda_mm", lambda_mm))
    u = centre[:, 1:] - centre[:, :1]
    collinear = _collinear(geometry, u)
    line = collinear[1]
    u = np.where(line[:, None, None], np.eye(3)[:2], u)  # any plane will do; the other poses are still judged
    # In the plane of the centres: 2 u_i . q = |u_i|^2 + l_1^2 - l_i^2, q from the first centre.
    square = 0.5 * ((u**2).sum(axis=2) + geometry.l_mm[0] ** 2 - geometry.l_mm[1:] ** 2)
    gram = u @ np.swapaxes(u, 1, 2)
    q = np.einsum("nk,nkc->nc", np.linalg.solve(gram, square[..., None])[..., 0], u)
    height2 = np.where(line, geometry.l_mm[0] ** 2, geometry.l_mm[0] ** 2 - (q**2).sum(axis=1))
    scaled = height2 / geometry.l_mm[0] ** 2
    short = scaled < -(SINGULAR**2)
    flat = ~short & (scaled < SINGULAR**2)
    refuse_first(collinear, (NoForwardSolution, short, "the three links do not meet for these commands"), _flat(geometry, flat))
    result: F2 = centre[:, 0] + q + np.sqrt(height2)[:, None] * _up(u)
    return result


def forward_as_printed(geometry: Geometry, lambda_mm: F2) -> F2:
    """Evaluate (4) exactly as Kwon printed it, without the factor 1/2: WRONG, for comparison only.

    Parameters and result as in `forward`, but only R, r and the angles may differ between legs.

    Raises
    ------
    CollinearSphereCentres, NoForwardSolution
        With the pose row in the message.
    """
    centre = geometry.centres_mm(poses("lambda_mm", lambda_mm))
    a, b = -centre[..., 0], -centre[..., 1]
    refuse_first(_collinear(geometry, centre[:, 1:] - centre[:, :1]))
    matrix = np.stack([a[:, :1] - a[:, 1:], b[:, :1] - b[:, 1:]], axis=2)
    square = a**2 + b**2
    xy = np.linalg.solve(matrix, (square[:, 1:] - square[:, :1])[..., None])[..., 0]
    height2 = geometry.l_mm[0] ** 2 - (xy[:, 0] + a[:, 0]) ** 2 - (xy[:, 1] + b[:, 0]) ** 2
    refuse(NoForwardSolution, height2 < 0.0, "the link is too short for the printed equation (4)")
    return np.stack([xy[:, 0], xy[:, 1], np.sqrt(height2) + geometry.lift_mm[0]], axis=1)


def inverse(geometry: Geometry, p_mm: F2, branch: Branch = "outside") -> F2:
    """Return the commands of the drives that bring the ball centre to a position, (9)-(11).

    Erratum: the paper calls (9) a forward solution. Its sign of the root holds for the branch ``outside``.

    Parameters
    ----------
    geometry : Geometry
    p_mm : array, shape (n, 3)
        Base frame.
    branch : "outside" | "folded"

    Returns
    -------
    array, shape (n, 3)

    Raises
    ------
    UnreachableLeg, SerialSingularity
        With pose row and leg in the message.
    LinksHorizontal, ParallelSingularity, PlatformBelow
        With the pose row: the position lies in the plane of the sphere centres (within 1e-6 of the link length) or below it, where
        `forward` would not find it again.
    ValueError
        Unknown branch.
    """
    if branch not in ("outside", "folded"):
        raise ValueError(f"inverse: no branch is called {branch!r}; known are outside, folded")
    p = poses("p_mm", p_mm)
    joint = p[:, None, :] + geometry.r_hat_mm[:, None] * geometry.corners
    c = (joint * geometry.rails).sum(axis=2)
    h = joint[..., 2] - geometry.lift_mm
    d = joint[..., 0] ** 2 + joint[..., 1] ** 2 + h**2 - geometry.l_mm**2
    # Reach along the rail over the link length, squared: the cosine between link and rail.
    cosine2 = (c**2 - d) / geometry.l_mm**2
    short = cosine2 < -(SINGULAR**2)
    upright = ~short & (cosine2 < SINGULAR**2)
    root = np.sqrt(np.maximum(c**2 - d, 0.0))
    lambda_hat = c + root if branch == "outside" else c - root
    result: F2 = geometry.reach_mm - lambda_hat
    above = _above_centres(geometry, result, p) / geometry.l_mm[0]
    known = ~(short | upright).any(axis=1)
    refuse_first(
        (UnreachableLeg, short, "the link is too short to reach this position (C^2 < D)"),
        (SerialSingularity, upright, "the link stands perpendicular to its rail (C^2 = D), a serial singularity"),
        (PlatformBelow, known & (above <= -SINGULAR), "the position is below the links (h < 0), the other assembly of the machine"),
        _flat(geometry, known & (np.abs(above) < SINGULAR)),
    )
    return result


def links(geometry: Geometry, lambda_mm: F2, p_mm: F2) -> F3:
    """Return the link vectors from the lower to the upper joint, s2 - s1 of (2), (3), shape (n, 3 legs, 3), mm; (1): their length is l.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm, p_mm : arrays, shape (n, 3)

    Raises
    ------
    ValueError
        Shapes differ.
    """
    lam, p = poses("lambda_mm", lambda_mm), poses("p_mm", p_mm)
    if lam.shape != p.shape:
        raise ValueError(f"links: {lam.shape[0]} commands do not fit {p.shape[0]} positions")
    vectors: F3 = p[:, None, :] - geometry.centres_mm(lam)
    return vectors


def link_determinant(vectors_mm: F3) -> F1:
    """Return det[l1 l2 l3] of the unit link vectors, shape (n,): 0 at a parallel singularity, +-1 for perpendicular links."""
    return np.asarray(np.linalg.det(vectors_mm / np.linalg.norm(vectors_mm, axis=2)[..., None]))


def jacobian(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> F3:
    """Return dP/dlambda, shape (n, 3 coordinates, 3 legs), from l_i . dP = -(l_i . b_i) dlambda_i, b_i the direction of the rail.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm : array, shape (n, 3)
    p_mm : array, shape (n, 3), optional
        Position that belongs to the commands; computed when not given.

    Raises
    ------
    ParallelSingularity
        det[l1 l2 l3] = 0.
    """
    v = links(geometry, lambda_mm, forward(geometry, lambda_mm) if p_mm is None else p_mm)
    along_rail = (v * geometry.rails).sum(axis=2)
    return solve_links(v, -along_rail)


def inverse_jacobian(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> F3:
    """Return dlambda/dP, shape (n, 3 legs, 3 coordinates).

    Raises
    ------
    SerialSingularity
        A link is perpendicular to its rail.
    """
    v = links(geometry, lambda_mm, forward(geometry, lambda_mm) if p_mm is None else p_mm)
    along_rail = (v * geometry.rails).sum(axis=2)
    refuse(SerialSingularity, np.abs(along_rail) < SINGULAR * geometry.l_mm, "the link stands perpendicular to its rail")
    result: F3 = -v / along_rail[..., None]
    return result


def solve_links(vectors_mm: F3, pull: F2) -> F3:
    """Solve l_i . dP = pull_i for the move dP of the ball centre, one leg at a time; shape (n, 3, 3 legs).

    Raises
    ------
    ParallelSingularity
        det[l1 l2 l3] = 0.
    """
    refuse(
        ParallelSingularity, np.abs(link_determinant(vectors_mm)) < SINGULAR, "the link vectors lie in one plane, a parallel singularity"
    )
    result: F3 = np.linalg.inv(vectors_mm) * pull[:, None, :]
    return result


def square_commands(geometry: Geometry, half_mm: float, z_mm: float) -> tuple[float, float]:
    """Return the smallest and largest command at the corners of the square |x|, |y| <= half at one height.

    Raises
    ------
    UnreachableLeg, SerialSingularity, LinksHorizontal, ParallelSingularity, PlatformBelow
        A corner (row of (-,-), (-,+), (+,-), (+,+)) cannot be reached.
    """
    corner = np.array([[x, y, z_mm] for x in (-half_mm, half_mm) for y in (-half_mm, half_mm)])
    needed = inverse(geometry, corner)
    return float(needed.min()), float(needed.max())


def _collinear(geometry: Geometry, u: F3) -> Fault:
    """Find poses whose sphere centres lie on a line seen from above, by the scaled determinant of (4)."""
    det = u[:, 0, 0] * u[:, 1, 1] - u[:, 0, 1] * u[:, 1, 0]
    longest = (u[..., :2] ** 2).sum(axis=2).max(axis=1)
    bad = np.abs(det) <= SINGULAR * np.maximum(longest, SINGULAR * geometry.l_mm[0] ** 2)
    text = "the sphere centres lie on a line seen from above (det = 0; equal commands: vertical links)"
    return CollinearSphereCentres, bad, text


def _flat(geometry: Geometry, bad: NDArray[np.bool_]) -> Fault:
    level = bool((geometry.dz_mm == geometry.dz_mm[0]).all())
    kind = LinksHorizontal if level else ParallelSingularity
    text = "the links are horizontal (h = 0)" if level else "the links lie in the plane of the sphere centres"
    return kind, bad, f"{text}, a parallel singularity"


def _up(u: F3) -> F2:
    """Return the upward unit normal of the plane of the sphere centres; z if these lie on a line."""
    normal = np.cross(u[:, 0], u[:, 1])
    length = np.linalg.norm(normal, axis=1)[:, None]
    unit = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), np.array([0.0, 0.0, 1.0]))
    return np.asarray(unit * np.where(unit[:, 2] < 0.0, -1.0, 1.0)[:, None])


def _above_centres(geometry: Geometry, lambda_mm: F2, p_mm: F2) -> F1:
    """Return the height of positions above the plane of the sphere centres, shape (n,); if all dz are equal it is Kwon's h."""
    centre = geometry.centres_mm(lambda_mm)
    if (geometry.dz_mm == geometry.dz_mm[0]).all():
        level: F1 = p_mm[:, 2] - centre[:, 0, 2]
        return level
    return np.asarray(((p_mm - centre[:, 0]) * _up(centre[:, 1:] - centre[:, :1])).sum(axis=1))


def parameter_jacobian(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> dict[str, F3]:
    """Return dP/d(parameter of a leg) at fixed commands, for every name of PER_LEG.

    For each leg, l.l = l^2 gives l.dP = l dl + l.b dR - l.p dr + lambda_hat l.t_b dthb - r_hat l.t_p dthp + l_z dz. b and p are the unit
    vectors of rail and corner, t_b and t_p the same turned by +90 degrees about z. An offset of the command acts as -dR; errors of theta,
    l_up, l_dw and l_e act through R, r and dz and have no columns.

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
    """Return the names of the 18 columns of `parameter_design`: R1 R2 R3 r1 .. dz3."""
    return tuple(f"{name}{leg}" for name in PER_LEG for leg in (1, 2, 3))


def parameter_design(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> F3:
    """Return `parameter_jacobian` as one array, shape (n, 3 coordinates, 18)."""
    parts = parameter_jacobian(geometry, lambda_mm, p_mm)
    return np.concatenate([parts[name] for name in PER_LEG], axis=2)


def _turned(unit: F2) -> F2:
    """Turn unit vectors by +90 degrees about z."""
    return np.stack([-unit[:, 1], unit[:, 0], np.zeros(unit.shape[0])], axis=1)
