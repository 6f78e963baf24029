"""Whether contestants of the uncertainty part computed the same thing: a difference makes the bench fail."""

from __future__ import annotations

import numpy as np

from abbe.models.geometry.volume import remove_rigid
from tests.experiments.bench import trials_case as cases
from tests.experiments.bench.trials_contestants import TRIAL_CASES, Result

SAME_DRAWS_U = {"linear": 1e-6, "helix": 1e-2}
"""Largest difference of estimates for the same draws, in standard uncertainties. Linear: rounding. Helix: scipy as it comes, with forward
differences and a tolerance of 1e-8 of the sum of squares, stops up to 2e-3 away; with its tolerances at 1e-15 it is 1e-9."""
MEAN_SIGMAS, COVARIANCE_SIGMAS = 5.0, 6.0
"""Sampling error that means and elements of the covariance may differ by."""
SAME_U = 1e-6
JOINT_MM = 2e-3
"""A joint solution whose prediction is off by more (rms, rigid motion out) has solved nothing: the waves are 4 um each."""


def judged(name: str, results: dict[str, Result]) -> dict[str, dict]:
    """What each contestant of a case differs by, and whether that is allowed."""
    if name == "joint":
        return {k: _joint(r) for k, r in results.items()}
    ours = results[next(iter(TRIAL_CASES[name]))]
    if name == "propagation":
        return {k: _propagated(r, ours) for k, r in results.items()}
    case = cases.linear_case() if name == "linear" else cases.helix_case()
    return {k: sampled(r, ours, case, SAME_DRAWS_U[name]) for k, r in results.items()}


def sampled(result: Result, ours: Result, case: cases.LinearCase | cases.HelixCase, same_draws_u: float) -> dict:
    """Estimates for the same draws in u; means and covariances in their sampling errors.

    Ours are held against the law of propagation, the others against ours: few trials of another's would not see 10 % of a variance, our
    100 000 do.
    """
    draws = float(np.abs((result["common"] - ours["common"]) / case.u).max())
    law = result is ours
    centre, covariance = (case.centre, case.covariance) if law else (ours["mean"], ours["covariance"])
    apart = 1.0 / float(result["trials"]) + (0.0 if law else 1.0 / float(ours["trials"]))
    mean = float(np.abs((result["mean"] - centre) / case.u).max()) / np.sqrt(apart)
    scaled = (result["covariance"] - covariance) / np.outer(case.u, case.u)
    r = case.covariance / np.outer(case.u, case.u)
    off = float((np.abs(scaled) / np.sqrt((1.0 + r**2) * apart)).max())
    ok = bool(draws < same_draws_u and mean < MEAN_SIGMAS and off < COVARIANCE_SIGMAS)
    figures = {"same_draws_u": draws, "mean_sigmas": mean, "covariance_sigmas": off}
    return {**figures, "trials": int(result["trials"]), "ok": ok}


def _propagated(result: Result, ours: Result) -> dict:
    u = float(np.abs(result["u"] / ours["u"] - 1.0).max())
    value = float(np.abs((result["value"] - ours["value"]) / ours["u"]).max())
    return {"u_relative": u, "value_u": value, "ok": bool(u < SAME_U and value < SAME_U)}


def _joint(result: Result) -> dict:
    points = result["points"]
    missed = remove_rigid(points, result["deviation"] - cases.true_deviation(points))
    rms = float(np.sqrt((missed**2).mean()))
    return {"prediction_rms_mm": rms, "unknowns": int(result["unknowns"]), "ok": rms < JOINT_MM}
