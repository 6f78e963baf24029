"""Who takes part in the uncertainty part: our batched estimators and propagation, and what a user would take instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.solvers.helix import linear_field
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observe import predict, run_jacobian, setup_unknowns
from abbe.models.solvers.priors import Priors, term_prior_sd
from tests.experiments.bench import trials_case as cases
from tests.experiments.bench.trials_case import COMMON, TRIALS, HelixCase, LinearCase
from tests.experiments.mathematics.helix_trials import fit_trials, helix_trials, linear_estimator, linear_trials

Result = dict[str, np.ndarray]


@dataclass(frozen=True)
class Contestant:
    """``run``: what is timed, on ``items`` trials or points. ``result``: what is compared, not timed."""

    run: Callable[[], object]
    items: int
    result: Callable[[], Result]


def _statistics(estimates: F2) -> Result:
    return {"mean": estimates.mean(axis=0), "covariance": np.cov(estimates.T), "trials": np.array(len(estimates))}


def _loop(estimate: Callable[[F1], F1], draws: Callable[..., F2], timed: int, counted: int) -> Contestant:
    """One call of a library per trial; statistics from ``counted`` trials of its own."""

    def many(readings: F2) -> F2:
        return np.array([estimate(y) for y in readings])

    def result() -> Result:
        return {"common": many(draws(COMMON)), **_statistics(many(draws(counted, seed=21)))}

    return Contestant(lambda: many(draws(timed, seed=31)), timed, result)


# --- linear campaign -----------------------------------------------------------------------------------------------------------------


def linear_ours(case: LinearCase, trials: int = TRIALS) -> Contestant:
    """Factorise, draw and solve everything: nothing is prepared before the clock starts."""

    def run() -> Result:
        estimator = linear_estimator(case.a, case.sigma_mm, case.prior_sd)
        found = linear_trials(estimator, case.undisturbed, np.random.Generator(np.random.SFC64(1)), trials)
        return {"mean": found.mean, "covariance": found.covariance, "trials": np.array(found.trials)}

    def result() -> Result:
        return {"common": linear_estimator(case.a, case.sigma_mm, case.prior_sd).solve(case.draws(COMMON)), **run()}

    return Contestant(run, trials, result)


def linear_lstsq(case: LinearCase, timed: int = 300, counted: int = 4000) -> Contestant:
    """`numpy.linalg.lstsq` once per trial."""

    def estimate(y: F1) -> F1:
        return np.linalg.lstsq(case.rows, case.right_side(y), rcond=None)[0] * case.prior_sd

    return _loop(estimate, case.draws, timed, counted)


def linear_lstsq_many(case: LinearCase, trials: int = 20_000) -> Contestant:
    """More help: all trials as right sides of one call of `numpy.linalg.lstsq`."""

    def solve(readings: F2) -> F2:
        sides = np.zeros((len(case.rows), len(readings)))
        sides[: len(case.sigma_mm)] = (readings / case.sigma_mm).T
        return (np.linalg.lstsq(case.rows, sides, rcond=None)[0] * case.prior_sd[:, None]).T

    return Contestant(
        lambda: _statistics(solve(case.draws(trials, seed=31))),
        trials,
        lambda: {"common": solve(case.draws(COMMON)), **_statistics(solve(case.draws(trials, seed=21)))},
    )


# --- helix ---------------------------------------------------------------------------------------------------------------------------


def helix_ours(case: HelixCase, trials: int = TRIALS) -> Contestant:
    """Draw and solve all trials."""

    def run() -> Result:
        found = helix_trials(case.task, case.reading_mm, np.random.Generator(np.random.SFC64(1)), trials)
        if found.failed:
            raise SystemExit(f"{found.failed} of {trials} helix trials did not converge")
        return {"mean": found.mean, "covariance": found.covariance, "trials": np.array(found.trials)}

    return Contestant(run, trials, lambda: {"common": fit_trials(case.task, case.draws(COMMON)).theta, **run()})


def _helix_misfit(case: HelixCase) -> Callable[[F1, F1], F1]:
    """Whitened residuals of one trial for parameters in units of 10 urad, as a user writes them."""
    field = 1e-5 * linear_field(case.task.d_mm)

    def misfit(x: F1, y: F1) -> F1:
        tip = case.task.d_mm + field @ x
        return (np.sqrt((tip**2).sum(axis=1)) - case.task.radius_mm - y) / case.task.sigma_mm

    return misfit


def helix_scipy(case: HelixCase, timed: int = 60, counted: int = 1500, *, jacobian: bool = False) -> Contestant:
    """`scipy.optimize.least_squares` once per trial; ``jacobian``: more help, analytic derivative and MINPACK's Levenberg-Marquardt."""
    from scipy.optimize import least_squares

    misfit = _helix_misfit(case)

    def derivative(x: F1, _: F1) -> F2:
        return case.task.jacobian(1e-5 * x[None])[1][0] * (1e-5 / case.task.sigma_mm)

    options = {"jac": derivative, "method": "lm"} if jacobian else {}

    def estimate(y: F1) -> F1:
        return 1e-5 * least_squares(misfit, np.zeros(6), args=(y,), **options).x

    return _loop(estimate, case.draws, timed, counted)


def helix_lmfit(case: HelixCase, timed: int = 40, counted: int = 400) -> Contestant:
    """`lmfit.minimize` once per trial."""
    import lmfit

    misfit, names = _helix_misfit(case), ("EXX", "EYY", "EZZ", "C0Y", "B0Z", "A0Z")

    def residual(parameters, y: F1) -> F1:
        return misfit(np.array([parameters[n].value for n in names]), y)

    def estimate(y: F1) -> F1:
        start = lmfit.Parameters()
        for n in names:
            start.add(n, value=0.0)
        found = lmfit.minimize(residual, start, args=(y,))
        return 1e-5 * np.array([found.params[n].value for n in names])

    return _loop(estimate, case.draws, timed, counted)


# --- propagation ---------------------------------------------------------------------------------------------------------------------


def propagation_ours(case: cases.PropagationCase) -> Contestant:
    """The product's own step: influence of a source's factor at the points, then sums of squares."""
    from abbe.models.uncertainty.prediction import propagated_covariance

    def run() -> Result:
        covariance = propagated_covariance(case.design, np.linalg.cholesky(case.covariance))
        return {"value": case.design @ case.theta, "u": np.sqrt(np.einsum("mii->mi", covariance))}

    return Contestant(run, len(case.points_mm), run)


def propagation_uncertainties(case: cases.PropagationCase) -> Contestant:
    """`uncertainties.correlated_values`, then arithmetic with numbers that know their uncertainty."""
    import uncertainties

    def run() -> Result:
        theta = uncertainties.correlated_values(case.theta, case.covariance)
        found = [[sum(d * t for d, t in zip(row, theta, strict=True)) for row in point] for point in case.design.tolist()]
        return _values(found, lambda x: (x.nominal_value, x.std_dev))

    return Contestant(run, len(case.points_mm), run)


def propagation_gtc(case: cases.PropagationCase) -> Contestant:
    """`GTC.ureal` with correlations, then the same arithmetic."""
    import GTC

    def run() -> Result:
        u = np.sqrt(np.diag(case.covariance))
        theta = [GTC.ureal(float(v), float(s), independent=False) for v, s in zip(case.theta, u, strict=True)]
        r = case.covariance / np.outer(u, u)
        for i in range(len(theta)):
            for j in range(i):
                GTC.set_correlation(float(np.clip(r[i, j], -1.0, 1.0)), theta[i], theta[j])
        found = [[sum(d * t for d, t in zip(row, theta, strict=True)) for row in point] for point in case.design.tolist()]
        return _values(found, lambda x: (GTC.value(x), GTC.uncertainty(x)))

    return Contestant(run, len(case.points_mm), run)


def _values(found: list, parts: Callable[[object], tuple[float, float]]) -> Result:
    both = np.array([[parts(x) for x in point] for point in found])
    return {"value": both[..., 0], "u": both[..., 1]}


# --- joint solution ------------------------------------------------------------------------------------------------------------------


def joint_ours(*, order: int | None = None) -> Contestant:
    """`solve_joint` as a user calls it: ten helices of 500 points and eight step diagonals, all 21 error motions."""
    runs = cases.joint_case()

    def run() -> object:
        return solve_joint(cases.MACHINE, runs, order=order)

    def result() -> Result:
        found = run()
        points = _places()
        return {"points": points, "deviation": found.deviation_mm(points), "unknowns": np.array(len(found.estimate.names))}

    return Contestant(run, 1, result)


def joint_scipy(order: int = 5) -> Contestant:
    """`scipy.optimize.least_squares` with our exact readings and derivatives, noise and priors as documented: no sizes, order, outliers or
    covariance.
    """
    from scipy.optimize import least_squares

    runs, terms, priors = cases.joint_case(), smooth_terms(order), Priors()
    setup = setup_unknowns(runs, priors, cases.MACHINE)
    sd = np.concatenate([term_prior_sd(cases.MACHINE, terms, priors), np.full(3, priors.backlash_mm), setup.prior_sd])
    sigma = [cases.BAR_SIGMA if r.kind == "bar" else cases.LASER_SIGMA for r in runs]
    each = list(zip(runs, sigma, strict=True))

    def left(x: F1) -> F1:
        return np.concatenate([*((predict(cases.MACHINE, terms, r, setup, sd * x) - r.deviation_mm) / s for r, s in each), x])

    def slope(x: F1) -> F2:
        return np.concatenate([*(run_jacobian(cases.MACHINE, terms, r, setup, sd * x) * (sd / s) for r, s in each), np.eye(x.size)])

    def run() -> F1:
        return np.asarray(least_squares(left, np.zeros(sd.size), slope, method="lm").x)

    def result() -> Result:
        points = _places()
        return {
            "points": points,
            "deviation": design(cases.MACHINE, terms, points) @ (sd * run())[: len(terms)],
            "unknowns": np.array(sd.size),
        }

    return Contestant(run, 1, result)


def _places() -> F2:
    return np.random.default_rng(1).uniform(cases.MACHINE.stroke_mm[:, 0] + 60, cases.MACHINE.stroke_mm[:, 1] - 60, (200, 3))


TRIAL_CASES: dict[str, dict[str, Callable[[], Contestant]]] = {
    "linear": {
        "linear-ours": lambda: linear_ours(cases.linear_case()),
        "lstsq": lambda: linear_lstsq(cases.linear_case()),
        "lstsq-many": lambda: linear_lstsq_many(cases.linear_case()),
    },
    "helix": {
        "helix-ours": lambda: helix_ours(cases.helix_case()),
        "least_squares": lambda: helix_scipy(cases.helix_case()),
        "lmfit": lambda: helix_lmfit(cases.helix_case()),
        "least_squares-jac": lambda: helix_scipy(cases.helix_case(), jacobian=True),
    },
    "propagation": {
        "propagation-ours": lambda: propagation_ours(cases.propagation_case()),
        "uncertainties": lambda: propagation_uncertainties(cases.propagation_case()),
        "gtc": lambda: propagation_gtc(cases.propagation_case()),
    },
    "joint": {"joint-ours": joint_ours, "joint-order-5": partial(joint_ours, order=5), "joint-scipy": joint_scipy},
}
"""Ours first in every case; the rest is compared with it."""
