"""Calibration of the 3-PUU machine from CMM points: uncertainties that cover the truth, and honest words on what the points do not tell."""

from __future__ import annotations

import os

import numpy as np
import pytest
from scipy import stats

from abbe.models.papers.kwon import calibration
from abbe.models.papers.kwon.calibration import (
    FRAME_NAMES,
    PARAMETERS,
    KwonCalibration,
    PlaneReadings,
    calibrate,
    default_prior,
    error_left,
    moved_frame,
)
from abbe.models.papers.kwon.errors import NoForwardSolution, NotSettled
from abbe.models.papers.kwon.frames import from_frame, rms
from abbe.models.papers.kwon.kinematics import PER_LEG, Geometry, forward, inverse

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
NOMINAL = Geometry(100.0, 30.0, 101.26, 8.0, 8.0, np.radians(35.0), 20.0)  # type: ignore[arg-type]
FRAME = moved_frame(np.eye(4), np.array([312.0, 145.5, -40.25, 0.01, -0.02, 0.0366]), np.zeros(3))
U = 1e-3


def machine(theta: np.ndarray) -> Geometry:
    return NOMINAL.with_errors({name: theta[3 * k : 3 * k + 3] for k, name in enumerate(PER_LEG)})


def cube(half: float, middle: float = 0.0, n: int = 4) -> np.ndarray:
    line = middle + np.linspace(-half, half, n)
    return np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)


def experiment(
    seed: int, lam: np.ndarray, *, known: bool = False, u_lambda: float = 0.0, size: float = 1.0
) -> tuple[KwonCalibration, np.ndarray, Geometry]:
    """``size``: truths in units of the prior that the calibration is told."""
    rng = np.random.default_rng(seed)
    theta = size * default_prior() * rng.standard_normal(18)
    true = machine(theta)
    reached = lam + u_lambda * rng.standard_normal(lam.shape)
    measured = from_frame(FRAME, forward(true, reached)) + U * rng.standard_normal(lam.shape)
    return calibrate(NOMINAL, PlaneReadings(lam, measured, U, u_lambda), frame=FRAME if known else None), theta, true


@pytest.mark.parametrize(("half", "known", "u_lambda"), [(1.0, False, 0.0), (20.0, False, 0.0), (20.0, True, 0.0), (20.0, False, 2e-3)])
def test_stated_uncertainties_cover_the_truth(half: float, known: bool, u_lambda: float) -> None:
    score, ahead = [], []
    for seed in range(20):
        c, theta, true = experiment(seed, cube(half), known=known, u_lambda=u_lambda)
        score.append((c.estimate.theta[:18] - theta) / np.sqrt(np.diag(c.estimate.covariance))[:18])
        held = np.random.default_rng(1000 + seed).uniform(-half, half, (20, 3))
        ahead.append((c.predict_mm(held) - from_frame(FRAME, forward(true, held))) / c.u_predict_mm(held))
    for z in (np.array(score), np.array(ahead)):
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.2)
        assert np.mean(np.abs(z) < 2.0) == pytest.approx(0.95, abs=0.05)


@pytest.mark.parametrize(
    ("half", "size"), [(1.0, 3.0), (20.0, 30.0), *([(20.0, 3.0), (1.0, 10.0), (20.0, 10.0), (1.0, 30.0)] if LONG else [])]
)
def test_a_prior_that_is_too_narrow_is_noticed_and_widened(half: float, size: float) -> None:
    """Before, 95 % ranges held 55, 21 and 12 % of the parameters. One common factor, found from 5 or 11 directions, brings above 88 %."""
    score, ahead, conflicts, factors = [], [], 0, []
    for seed in range(20):
        c, theta, true = experiment(seed, cube(half), size=size)
        score.append((c.estimate.theta[:18] - theta) / np.sqrt(np.diag(c.estimate.covariance))[:18])
        held = np.random.default_rng(1000 + seed).uniform(-half, half, (20, 3))
        ahead.append((c.predict_mm(held) - from_frame(FRAME, forward(true, held))) / c.u_predict_mm(held))
        conflicts += c.prior_test.conflict
        factors.append(c.prior_factor)
        assert ("CONTRADICT" in c.statement) == c.prior_test.conflict
        assert c.estimate.variance_factor < 1.5  # it is the prior that is wrong, not the points
    assert conflicts >= (14 if size == 3.0 else 19)
    assert np.median(factors) == pytest.approx(size, rel=0.4)
    assert np.mean(np.abs(np.array(score)) < 1.96) > 0.88
    assert np.mean(np.abs(np.array(ahead)) < 1.96) > 0.93


@pytest.mark.parametrize("half", [1.0, 20.0])
def test_a_true_prior_is_seldom_contradicted(half: float) -> None:
    p = np.array([experiment(seed, cube(half, n=3))[0].prior_test.p for seed in range(60)])
    assert (p < 0.01).sum() <= 4  # binomial(60, 0.01): 4 or fewer in 99.9 %
    assert 0.35 < p.mean() < 0.65
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_prior_test_is_the_chi_square_of_what_the_points_carry() -> None:
    """Independent: deviations found, in the directions with a posterior below half the prior variance, over their prior-predictive size."""
    c, _, _ = experiment(8, cube(20.0), size=1.2)
    assert c.estimate.variance_factor == 1.0
    prior = c.prior_factor * default_prior()
    share = np.eye(18) - c.estimate.covariance[:18, :18] / np.outer(prior, prior)
    size, direction = np.linalg.eigh(share)
    carried = size > 0.5
    assert carried.sum() == c.carried == 11
    z = direction[:, carried].T @ (c.estimate.theta[:18] / prior)
    chi2 = float((z**2 / size[carried]).sum())
    assert c.prior_test.dof == 11
    assert c.prior_test.p == pytest.approx(stats.chi2.sf(c.prior_test.chi2, 11), rel=1e-9)
    # With the widened prior the same sum is what the widening aims at.
    over = c.prior_test.chi2 / 11.0 - 1.0
    assert chi2 == pytest.approx(11.0 - 2.0 * min(max(over, 0.0), 1.0) if over > 0.0 else c.prior_test.chi2, rel=1e-3)


def with_outlier(size_mm: float) -> KwonCalibration:
    lam, rng = cube(20.0), np.random.default_rng(5)
    measured = from_frame(FRAME, forward(machine(default_prior() * rng.standard_normal(18)), lam)) + U * rng.standard_normal(lam.shape)
    measured[20, 0] += size_mm
    return calibrate(NOMINAL, PlaneReadings(lam, measured, U))


@pytest.mark.parametrize("size_mm", [0.05, 5.0])
def test_an_outlier_takes_claims_away_and_never_widens_what_was_known(size_mm: float) -> None:
    c, clean = with_outlier(size_mm), with_outlier(0.0)
    assert c.outlying == (20,)
    assert "outlying point rows, not left out: 20" in c.statement
    assert clean.outlying == ()
    assert "outlying" not in clean.statement
    assert c.estimate.u("R1") <= default_prior()[0] * c.prior_factor
    assert c.prior_factor < 1.5
    assert c.estimate.variance_factor == pytest.approx(size_mm**2 / U**2 / (3 * 64 - 17), rel=0.25)
    assert c.carried < clean.carried == 11
    assert (c.estimate.data_share[:18] <= clean.estimate.data_share[:18] + 1e-3).all()
    if size_mm == 5.0:
        assert c.carried == 0
        assert set(c.on_prior) == set(PARAMETERS)


def test_statement_names_what_leaves_no_trace() -> None:
    """The common height: each dz has a share above one half by the differences, their mean none; dz1..3 are not among single values."""
    c, _, _ = experiment(1, cube(20.0))
    assert not {"dz1", "dz2", "dz3"} & set(c.on_prior)
    dz = c.estimate.covariance[15:18, 15:18]
    assert np.sqrt(dz.mean()) == pytest.approx(c.prior_factor * 0.05 / np.sqrt(3.0), rel=1e-3)
    words = c.statement.split("leave no trace and rest on the prior alone: ")[1].split(";")[0].split(", ")
    assert len(words) == 7
    assert {"dz1", "dz2", "dz3"} in [set(w.split(" with ")) for w in words]
    assert {"R1", "r1"} in [set(w.split(" with ")) for w in words]
    assert c.statement.endswith("every stated uncertainty is conditional on the prior")


def test_known_combinations_leave_no_trace() -> None:
    """Unknown frame: R with r of each leg, the common height, and turns of rails and corners that a rigid motion undoes: 7 of 18."""
    c, _, _ = experiment(1, cube(20.0))
    assert c.identifiability.rank == 11
    assert c.identifiability.effective_rank == 11
    texts = [h.text for h in c.identifiability.hidden]
    assert len(texts) == 7
    assert sum("dz1" in t and "dz2" in t and "dz3" in t for t in texts) == 1
    held_by_frame, _, _ = experiment(1, cube(20.0), known=True)
    assert held_by_frame.identifiability.rank == 15
    for leg in "123":
        assert any(f"R{leg}" in h.text and f"r{leg}" in h.text for h in held_by_frame.identifiability.hidden)


def test_the_null_space_really_is_hidden() -> None:
    """Independent of the linear algebra: moving along a hidden combination changes no distance between positions."""
    c, _, _ = experiment(2, cube(20.0))
    lam = cube(20.0)
    p = forward(c.geometry, lam)
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    for combination in c.identifiability.hidden:
        weights = dict(combination.weights)
        step = np.array([weights.get(name, 0.0) for name in PARAMETERS]) * default_prior()
        step *= 1e-3 / np.abs(step).max()
        moved = c.geometry.with_errors({name: step[3 * k : 3 * k + 3] for k, name in enumerate(PER_LEG)})
        q = forward(moved, lam)
        assert np.abs(np.linalg.norm(q[:, None] - q[None], axis=2) - distance).max() < 2e-6
    seen = c.geometry.with_errors({"l": np.array([1e-3, 0, 0])})
    q = forward(seen, lam)
    assert np.abs(np.linalg.norm(q[:, None] - q[None], axis=2) - distance).max() > 1e-4


def test_a_small_square_carries_less_and_says_so() -> None:
    small, _, _ = experiment(3, cube(1.0, 1.0))
    large, _, _ = experiment(3, cube(20.0, 1.0))
    assert small.carried < large.carried == 11
    assert set(small.on_prior) > set(large.on_prior)
    assert "l1" in small.on_prior
    assert "l1" not in large.on_prior
    assert f"and {small.carried} of them better than the prior" in small.statement
    assert "l1" in small.statement
    assert not set(FRAME_NAMES) & set(small.on_prior)


def test_error_left_on_points_not_seen() -> None:
    for half, gain in ((1.0, 4.0), (20.0, 50.0)):
        before, after = [], []
        for seed in range(5):
            c, _, true = experiment(seed, cube(half, n=5))
            held = np.random.default_rng(50 + seed).uniform(-half, half, (60, 3))
            left = error_left(NOMINAL, c.geometry, held, from_frame(FRAME, forward(true, held)))
            assert left.after_rms_mm <= left.after_max_mm
            assert left.after_rms_mm < U
            before.append(left.before_rms_mm)
            after.append(left.after_rms_mm)
        assert np.mean(before) > gain * np.mean(after)


def test_corrected_commands_bring_the_real_machine_there() -> None:
    c, _, true = experiment(4, cube(20.0, n=5))
    line = np.linspace(-15.0, 15.0, 5)
    target = np.array([[x, y, 105.0] for x in line for y in line])
    wanted = from_frame(c.frame, target)
    plain = from_frame(FRAME, forward(true, inverse(NOMINAL, target))) - wanted
    corrected = from_frame(FRAME, forward(true, c.corrected_lambda_mm(target))) - wanted
    assert rms(plain) > 0.01
    assert rms(corrected) < 1e-3
    assert rms(corrected) < 0.05 * rms(plain)


def test_repeated_points_count() -> None:
    lam = cube(20.0, n=3)
    once, _, _ = experiment(5, lam)
    often, _, _ = experiment(5, np.tile(lam, (4, 1)))
    ratio = once.u_predict_mm(lam).mean() / often.u_predict_mm(lam).mean()
    assert ratio == pytest.approx(2.0, abs=0.35)


def test_scatter_of_the_stages_widens_the_uncertainty() -> None:
    lam = cube(20.0)
    fine, _, _ = experiment(6, lam)
    rough, _, _ = experiment(6, lam, u_lambda=5e-3)
    assert rough.u_predict_mm(lam).mean() > 2.5 * fine.u_predict_mm(lam).mean()


def test_points_worse_than_stated_widen_it_too() -> None:
    lam = cube(20.0)
    rng = np.random.default_rng(7)
    measured = from_frame(FRAME, forward(machine(np.zeros(18)), lam)) + 10 * U * rng.standard_normal(lam.shape)
    c = calibrate(NOMINAL, PlaneReadings(lam, measured, U))
    assert c.estimate.variance_factor == pytest.approx(100.0, rel=0.3)
    assert rms(c.residual_mm) == pytest.approx(10 * U * np.sqrt(3), rel=0.2)


def test_without_noise_the_truth_comes_back_where_points_tell_it() -> None:
    """Truth outside the hidden directions: 40 mm of stroke, known frame, exact points."""
    theta = np.zeros(18)
    theta[6:9] = [0.04, -0.03, 0.05]  # l
    theta[9:12] = [3e-4, -2e-4, 1e-4]  # thb
    theta[15:18] = [0.02, -0.05, 0.03]  # dz
    lam = cube(20.0)
    c = calibrate(NOMINAL, PlaneReadings(lam, from_frame(FRAME, forward(machine(theta), lam)), 1e-6), frame=FRAME)
    np.testing.assert_allclose(c.estimate.theta[6:], theta[6:], atol=2e-6)
    assert rms(c.residual_mm) < 1e-7


def test_refusals() -> None:
    lam = cube(5.0, n=3)
    good = from_frame(FRAME, forward(NOMINAL, lam))
    with pytest.raises(ValueError, match="positive"):
        PlaneReadings(lam, good, 0.0)
    with pytest.raises(ValueError, match="do not fit"):
        PlaneReadings(lam, good[:3], U)
    with pytest.raises(ValueError, match="18 finite positive prior"):
        calibrate(NOMINAL, PlaneReadings(lam, good, U), prior_sd=np.full(18, np.inf))
    with pytest.raises(ValueError, match="18 finite positive prior"):
        calibrate(NOMINAL, PlaneReadings(lam, good, U), prior_sd=np.ones(17))


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (np.eye(3), r"shape \(4, 4\), got shape \(3, 3\)"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "scales or shears"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (2.0 * np.eye(4), "last row 0 0 0 1"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_a_frame_that_is_no_placement_is_refused(frame: np.ndarray, text: str) -> None:
    lam = cube(5.0, n=3)
    readings = PlaneReadings(lam, from_frame(FRAME, forward(NOMINAL, lam)), U)
    with pytest.raises(ValueError, match=f"^calibration: frame: .*{text}"):
        calibrate(NOMINAL, readings, frame=frame)


def test_an_iteration_that_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    lam = cube(20.0)
    measured = from_frame(FRAME, forward(machine(0.5 * default_prior()), lam))
    monkeypatch.setattr(calibration, "ITERATIONS", 1)
    with pytest.raises(NotSettled, match="no convergence after 1 steps"):
        calibrate(NOMINAL, PlaneReadings(lam, measured, U))


def test_commands_without_a_position_are_refused() -> None:
    lam = np.concatenate([cube(5.0, n=3), [[-200.0, 0.0, 0.0]]])
    with pytest.raises(NoForwardSolution, match="pose row 27"):
        calibrate(NOMINAL, PlaneReadings(lam, lam, U))
