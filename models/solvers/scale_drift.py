"""A scale that changes while the machine is measured, such as a ball screw that warms up: the residuals show the change, and U includes it.

The solution's scales are averages over the campaign. A screw that grows by 6 um/m in that time has another scale before and after it, which
no reading of the campaign shows. A bar or a laser that changes has the same effect on the readings, so an axis is named only if it explains
them better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, Score

CLEAR = 8.0
"""A change is stated if its log evidence is this much above no change, a changing bar and a changing laser: four standard deviations."""
FORM = 0.3
"""Relative standard uncertainty of a change, because its true course in time is none of those tried, and other things drift as well."""
SCALES = ("EXX.1", "EYY.1", "EZZ.1")
SETTLING = (0.15, 0.4, 1.0)
"""Time constants of the courses that are tried beside a straight line, in durations of the campaign."""


@dataclass(frozen=True, slots=True)
class ScaleDrift:
    """Change of one axis' scale from the first to the last reading: ``change`` and its standard uncertainty ``u``, relative."""

    axis: int
    change: float
    u: float


def scale_drifts(problem: CampaignProblem, fit: CampaignFit) -> tuple[ScaleDrift, ...]:
    """The change of one scale that explains the residuals best and clearly better than a bar or a laser that changes; else none.

    ``change`` is the mean over several courses in time, by their evidence; ``u`` holds their spread, and `FORM`. If two scales change at
    once, only the clearer one is stated.
    """
    courses, (names, columns) = _courses(problem), _columns(problem)
    if not courses or not names:
        return ()
    score = Score.of(problem, fit)
    gains, values, variances = np.zeros((3, len(courses), len(names)))
    for k, course in enumerate(courses):
        asked, information = score.asked(columns * course[:, None])
        own = np.maximum(information.diagonal(), 1e-30)
        gains[k], values[k], variances[k] = 0.5 * asked**2 / own, asked / own, 1.0 / own
    evidence = np.logaddexp.reduce(gains) - np.log(len(courses))
    best = int(np.argmax(evidence))
    rivals = [e for n, e in zip(names, evidence, strict=True) if n not in SCALES]
    if names[best] not in SCALES or evidence[best] - max([0.0, *rivals]) < CLEAR:
        return ()
    weight = np.exp(gains[:, best] - gains[:, best].max())
    weight /= weight.sum()
    change = float(weight @ values[:, best])
    u = float(np.sqrt(weight @ (variances[:, best] + (values[:, best] - change) ** 2) + (FORM * change) ** 2))
    return (ScaleDrift(SCALES.index(names[best]), change, u),)


def drift_factor(problem: CampaignProblem, drifts: tuple[ScaleDrift, ...]) -> F2:
    """Factor (p, k) of the scales' covariance: at another time a scale may differ by up to its whole change (GUM 4.3.7)."""
    factor = np.zeros((len(problem.names), len(drifts)))
    for k, one in enumerate(drifts):
        factor[problem.names.index(SCALES[one.axis]), k] = one.change * problem.machine.length_mm[one.axis] / 2.0 / np.sqrt(3.0)
    return factor


def _courses(problem: CampaignProblem) -> tuple[F1, ...]:
    """Courses from 0 at the first to 1 at the last reading, less their mean: a straight line, and exponentials that settle (`SETTLING`)."""
    t_s = np.concatenate([run.t_s for run in problem.runs])
    span_s = float(np.ptp(t_s))
    if span_s <= 0.0:
        return ()
    share = (t_s - t_s.min()) / span_s
    found = (share, *(np.expm1(-share / tau) / np.expm1(-1.0 / tau) for tau in SETTLING))
    return tuple(one - one.mean() for one in found)


def _columns(problem: CampaignProblem) -> tuple[list[str], F2]:
    """Reading per relative change of each scale, of all bars and of the wavelength, mm, and their names."""
    r, rows = problem.readings, problem.sigma[:, None] * problem.readings.a / problem.sizes.typical
    found = {n: rows[:, problem.names.index(n)] * length / 2.0 for n, length in zip(SCALES, problem.machine.length_mm, strict=True)}
    radius = np.concatenate([np.full(run.t_s.size, run.radius_mm or 0.0) for run in problem.runs])
    found["bar"] = radius
    if "laser_scale" in problem.names:
        found["laser"] = rows[:, problem.names.index("laser_scale")]
    seen = {n: c for n, c in found.items() if np.any(c)}
    return list(seen), np.stack(list(seen.values()), axis=1) if seen else np.zeros((len(r.kind), 0))
