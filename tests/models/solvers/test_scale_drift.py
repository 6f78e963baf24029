"""A scale that changes while the machine is measured: stated with its size, and the scale is known no better than that."""

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.solvers.observations import RunData
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.sources import error_sources
from tests.models.solvers.truth import MACHINE, Truth

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
WARM, SETTLES_S, BETWEEN_S = 12e-6, 2500.0, 400.0
"""Growth of a warm screw, its time constant, and the time from one run to the next."""


def one_after_another(runs: tuple[RunData, ...], first_s: float = 600.0) -> tuple[RunData, ...]:
    return tuple(replace(run, t_s=run.t_s + first_s + BETWEEN_S * k) for k, run in enumerate(runs))


def warming(run: RunData, axis: int, growth: float) -> RunData:
    """The run on a machine that was cold at 0 s; the cup and the laser's zero see the screw as it is when they are set."""
    grown = growth * (1.0 - np.exp(-run.t_s / SETTLES_S)) * run.axes_mm[:, axis]
    if run.centre_mm is None:
        return replace(run, deviation_mm=run.deviation_mm + run.beam[axis] * (grown - grown[0]))
    at_cup = growth * (1.0 - np.exp(-run.t_s[0] / SETTLES_S)) * run.centre_mm[axis]
    bar = run.axes_mm - run.centre_mm
    return replace(run, deviation_mm=run.deviation_mm + bar[:, axis] / np.linalg.norm(bar, axis=1) * (grown - at_cup))


def drifting(seed: int, axis: int, growth: float = WARM) -> tuple[RunData, ...]:
    return tuple(warming(run, axis, growth) for run in one_after_another(Truth(seed).campaign()))


@cache
def solved(seed: int, axis: int) -> JointSolution:
    return solve_joint(MACHINE, drifting(seed, axis))


@cache
def still(seed: int) -> JointSolution:
    """The same machine with the same readings, and nothing warms up."""
    return solve_joint(MACHINE, one_after_another(Truth(seed).campaign()))


@pytest.mark.parametrize(("seed", "axis"), [(11, 0), (12, 1), *([(11, 1), (12, 0), (13, 0), (13, 1)] if LONG else [])])
def test_a_screw_that_warms_up_is_stated_and_its_scale_is_known_cold_and_warm(seed, axis):
    solution, cold_one = solved(seed, axis), still(seed)
    (drift,) = solution.scale_drifts
    assert drift.axis == axis
    t_s = np.concatenate([run.t_s for run in solution.data])
    assert abs(drift.change - WARM * -np.diff(np.exp(-np.array([t_s.min(), t_s.max()]) / SETTLES_S))[0]) < drift.u
    place = solution.estimate.names.index(("EXX.1", "EYY.1")[axis])
    scale, u = solution.estimate.theta[place], np.sqrt(solution.estimate.covariance[place, place])
    cold = cold_one.estimate.theta[place]
    for state in (cold, cold + WARM * MACHINE.length_mm[axis] / 2.0):
        assert abs(scale - state) < 2.5 * u
    assert u > 1.5 * np.sqrt(cold_one.estimate.covariance[place, place]), "noise alone would promise more"


def test_a_strong_change_gives_its_name_to_no_other_axis():
    (drift,) = solve_joint(MACHINE, drifting(11, 0, 10 * WARM)).scale_drifts
    assert drift.axis == 0


@pytest.mark.parametrize("seed", [3, 6] if LONG else [6])
def test_a_bar_that_warms_up_is_no_scale_that_changes(seed):
    runs = [
        run if run.radius_mm is None else replace(run, deviation_mm=run.deviation_mm - WARM * np.exp(-run.t_s / SETTLES_S) * run.radius_mm)
        for run in one_after_another(Truth(seed).campaign())
    ]
    assert solve_joint(MACHINE, tuple(runs)).scale_drifts == ()


def test_the_sources_of_uncertainty_name_it_and_add_up():
    solution = solved(11, 0)
    found = error_sources(solution, StatedInputs().without_stated_inputs())
    assert "scale_drift" in {one.name for one in found.sources}
    parts = sum(one.factor @ one.factor.T for one in found.sources) - sum(
        one.subtracted @ one.subtracted.T for one in found.sources if one.subtracted is not None
    )
    np.testing.assert_allclose(parts, solution.term_covariance, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("seed", [11, 12, *(range(4) if LONG else ())])
def test_a_machine_that_stays_as_it_is_has_none(seed):
    assert still(seed).scale_drifts == ()


def test_no_scale_is_less_sure_than_its_prior():
    solution = solve_joint(MACHINE, drifting(11, 0, 100 * WARM))
    assert (solution.estimate.covariance.diagonal() <= solution.prior_sd**2 * (1.0 + 1e-9)).all()
