"""Errors of a plane that the poses of a probed artefact show, errors that they hide, and a further pose that would show the hidden ones.

The form of the artefact is unknown. So only errors of the machine that move relative to the artefact become visible. The analysis is of
first order. Its unknowns: fields of the machine in the plane up to degree 4 (27 without rigid motions), one pose per run, and the form;
without a calibrated length also the artefact's scale. Source: artefact-based self-calibration (reversal, rotation, translation), Evans,
Hocken and Estler 1996.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import ArtefactPoints
from abbe.models.solvers.observations import RunData

DEGREE = 4
HIDDEN, TOLERANCE = 0.02, 1e-3
"""`HIDDEN`: a field is hidden if form and poses leave less than this share of it unexplained. `TOLERANCE`: least singular value that
counts, as a share of the largest: poses that differ by only a millimetre give no information about micrometres.
"""
FLAT = 1e-3
SHIFT = 0.37
"""Proposed shift as a share of a pitch; not a simple fraction, so that it is no simple fraction of the screw's lead either."""


@dataclass(frozen=True)
class PoseRank:
    """Fields that the poses show: ``rank`` out of ``of``, without rigid motions. ``hidden``: named fields that leave no trace; ``cures``:
    further poses, each with the rank that it would give and the errors that it would show."""

    plane: str
    rank: int
    of: int
    hidden: tuple[str, ...]
    cures: tuple[tuple[str, int, tuple[str, ...]], ...]

    @property
    def text(self) -> str:
        """One line for people."""
        out = f"In the plane {self.plane} these poses show {self.rank} of {self.of} fields up to degree {DEGREE}"
        if not self.hidden:
            return out + "."
        out += f"; they hide: {', '.join(self.hidden)}."
        said = [f"{pose} ({rank} fields{': ' + ', '.join(shown) if shown else ''})" for pose, rank, shown in self.cures[:2]]
        return out + (f" A further pose would show more: {'; or '.join(said)}." if said else " A calibrated length would give the scale.")


def pose_rank(runs: tuple[RunData, ...], *, cures: bool = True) -> PoseRank | None:
    """Analyse the poses of one artefact in a plane; None for a workpiece, several artefacts, walls, or poses that are tilted.

    ``cures``: try further poses, too, which takes five times as long.
    """
    mine = [(r.axes_mm, r.points) for r in runs if r.points is not None and r.points.source == "probe"]
    if not mine or len({p.artefact for _, p in mine}) > 1 or any(p.normal.any() for _, p in mine):
        return None
    third = {int(np.argmax(np.abs(p.matrix[:, 2]))) for _, p in mine}
    if len(third) != 1 or are_tilted(runs):
        return None
    keep = [k for k in range(3) if k not in third]
    free = not any(r.points is not None and r.points.source == "length" for r in runs)
    poses = [_flat(axes, p, keep) for axes, p in mine]
    rank, hidden = _rank_and_hidden(poses, scale=free)
    found = []
    for name, pose in _candidates(poses) if cures else ():
        better, left = _rank_and_hidden([*poses, pose], scale=free)
        if better > rank:
            found.append((name, better, tuple(h for h in hidden if h not in left)))
    found.sort(key=lambda one: -one[1])
    return PoseRank("XYZ"[keep[0]] + "XYZ"[keep[1]], rank, 27, hidden, tuple(found))


def are_tilted(runs: tuple[RunData, ...]) -> bool:
    """Whether a probed artefact lay tilted in some pose, that is, in no plane of two machine axes."""
    return any(np.abs(r.points.matrix[:, 2]).max() < 1.0 - FLAT for r in runs if r.points is not None and r.points.source == "probe")


@dataclass(frozen=True)
class _Pose:
    """Positions in the plane (n, 2), feature numbers (n,), nominal places (n, 2), turn (2, 2); one row per point."""

    at: F2
    feature: NDArray[np.intp]
    nominal: F2
    turn: F2


def _flat(axes_mm: F2, p: ArtefactPoints, keep: list[int]) -> _Pose:
    names = {f: i for i, f in enumerate(dict.fromkeys(sorted(p.feature)))}
    _, first = np.unique([names[f] for f in p.feature], return_index=True)
    numbers = np.array([names[p.feature[i]] for i in first])
    return _Pose(
        stated_places(axes_mm[first], p.matrix, p.nominal_mm[first], keep), numbers, p.nominal_mm[first][:, :2], p.matrix[keep][:, :2]
    )


def stated_places(axes_mm: F2, matrix: F2, nominal_mm: F2, keep: list[int]) -> F2:
    """Return the nominal positions of the points in the plane of axes ``keep``, shape (n, 2), mm, centred on the measured ones."""
    lies = nominal_mm[:, :2] @ matrix[keep][:, :2].T
    return np.asarray(lies + (axes_mm[:, keep] - lies).mean(axis=0))


def _rank_and_hidden(poses: list[_Pose], *, scale: bool) -> tuple[int, tuple[str, ...]]:
    """Rank of the fields without rigid motions, and the named fields that are hidden."""
    every = np.concatenate([p.at for p in poses])
    middle, reach = 0.5 * (every.min(axis=0) + every.max(axis=0)), float(np.ptp(every, axis=0).max()) / 2.0
    fields = np.concatenate([_rows(p, _fields((p.at - middle) / reach)) for p in poses])
    free = _free(poses, reach, scale=scale)
    basis = np.linalg.svd(free, full_matrices=False)
    basis_u = basis[0][:, basis[1] > TOLERANCE * basis[1][0]]
    left = fields - basis_u @ (basis_u.T @ fields)
    value = np.linalg.svd(left, compute_uv=False)
    at = [(p, (p.at - middle) / reach) for p in poses]
    named = {name: np.concatenate([_rows(p, field(q)[:, :, None]) for p, q in at])[:, 0] for name, field in NAMED.items()}
    gone = tuple(n for n, v in named.items() if np.linalg.norm(v - basis_u @ (basis_u.T @ v)) < HIDDEN * np.linalg.norm(v))
    return int((value > TOLERANCE * np.linalg.norm(fields)).sum()), gone


def _rows(pose: _Pose, field: NDArray[np.float64]) -> F2:
    """Readings of fields (n, 2, k) in the artefact's axes, shape (2 n, k)."""
    return np.asarray(np.einsum("ji,njk->nik", pose.turn, field).reshape(2 * len(pose.at), -1))


def _fields(q: F2) -> NDArray[np.float64]:
    """Monomials of degree 1 to 4 in both directions, shape (n, 2, k)."""
    powers = [q[:, 0] ** i * q[:, 1] ** j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j]
    out = np.zeros((len(q), 2, 2 * len(powers)))
    for i, value in enumerate(powers):
        out[:, 0, 2 * i] = out[:, 1, 2 * i + 1] = value
    return out


SWIRL = "rotation growing with r²"
NAMED: dict[str, Callable[[F2], F2]] = {
    "scale": lambda q: q,
    "difference of the scales": lambda q: q * [1.0, -1.0],
    "squareness": lambda q: q[:, ::-1],
    SWIRL: lambda q: np.stack([-q[:, 1], q[:, 0]], 1) * (q**2).sum(1, keepdims=True),
    "scale growing with r²": lambda q: q * (q**2).sum(1, keepdims=True),
}


def _free(poses: list[_Pose], reach: float, *, scale: bool) -> F2:
    """Readings per unit of the artefact's form, pose and scale, shape (2 n, unknowns)."""
    count = max(int(p.feature.max()) for p in poses) + 1
    blocks = []
    for i, p in enumerate(poses):
        n = len(p.at)
        form, pose = np.zeros((n, 2, 2 * count)), np.zeros((n, 2, 3 * len(poses) + 1))
        rows = np.arange(n)
        form[rows, 0, 2 * p.feature] = form[rows, 1, 2 * p.feature + 1] = 1.0
        pose[:, 0, 3 * i] = pose[:, 1, 3 * i + 1] = 1.0
        pose[:, :, 3 * i + 2] = np.stack([-p.nominal[:, 1], p.nominal[:, 0]], axis=1) / reach
        pose[:, :, -1] = p.nominal / reach
        blocks.append(np.concatenate([form, pose], axis=2).reshape(2 * n, -1))
    whole = np.concatenate(blocks)
    return whole if scale else _without_scale(whole, poses, count)


def _without_scale(whole: F2, poses: list[_Pose], count: int) -> F2:
    """Take the scale of the artefact out of its free forms, because a length is calibrated."""
    places = np.zeros((count, 2))
    for p in poses:
        places[p.feature] = p.nominal
    used = np.unique(np.concatenate([p.feature for p in poses]))
    scale = np.zeros(2 * count)
    away = places - places[used].mean(axis=0)
    for f in used:
        scale[2 * f : 2 * f + 2] = away[f]
    scale /= np.linalg.norm(scale)
    form = whole[:, : 2 * count]
    return np.concatenate([form - np.outer(form @ scale, scale), whole[:, 2 * count : -1]], axis=1)


def _candidates(poses: list[_Pose]) -> list[tuple[str, _Pose]]:
    """Further poses: the first one turned about the artefact's centre, or shifted along an axis."""
    first = poses[0]
    middle = 0.5 * (first.at.min(axis=0) + first.at.max(axis=0))
    pitch = _pitch(first.at)
    out = []
    for degrees in (90, 180, 270):
        c, s = np.round(np.cos(np.deg2rad(degrees)), 12), np.round(np.sin(np.deg2rad(degrees)), 12)
        turn = np.array([[c, -s], [s, c]])
        out.append((f"turned by {degrees} degrees", replace(first, at=(first.at - middle) @ turn.T + middle, turn=turn @ first.turn)))
    for k, axis in enumerate(("first", "second")):
        move: F1 = np.zeros(2)
        move[k] = (1.0 + SHIFT) * pitch
        out.append((f"shifted along the {axis} axis by {move[k]:.0f} mm", replace(first, at=first.at + move)))
    return out


def _pitch(at: F2) -> float:
    away = np.linalg.norm(at[:, None] - at[None], axis=2)
    return float(np.median(np.where(away > 1.0, away, np.inf).min(axis=1)))
