"""A scale that changes while the machine is measured, as of a ball screw that warms up: found in the residuals, stated, part of U.

The solution's scales are averages over the campaign. A screw that grows by 6 um/m in that time has another scale before and after it, which
no reading of the campaign shows. ISO 230-3:2020, clause 7, measures this growth for itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, score
from abbe.models.solvers.observations import RunData

CLEAR = 4.0
"""A change is stated if it is this many times its standard uncertainty: by chance one campaign in some 5,000."""


@dataclass(frozen=True, slots=True)
class ScaleDrift:
    """Change of one axis' scale from the first to the last reading: ``change`` and its standard uncertainty ``u``, relative.

    ``moved``: what the change, which the solution takes as none, does to its unknowns, shape (p,).
    """

    axis: int
    change: float
    u: float
    moved: F1


def scale_drifts(problem: CampaignProblem, fit: CampaignFit) -> tuple[ScaleDrift, ...]:
    """Clear changes of scales, linear in time, that the residuals of a campaign with ball-bar or laser show."""
    t_s = np.concatenate([run.t_s for run in problem.runs])
    span_s = float(np.ptp(t_s))
    if span_s <= 0.0:
        return ()
    share = (t_s - t_s.min()) / span_s - 0.5
    middle = problem.machine.stroke_mm.mean(axis=1)
    columns = np.concatenate([_directions(run) * (run.axes_mm - middle) for run in problem.runs]) * share[:, None]
    asked, information, moved = score(problem, fit, columns)
    seen = np.flatnonzero(information.diagonal() > 0.0)
    covariance = np.linalg.pinv(information[np.ix_(seen, seen)], hermitian=True)
    found = zip(seen, covariance @ asked[seen], np.sqrt(np.maximum(covariance.diagonal(), 0.0)), strict=True)
    return tuple(ScaleDrift(int(a), float(v), float(u), v * moved[:, a]) for a, v, u in found if u > 0.0 and abs(v) > CLEAR * u)


def drift_factor(problem: CampaignProblem, drifts: tuple[ScaleDrift, ...]) -> F2:
    """Factor (p, 2 k) of the covariance that changing scales add: what the changes do to the solution, and the scales at another time.

    At another time a scale may differ by up to as much as it changed meanwhile (rectangular, GUM 4.3.7).
    """
    scales = np.zeros((len(problem.names), len(drifts)))
    for k, one in enumerate(drifts):
        at = problem.names.index(("EXX.1", "EYY.1", "EZZ.1")[one.axis])
        scales[at, k] = one.change * problem.machine.length_mm[one.axis] / 2.0 / np.sqrt(3.0)
    return np.concatenate([np.stack([one.moved for one in drifts], axis=1), scales], axis=1)


def _directions(run: RunData) -> F2:
    """Change of the reading per displacement of the tool along X, Y, Z, shape (n, 3)."""
    if run.kind == "laser":
        beam: F1 = np.zeros(3) if run.beam is None else run.beam
        return np.broadcast_to(beam, run.axes_mm.shape)
    if run.centre_mm is None:
        return np.zeros_like(run.axes_mm)
    bar = run.axes_mm - run.centre_mm
    return np.asarray(bar / np.linalg.norm(bar, axis=1, keepdims=True))
