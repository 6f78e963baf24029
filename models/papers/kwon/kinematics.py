"""Forward and inverse kinematics of the 3-PUU machine, its links and its Jacobian. Source: Kwon 2004 (1)-(11), math.md 6 with errata."""

from __future__ import annotations

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
from abbe.models.papers.kwon.geometry import Geometry, poses

Branch = Literal["outside", "folded"]
"""Base joint outside the platform joint (C + root, the machine as built) or inside it (C - root, the folded assembly)."""

SINGULAR = 1e-6
"""Sine or cosine below which links count as horizontal or perpendicular: well above the rounding of a root (1e-8), 0.2 seconds of arc."""


def forward(geometry: Geometry, lambda_mm: F2) -> F2:
    """Ball centre for commands of the drives: where three spheres meet, above their centres.

    Exact for legs that differ from each other; for equal dz it is eq (4) with the factor 1/2 that the paper lost (math.md 3, K (4)).

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
    u = np.where(line[:, None, None], np.eye(3)[:2], u)  # any plane: so that the other poses can still be judged
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
    """Eq (4) exactly as Kwon printed it, without the factor 1/2: WRONG, for comparison only (math.md 3, K (4)).

    Parameters and result as `forward`; of the legs' differences the printed equation knows only R, r and the angles.

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
    """Commands of the drives that bring the ball centre to a position: (9)-(11).

    The paper calls (9) a forward solution; it is the inverse one, and its root is right for base joints outside (math.md 3, K (9), (11)).

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
    """Link vectors from the lower to the upper joint, s2 - s1 of (2), (3), shape (n, 3 legs, 3), mm; eq (1) demands the length l.

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
    """det[l1 l2 l3] of unit link vectors, shape (n,): 0 is a parallel singularity, +-1 three perpendicular links."""
    return np.asarray(np.linalg.det(vectors_mm / np.linalg.norm(vectors_mm, axis=2)[..., None]))


def jacobian(geometry: Geometry, lambda_mm: F2, p_mm: F2 | None = None) -> F3:
    """dP/dlambda, shape (n, 3 coordinates, 3 legs): l_i . dP = -(l_i . b_i) dlambda_i (math.md 6).

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
    """dlambda/dP, shape (n, 3 legs, 3 coordinates).

    Raises
    ------
    SerialSingularity
        A link stands perpendicular to its rail.
    """
    v = links(geometry, lambda_mm, forward(geometry, lambda_mm) if p_mm is None else p_mm)
    along_rail = (v * geometry.rails).sum(axis=2)
    refuse(SerialSingularity, np.abs(along_rail) < SINGULAR * geometry.l_mm, "the link stands perpendicular to its rail")
    result: F3 = -v / along_rail[..., None]
    return result


def solve_links(vectors_mm: F3, pull: F2) -> F3:
    """Move of the ball centre, shape (n, 3, 3 legs), for one leg's constraint changed at a time: l_i . dP = pull_i.

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
    """Smallest and largest command needed at the corners of the square |x|, |y| <= half at one height.

    Raises
    ------
    UnreachableLeg, SerialSingularity, LinksHorizontal, ParallelSingularity, PlatformBelow
        A corner (row of (-,-), (-,+), (+,-), (+,+)) cannot be reached.
    """
    corner = np.array([[x, y, z_mm] for x in (-half_mm, half_mm) for y in (-half_mm, half_mm)])
    needed = inverse(geometry, corner)
    return float(needed.min()), float(needed.max())


def _collinear(geometry: Geometry, u: F3) -> Fault:
    """Seen from above: that is the determinant of (4), scaled by the longer distance."""
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
    """Unit normal of the plane of the sphere centres, the upward one; along z where they lie on a line and span no plane."""
    normal = np.cross(u[:, 0], u[:, 1])
    length = np.linalg.norm(normal, axis=1)[:, None]
    unit = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), np.array([0.0, 0.0, 1.0]))
    return np.asarray(unit * np.where(unit[:, 2] < 0.0, -1.0, 1.0)[:, None])


def _above_centres(geometry: Geometry, lambda_mm: F2, p_mm: F2) -> F1:
    """Height of positions above the plane of the sphere centres, shape (n,): h itself when all dz are equal."""
    centre = geometry.centres_mm(lambda_mm)
    if (geometry.dz_mm == geometry.dz_mm[0]).all():
        level: F1 = p_mm[:, 2] - centre[:, 0, 2]
        return level
    return np.asarray(((p_mm - centre[:, 0]) * _up(centre[:, 1:] - centre[:, :1])).sum(axis=1))
