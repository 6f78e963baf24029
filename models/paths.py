"""Commanded positions of the tests, shared by sequences and solvers.

Lasers follow body diagonals in sequential or plain steps (Wang), face diagonals (ISO 230-6) and single-axis lines (ISO 230-2). Ball-bars
stay on a sphere about the cup: circles and arcs (ISO 230-4), hemispherical helices (Yang and Kim), and the links between them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2

DIAGONALS: dict[str, tuple[int, int, int]] = {"ppp": (1, 1, 1), "npp": (-1, 1, 1), "pnp": (1, -1, 1), "ppn": (1, 1, -1)}


def diagonal_ends(box_mm: F2, diagonal: str) -> tuple[F1, F1]:
    """Return start and end of a body diagonal of a box, by Wang's names: ``npp`` runs from large to small X.

    Parameters
    ----------
    box_mm : array, shape (3, 2)
        Lower and upper end of X, Y, Z, mm, in any frame.
    diagonal : str
        ppp, npp, pnp or ppn.

    Returns
    -------
    two arrays, shape (3,), mm, in the frame of the box.

    Raises
    ------
    ValueError
        The diagonal is unknown, or the box has another shape.
    """
    if diagonal not in DIAGONALS:
        raise ValueError(f"diagonal {diagonal!r}: must be one of {', '.join(DIAGONALS)}")
    if np.shape(box_mm) != (3, 2):
        raise ValueError(f"diagonal {diagonal}: the box must have shape (3, 2), got {np.shape(box_mm)}")
    signs = DIAGONALS[diagonal]
    start = np.array([box_mm[a, 0] if s > 0 else box_mm[a, 1] for a, s in enumerate(signs)])
    end = np.array([box_mm[a, 1] if s > 0 else box_mm[a, 0] for a, s in enumerate(signs)])
    return start, end


def step_diagonal(start_mm: F1, end_mm: F1, steps: int, order: str = "XYZ", *, back: bool = True) -> F2:
    """Return the positions of Wang's sequential step-diagonal test: the axes move one at a time in ``order``, ``steps`` times.

    With ``back``, the same positions follow in reverse order, so the turning point occurs twice. The paper's order is X, Y, Z.

    Parameters
    ----------
    start_mm, end_mm : array, shape (3,)
        Ends of the diagonal, e.g. from `diagonal_ends`.
    steps : int
        Steps per axis.
    order : str
        X, Y and Z once each.
    back : bool
        Whether to add the way back.

    Returns
    -------
    array, shape (3 steps + 1, 3), or twice as many rows with ``back``, mm: one position per record, the start first.

    Raises
    ------
    ValueError
        ``order`` does not name every axis once, or ``steps`` < 1.
    """
    if sorted(order) != ["X", "Y", "Z"] or steps < 1:
        raise ValueError(f"step diagonal: order {order!r} must name X, Y, Z once each, and steps = {steps} must be 1 or more")
    inc = (np.asarray(end_mm) - np.asarray(start_mm)) / steps
    counts = np.zeros((3 * steps + 1, 3))
    for k in range(3 * steps):
        counts[k + 1] = counts[k]
        counts[k + 1, "XYZ".index(order[k % 3])] += 1
    out: F2 = np.asarray(start_mm) + counts * inc
    out[-1] = end_mm
    return np.concatenate([out, out[::-1]]) if back else out


def straight_line(start_mm: F1, end_mm: F1, n: int, *, back: bool = True) -> F2:
    """Return ``n`` equidistant positions on a line (ISO 230-2) and, with ``back``, the same in reverse order, turning point twice.

    Parameters
    ----------
    start_mm, end_mm : array, shape (3,)
        First and last position.
    n : int
        Positions, both ends included.
    back : bool
        Whether to add the way back.

    Returns
    -------
    array, shape (n, 3), or (2 n, 3) with ``back``, mm.

    Raises
    ------
    ValueError
        Fewer than two positions.
    """
    if n < 2:
        raise ValueError(f"line: {n} positions given, 2 or more needed")
    out = np.linspace(start_mm, end_mm, n)
    return np.concatenate([out, out[::-1]]) if back else out


FACES: dict[str, tuple[str, str]] = {"XY": ("pp", "np"), "YZ": ("pp", "np"), "ZX": ("pp", "np")}
"""The six face diagonals (ISO 230-6): two in each plane; ``np`` runs from large to small along the plane's first axis."""


def face_ends(box_mm: F2, plane: str, diagonal: str, share: float) -> tuple[F1, F1]:
    """Return start and end of a face diagonal of a box, mm, while the third axis stands at ``share`` (0 to 1) of its length.

    Raises
    ------
    ValueError
        The plane or the diagonal is unknown.
    """
    if plane not in FACES or diagonal not in FACES[plane]:
        raise ValueError(f"face diagonal {plane} {diagonal}: the plane must be XY, YZ or ZX, the diagonal pp or np")
    a, b = ("XYZ".index(c) for c in plane)
    third = 3 - a - b
    start, end = box_mm[:, 0].copy(), box_mm[:, 0].copy()
    start[third] = end[third] = box_mm[third, 0] + share * (box_mm[third, 1] - box_mm[third, 0])
    start[a], end[a] = box_mm[a] if diagonal == "pp" else box_mm[a, ::-1]
    end[b] = box_mm[b, 1]
    return start, end


def target_shares(n: int, offset_share: float, seed: int) -> F1:
    """Return n target positions from 0 to 1: equidistant, each shifted by a pseudo-random part of the interval (ISO 230-2).

    ``offset_share`` is the largest shift as a share of the interval, below 0.5 so that the targets keep their order. The first and the
    last target shift inwards.
    """
    if n < 2 or not 0.0 <= offset_share < 0.5:
        raise ValueError(f"targets: {n} given, 2 or more needed; offset_share = {offset_share:g} must be at least 0 and below 0.5")
    step = 1.0 / (n - 1)
    offset = np.random.default_rng(seed).uniform(-1.0, 1.0, n) * offset_share * step
    offset[0], offset[-1] = abs(offset[0]), -abs(offset[-1])
    return np.asarray(np.linspace(0.0, 1.0, n) + offset)


def cycles_of(out_mm: F2, cycles: int, overrun_mm: float = 0.0) -> tuple[F2, F1]:
    """Return the positions of a bidirectional test, out and back ``cycles`` times, and the direction of each.

    Parameters
    ----------
    out_mm : array, shape (n, 3)
        Positions on the way out.
    cycles : int
    overrun_mm : float
        Travel of the machine beyond both ends before it turns, so that it approaches every target from the right side. These turning
        points are part of the result. Without an overrun the machine turns at the end positions, and each of these occurs twice in a row.

    Returns
    -------
    positions, shape (m, 3), mm, and directions, shape (m,): +1 out, -1 back.
    """
    if cycles < 1 or overrun_mm < 0.0:
        raise ValueError(f"cycles = {cycles} must be 1 or more, and overrun_mm = {overrun_mm:g} must be 0 or more")
    way, there = np.asarray(out_mm, dtype=np.float64), np.ones(len(out_mm))
    if overrun_mm == 0.0:
        once, sign = np.concatenate([way, way[::-1]]), np.concatenate([there, -there])
        return np.tile(once, (cycles, 1)), np.tile(sign, cycles)
    first, last = way[0] - overrun_mm * _unit(way[1] - way[0]), way[-1] + overrun_mm * _unit(way[-1] - way[-2])
    rows, signs = [first[None]], [np.ones(1)]
    for _ in range(cycles):
        rows += [way, last[None], way[::-1], first[None]]
        signs += [there, np.ones(1), -there, -np.ones(1)]
    return np.concatenate(rows), np.concatenate(signs)


def _unit(v: F1) -> F1:
    return np.asarray(v / np.linalg.norm(v))


Plane = Literal["XY", "YZ", "ZX"]
PLANES: tuple[Plane, ...] = ("XY", "YZ", "ZX")
FAR_RAD = np.deg2rad(150.0)
"""If two points are farther apart, the path goes over the pole, clear of the cup."""
LOW_RAD = np.deg2rad(30.0)
"""Limit as `FAR_RAD`, if one of the points lies below the equator."""
VERY_LOW = 0.7
"""From a point lower than this share of the radius below the equator, even a short path may hit the foot of the cup."""


def circle_points(centre_mm: F1, radius_mm: float, plane: Plane, angles_rad: F1) -> F2:
    """Return points of a circle in a plane of two axes at given angles, counted from the plane's first axis to its second.

    Parameters
    ----------
    centre_mm : array, shape (3,)
    plane : "XY", "YZ" or "ZX"
    angles_rad : array, shape (n,)

    Returns
    -------
    array, shape (n, 3), mm, in the frame of ``centre_mm``.

    Raises
    ------
    ValueError
        The plane is unknown, the radius is not positive, or the centre is not three finite numbers.
    """
    if plane not in PLANES:
        raise ValueError(f"circle: plane {plane!r} must be XY, YZ or ZX")
    if not 0 < radius_mm < np.inf or np.shape(centre_mm) != (3,) or not np.isfinite(centre_mm).all():
        raise ValueError("circle: radius must be positive and the centre three finite numbers")
    out: F2 = np.tile(np.asarray(centre_mm, dtype=np.float64), (len(angles_rad), 1))
    a, b = ("XYZ".index(c) for c in plane)
    out[:, a] += radius_mm * np.cos(angles_rad)
    out[:, b] += radius_mm * np.sin(angles_rad)
    return out


def arc_through(centre_mm: F1, at_mm: F1, along: F1, angles_rad: F1) -> F2:
    """Return points of the great circle through ``at_mm`` in the direction ``along``, at given angles from ``at_mm`` (negative: before it).

    Such an arc leads into a path, or out of a path, without a corner. It stays on the sphere, so that a mounted bar keeps its length.

    Parameters
    ----------
    centre_mm, at_mm : array, shape (3,)
        Centre of the sphere; a point on it.
    along : array, shape (3,)
        Direction of motion at ``at_mm``; only its component tangential to the sphere is used.
    angles_rad : array, shape (n,)

    Returns
    -------
    array, shape (n, 3), mm.

    Raises
    ------
    ValueError
        The point is the centre, or the direction has no tangential component.
    """
    out = np.asarray(at_mm, dtype=np.float64) - centre_mm
    radius = float(np.linalg.norm(out))
    if not radius > 0.0:
        raise ValueError("arc: the start point is the centre of the sphere")
    out = out / radius
    tangent = np.asarray(along, dtype=np.float64) - out * float(np.dot(along, out))
    size = float(np.linalg.norm(tangent))
    if not size > 1e-12:
        raise ValueError("arc: the direction is radial or zero, it must have a component along the sphere")
    tangent = tangent / size
    return np.asarray(centre_mm + radius * (np.outer(np.cos(angles_rad), out) + np.outer(np.sin(angles_rad), tangent)))


def way_on_sphere(centre_mm: F1, start_mm: F1, end_mm: F1, up: F1, chord_mm: float) -> F2:
    """Return points of a path on the sphere between two of its points, about ``chord_mm`` apart at most, both ends included.

    The path is the shorter great-circle arc. It goes over the pole if the points are nearly opposite, or if a point lies so low that the
    shorter arc could lead under the cup (`FAR_RAD`, `LOW_RAD`, `VERY_LOW`).

    Parameters
    ----------
    up : array, shape (3,)
        Unit vector from the centre to the pole, on the spindle's side.
    """
    a, b = (np.asarray(p, dtype=np.float64) - centre_mm for p in (start_mm, end_mm))
    radius = float(np.linalg.norm(a))
    angle = _angle(a, b)
    lowest = min(float(a @ up), float(b @ up)) / radius
    if angle > FAR_RAD or (lowest < -0.02 and angle > LOW_RAD) or lowest < -VERY_LOW:
        pole = centre_mm + radius * np.asarray(up)
        first, second = _short(centre_mm, start_mm, pole, chord_mm), _short(centre_mm, pole, end_mm, chord_mm)
        return np.concatenate([first, second[1:]])
    return _short(centre_mm, start_mm, end_mm, chord_mm)


def _short(centre_mm: F1, start_mm: F1, end_mm: F1, chord_mm: float) -> F2:
    start, end = (np.asarray(p, dtype=np.float64) for p in (start_mm, end_mm))
    a, b = start - centre_mm, end - centre_mm
    angle = _angle(a, b)
    n = max(1, int(np.ceil(angle * float(np.linalg.norm(a)) / chord_mm)))
    if angle < 1e-9:
        return np.stack([start, end])
    if angle > np.pi - 1e-6:
        b = b + 1e-3 * float(np.linalg.norm(b)) * _across(b)
        angle = _angle(a, b)
    inner = arc_through(centre_mm, start, b - a, np.linspace(0.0, angle, n + 1))
    return np.concatenate([start[None], inner[1:-1], end[None]])


def _angle(a: F1, b: F1) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _across(v: F1) -> F1:
    helper = np.eye(3)[int(np.argmin(np.abs(v)))]
    out = np.cross(v, helper)
    return np.asarray(out / np.linalg.norm(out))


Law = Literal["angle", "area"]
FINER, GROWS = 8, 0.2
"""`even_helix_points` adds up the length in pieces FINER times shorter than the point distances, which vary by GROWS about their mean."""


def helix_points(
    centre_mm: F1, radius_mm: float, *, turns: float, n: int, law: Law = "angle", axis: int = 1, span_rad: float = np.pi / 2
) -> F2:
    """Return points of a hemispherical helix from the pole to the equator.

    Parameters
    ----------
    centre_mm : array, shape (3,)
    radius_mm : float
    turns, n : float, int
        Turns about the hemisphere's axis and number of points, both ends included.
    law : "angle" | "area"
        ``angle``: colatitude grows uniformly; ``area``: cos(colatitude) falls uniformly, so that every band of the sphere gets points in
        proportion to its area.
    axis : int
        Axis of the hemisphere: 0 X, 1 Y (the paper's horizontal-spindle machine), 2 Z.
    span_rad : float
        Largest colatitude, pi/2 for the full hemisphere.

    Returns
    -------
    array, shape (n, 3), mm, in the frame of ``centre_mm``. For ``axis`` 1: O + R (sin f cos t, cos f, sin f sin t).

    Raises
    ------
    ValueError
        n < 2, radius not positive, turns not finite, span outside (0, pi/2], unknown law, axis not 0, 1 or 2, or a centre that is not three
        finite numbers. Fewer than three turns are accepted, but such a helix determines few errors.
    """
    if n < 2 or not 0 < radius_mm < np.inf or not np.isfinite(turns) or not 0 < span_rad <= np.pi / 2:
        raise ValueError(
            f"helix: n = {n} must be 2 or more, radius {radius_mm:g} mm positive, turns {turns:g} finite, span {span_rad:g} in (0, pi/2]"
        )
    if law not in ("angle", "area"):
        raise ValueError(f"helix: law {law!r} must be 'angle' or 'area'")
    if axis not in (0, 1, 2):
        raise ValueError(f"helix: axis {axis} must be 0, 1 or 2")
    if np.shape(centre_mm) != (3,) or not np.isfinite(centre_mm).all():
        raise ValueError(f"helix: the centre must be three finite numbers, got {centre_mm!r}")
    return np.asarray(centre_mm) + radius_mm * _unit_helix(np.linspace(0.0, 1.0, n), turns, law, axis, span_rad)


def even_helix_points(centre_mm: F1, radius_mm: float, *, turns: float, n: int, law: Law = "area", axis: int = 2) -> F2:
    """Return points of the same curve as `helix_points`, but at distances that grow from 0.8 to 1.2 of their mean.

    By the area law alone, points lie several times farther apart at the pole than elsewhere. Exactly equal distances at a constant feed
    would sample at one fixed frequency, at which a vibration can look like a slow error.

    Parameters, result and errors are those of `helix_points` for the full hemisphere.
    """
    fine = np.linspace(0.0, 1.0, FINER * n) ** 2  # the area law leaves the pole like a square root
    curve = _unit_helix(fine, turns, law, axis, 0.5 * np.pi)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    ends = helix_points(centre_mm, radius_mm, turns=turns, n=2, law=law, axis=axis)
    even = np.linspace(0.0, 1.0, n)[1:-1]
    between = np.interp(along[-1] * even * (1.0 - GROWS + GROWS * even), along, fine)
    inner = np.asarray(centre_mm) + radius_mm * _unit_helix(between, turns, law, axis, 0.5 * np.pi)
    return np.concatenate([ends[:1], inner, ends[1:]])


def _unit_helix(share: F1, turns: float, law: Law, axis: int, span_rad: float) -> F2:
    """Return points of a helix of radius 1 about the origin at shares 0..1 of its turns, shape (n, 3)."""
    phi = span_rad * share if law == "angle" else np.arccos(1.0 - share * (1.0 - np.cos(span_rad)))
    theta = 2 * np.pi * turns * share
    a, b = (0, 2) if axis == 1 else ((axis + 1) % 3, (axis + 2) % 3)
    out = np.empty((len(share), 3))
    out[:, axis] = np.cos(phi)
    out[:, a] = np.sin(phi) * np.cos(theta)
    out[:, b] = np.sin(phi) * np.sin(theta)
    return out


def helix_points_likely_code(centre_mm: F1, radius_mm: float, *, turns: float) -> F2:
    """Return the 63 points that Yang and Kim's program probably made: t = 0, 0.1, .. 6.2, colatitude t / 4, longitude ``turns`` t.

    The paper has 63 samples, as ``t = 0:0.1:2*pi`` would give, but this does not prove it. The last point is 0.021 rad above the equator.

    Parameters are those of `helix_points` with ``axis`` 1; the result has shape (63, 3), mm.

    Raises
    ------
    ValueError
        Radius not positive, or turns not finite.
    """
    if not 0 < radius_mm < np.inf or not np.isfinite(turns):
        raise ValueError(f"helix: radius {radius_mm:g} mm must be positive, and turns {turns:g} finite")
    t = 0.1 * np.arange(63)
    phi, theta = t / 4.0, turns * t
    unit = np.stack([np.sin(phi) * np.cos(theta), np.cos(phi), np.sin(phi) * np.sin(theta)], axis=1)
    return np.asarray(np.asarray(centre_mm) + radius_mm * unit)
