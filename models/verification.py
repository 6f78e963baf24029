"""Figures of a verification run, each with its standard uncertainty: range and reversal of a body diagonal, helix rms, rms of an artefact
in a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import RunData, bar_normals, nominal_reading
from abbe.models.solvers.observe import LOST, predict, run_jacobian
from abbe.models.solvers.priors import U_WAVELENGTH

if TYPE_CHECKING:
    from abbe.models.solvers.joint import JointSolution

SAME_MM = 3.0
NEAR_MM = 0.01
"""Positions along a line that differ by less than this are the same."""
U_REPEAT_MM = 1e-4
"""Repeatability of the helix figure after mounting the ball-bar again: assumed, not measured."""


@dataclass(frozen=True)
class VerificationFigure:
    """A figure, its standard uncertainty, and its curve, mm: deviation over the position on the diagonal or the index on the helix."""

    value_mm: float
    u_mm: float
    position_mm: F1
    deviation_mm: F1


def diagonal_figure(run: RunData, turning_mm: Sequence[F1] = ()) -> VerificationFigure:
    """Return the range of the mean deviation (out and back) along a body diagonal, with its uncertainty (ISO 230-6 style).

    Half of (out - back) is lost motion; its scatter gives the noise. The wavelength adds an uncertainty proportional to the
    length. Readings are paired by their position on the line, so a missing reading removes only its own pair. ``turning_mm``: where the
    machine turned beyond the ends, (3,) each; these are no positions of the test.

    Raises
    ------
    ValueError
        Fewer than 3 positions were measured out and back.
    """
    position, out, back, _ = _out_and_back(run, turning_mm)
    mean, length = (out + back) / 2, position[-1] - position[0]
    scatter = float(np.std((out - back) / 2, ddof=1))  # a mean of two readings has the same scatter
    return VerificationFigure(float(np.ptp(mean)), float(np.hypot(np.sqrt(2.0) * scatter, U_WAVELENGTH * length)), position, mean)


def reversal_figure(run: RunData, turning_mm: Sequence[F1] = ()) -> VerificationFigure:
    """Return the size of the mean reversal value along a body diagonal, with its uncertainty (ISO 230-2, mean reversal value).

    The curve is out minus back. The uncertainty combines the curve's scatter over the positions with the effect of a drift during the run,
    which is the part of the curve that grows with the time between both readings. A reversal that varies along the diagonal enlarges both.
    Without ``turning_mm`` the two ends, where the machine does not move between both readings, are left out if three other positions
    remain. Parameters and errors as for `diagonal_figure`.
    """
    position, out, back, waited_s = _out_and_back(run, turning_mm)
    inner = slice(1, -1) if not turning_mm and len(position) >= 5 else slice(None)
    reversal, late_s = (out - back)[inner], waited_s[inner] - waited_s[inner].mean()
    drift = float(late_s @ reversal / max(late_s @ late_s, 1e-12)) * float(waited_s[inner].mean())
    u = np.hypot(float(np.std(reversal, ddof=1)) / np.sqrt(len(reversal)), drift / np.sqrt(3.0))
    return VerificationFigure(float(abs(np.mean(reversal))), float(u), position[inner], reversal)


def _out_and_back(run: RunData, turning_mm: Sequence[F1]) -> tuple[F1, F1, F1, F1]:
    """Return the positions along a diagonal, the deviations there on the way out and back, mm, and the time between both, s."""
    assert run.beam is not None
    s = np.round((run.axes_mm - run.axes_mm[0]) @ run.beam, 4)
    turns = [float((point - run.axes_mm[0]) @ run.beam) for point in turning_mm]
    places = [p for p in np.unique(s) if all(abs(p - turn) > NEAR_MM for turn in turns)]
    turn = int(np.argmax(s))
    out, back = ({float(s[i]): i for i in way} for way in (range(turn + 1), range(turn + 1, len(s))))
    both = [float(p) for p in places if float(p) in out and float(p) in back]
    if len(both) < 3:
        raise ValueError(f"run {run.label}: fewer than 3 positions were measured out and back")
    first, second = [out[p] for p in both], [back[p] for p in both]
    return np.array(both), run.deviation_mm[first], run.deviation_mm[second], run.t_s[second] - run.t_s[first]


def helix_figure(run: RunData) -> VerificationFigure:
    """Return the rms of the ball-bar deviation after a fit of cup offset and bar length, with its uncertainty and residual curve.

    The fit removes the mounting and leaves the machine's error about this centre. The uncertainty combines the noise of the block means
    (from second differences) and `U_REPEAT_MM`.
    """
    n = bar_normals(run)
    a = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    y = run.deviation_mm - nominal_reading(run)
    left = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
    rms = float(np.sqrt(np.mean(left**2)))
    second = left[2:] - 2 * left[1:-1] + left[:-2]
    noise = float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6.0))
    return VerificationFigure(rms, float(np.hypot(noise / np.sqrt(len(left)), U_REPEAT_MM)), np.arange(len(left), dtype=np.float64), left)


def same_pose(a: RunData, b: RunData) -> bool:
    """Whether the artefact had the same pose in two runs, within `SAME_MM`: same orientation, touched points around the same place."""
    p, q = a.points, b.points
    if p is None or q is None or q.source == "length" or p.artefact != q.artefact or not np.allclose(p.matrix, q.matrix, atol=1e-3):
        return False
    zero = [r.axes_mm[0] - one.matrix @ one.nominal_mm[0] for r, one in ((a, p), (b, q))]
    return float(np.linalg.norm(zero[1] - zero[0])) < SAME_MM


def pose_figure(run: RunData, known: JointSolution, *, with_machine: bool = False) -> VerificationFigure:
    """Return the rms deviation of the machine over an artefact whose form is known from a solution, after a fit of the pose.

    ``with_machine``: the figure is the rms of the deviation minus the solution's own prediction. Without a calibrated length the common
    scale is fitted, too. Noise and the uncertainty of the form enlarge the rms: their expected share is subtracted from its square. Noise
    and form also give the uncertainty of the result.
    """
    p = run.points
    assert p is not None
    n_machine, theta = len(known.terms) + LOST, known.estimate.theta.copy()
    if not with_machine:
        theta[:n_machine] = 0.0
    turned = np.stack([np.cross(axis, p.nominal_mm) for axis in np.eye(3)], axis=2)
    rows = np.arange(len(p.component))
    free = [p.matrix.T[p.component], turned[rows, p.component] / p.reach_mm]
    free += [] if p.calibrated else [(p.nominal_mm - p.middle_mm)[rows, p.component][:, None] / p.reach_mm]
    basis, size, _ = np.linalg.svd(np.concatenate(free, axis=1), full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]

    def without_pose(v: F2) -> F2:
        return np.asarray(v - basis @ (basis.T @ v))

    y = run.deviation_mm - predict(known.machine, known.terms, run, known.setup, theta)
    left = without_pose(y[:, None])[:, 0]
    slope = without_pose(run_jacobian(known.machine, known.terms, run, known.setup, theta)[:, n_machine:])
    free_noise = np.eye(len(left)) - basis @ basis.T
    covariance = slope @ known.estimate.covariance[n_machine:, n_machine:] @ slope.T
    covariance += known.noise_mm["artefact"] ** 2 * (free_noise / run.weight_n) @ free_noise
    square = max(float(np.mean(left**2) - np.trace(covariance) / len(left)), 0.0)
    u_square = float(np.sqrt(4.0 * left @ covariance @ left + 2.0 * np.sum(covariance**2))) / len(left)
    rms, u = np.sqrt(square), u_square / (np.sqrt(square) + np.sqrt(square + u_square))
    return VerificationFigure(float(rms), float(u), np.arange(len(left), dtype=np.float64), left)
