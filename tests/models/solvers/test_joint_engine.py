"""What the joint solution finds out by itself: noise, outliers, order, model, and whether its residuals are noise."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import SMOOTH_ORDER
from abbe.models.geometry.volume import unit_deviation, volume_frame
from abbe.models.solvers import engine
from abbe.models.solvers.engine import repeat_noise_mm
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import predict, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.models.solvers.residuals import outlier_threshold, outlier_weights, residual_tests
from tests.models.solvers.truth import MACHINE, Truth


@pytest.fixture(scope="module")
def runs() -> tuple[RunData, ...]:
    return Truth(11).campaign()


@pytest.fixture(scope="module")
def clean(runs) -> JointSolution:
    return solve_joint(MACHINE, runs)


def test_noise_is_found_from_repeats_and_with_the_solution(runs, clean):
    assert clean.noise_mm == pytest.approx({"bar": 4e-4, "laser": 2.4e-4}, rel=0.12)
    assert repeat_noise_mm(runs, "bar") == pytest.approx(4e-4, rel=0.15)
    assert clean.noise_repeats_mm["laser"] == pytest.approx(2.4e-4, rel=0.25)


def test_the_order_is_chosen_and_what_lies_above_stays_as_nuisance(clean):
    assert 3 <= clean.order <= 10
    assert max(t.order for t in clean.terms) == SMOOTH_ORDER
    assert clean.identifiability.n_parameters == 18 * clean.order - 3
    c = clean.order_choice
    assert c is not None
    assert c.score[c.levels.index(1)] < -3 * c.se[c.levels.index(1)]  # straight lines are not enough for this machine


def test_the_same_runs_give_the_same_solution_and_21_motions_where_six_are_not_enough(runs, clean):
    again = solve_joint(MACHINE, runs, model="auto")
    assert again.model == clean.model == "rigid21"
    assert np.array_equal(again.estimate.theta, clean.estimate.theta)
    assert np.array_equal(again.estimate.covariance, clean.estimate.covariance)


def test_outliers_are_listed_and_change_little(runs, clean):
    rng = np.random.default_rng(5)
    put, spoiled = set(), []
    for run in runs:
        y = run.deviation_mm.copy()
        for i in rng.choice(y.size, max(1, y.size // 60), replace=False):
            y[i] += rng.choice([-1.0, 1.0]) * rng.uniform(5e-3, 50e-3)
            put.add((run.label, int(i)))
        spoiled.append(replace(run, deviation_mm=y))
    s = solve_joint(MACHINE, tuple(spoiled))
    assert put <= {(o.run, o.index) for o in s.outliers if o.weight == 0.0}
    assert len(s.outliers) <= len(put) + 2
    assert len(clean.outliers) <= 1
    n = len(s.terms)
    moved = (s.estimate.theta - clean.estimate.theta)[:n] / np.sqrt(clean.estimate.covariance.diagonal()[:n])
    assert np.abs(moved).max() < 2.0
    assert s.noise_mm == pytest.approx(clean.noise_mm, rel=0.1)


def test_clean_readings_lose_nothing():
    z = np.random.default_rng(0).normal(size=5000)
    assert outlier_threshold(5000) > np.abs(z).max()
    assert (outlier_weights(z, outlier_threshold(5000)) == 1.0).all()


def test_residuals_of_a_good_solution_are_noise_and_those_of_a_poor_one_are_not(runs, clean):
    assert sum(t.flagged for t in clean.residual_tests) <= 1
    poor = solve_joint(MACHINE, runs, order=2)
    flagged = [t for t in poor.residual_tests if t.flagged]
    assert len(flagged) > 10
    assert any("correlated over" in t.text and t.text.startswith(t.run) for t in flagged)


def test_residual_tests_name_run_and_direction(runs):
    run = next(r for r in runs if r.kind == "bar")
    rng = np.random.default_rng(1)
    z = rng.normal(size=run.deviation_mm.size)
    assert not any(t.flagged for t in residual_tests((run,), (z,), (np.ones(z.size),)))
    shifted = z + 0.6 * run.sign[:, 0]
    found = [t for t in residual_tests((run,), (shifted,), (np.ones(z.size),)) if t.flagged]
    assert "direction X" in {t.name for t in found}
    assert all(t.text.startswith(f"{run.label}: ") for t in found)


def six_machine(runs, seed):
    """Readings of a machine that has scales and squareness errors only."""
    six = tuple(t for t in solve_joint(MACHINE, runs[:2], model="rigid6").terms)
    setup, rng = setup_unknowns(runs, Priors()), np.random.default_rng(seed)
    theta = np.concatenate([rng.normal(size=6) * 20e-6 * np.where([t.order == 1 for t in six], 250.0, 1.0), np.zeros(3 + len(setup.names))])
    return tuple(
        replace(r, deviation_mm=predict(MACHINE, six, r, setup, theta) + rng.normal(size=len(r.t_s)) * 3e-4 / np.sqrt(r.weight_n))
        for r in runs
    )


def test_auto_takes_six_parameters_where_six_are_enough(runs):
    assert solve_joint(MACHINE, six_machine(runs, 3), model="auto").model == "rigid6"


def test_progress_is_told(runs):
    said: list[str] = []
    solve_joint(MACHINE, runs[:5], order=3, progress=said.append)
    assert any(line.startswith("round 1") for line in said)


def test_no_runs_is_refused():
    with pytest.raises(ValueError, match="no runs"):
        solve_joint(MACHINE, ())


def test_more_rounds_would_move_the_map_by_little_of_its_uncertainty(runs, clean, monkeypatch):
    at = np.stack(np.meshgrid(*(np.linspace(low, high, 4) for low, high in MACHINE.stroke_mm), indexing="ij"), axis=-1).reshape(-1, 3)
    field = unit_deviation(MACHINE, clean.terms, at, None, volume_frame(MACHINE))
    monkeypatch.setattr(engine, "SETTLED", 1e-4)
    monkeypatch.setattr(engine, "ROUNDS", 30)
    longer = solve_joint(MACHINE, runs)
    assert longer.terms == clean.terms
    moved = field @ (clean.coefficients - longer.coefficients)
    u = np.sqrt(np.einsum("pij,jk,pik->pi", field, longer.term_covariance, field))
    assert np.abs(moved / u).max() < 0.05
