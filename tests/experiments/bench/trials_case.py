"""What the uncertainty part computes: trials of a linear campaign and of a helix, propagation to points, one joint solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import design, exact_deviation_mm, travel_sign
from abbe.models.machine import Machine, with_tool
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import perpendicular, run_design, setup_unknowns
from abbe.models.solvers.priors import Priors, term_prior_sd
from tests.experiments.mathematics.helix_trials import HelixTask

TRIALS = 100_000
COMMON = 100
"""Draws that every contestant solves, so that estimates can be compared one by one."""
MACHINE = Machine(
    "w-X-Y-b-Z-t",
    np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]),
    np.array([[300.0, 250.0, -150.0], [300.0, 250.0, -250.0], [0.0, 320.0, 260.0]]),
    np.array([0.0, 0.0, -120.0]),
)
LONG_TOOL = np.array([0.0, 0.0, -230.0])
BAR_SIGMA, LASER_SIGMA = 5e-4, 3e-4
PLACES = [(300, 250, 135, 200, 0), (200, 180, 90, 165, 0), (400, 320, 90, 150, 1), (200, 320, 110, 175, 1)]
"""Centre and radius of helices, mm; 1: with the long tool."""
SIX = np.array([120e-6, -80e-6, 40e-6, 60e-6, -90e-6, 30e-6])


@dataclass(frozen=True)
class LinearCase:
    """A campaign of 60 unknowns: four helices with two tools, four step diagonals, with the documented priors.

    ``rows``: the whitened design with the priors as rows of their own below, unknowns in units of their prior, which is what a user of
    `numpy.linalg.lstsq` makes of it.
    """

    a: F2
    sigma_mm: F1
    prior_sd: F1
    theta: F1

    @cached_property
    def rows(self) -> F2:
        return np.concatenate([self.a * self.prior_sd / self.sigma_mm[:, None], np.eye(len(self.prior_sd))])

    def right_side(self, readings: F1) -> F1:
        """Whitened readings and zeros for the priors."""
        return np.concatenate([readings / self.sigma_mm, np.zeros(len(self.prior_sd))])

    @cached_property
    def undisturbed(self) -> F1:
        """Readings about which trials scatter."""
        return self.a @ self.theta

    def draws(self, trials: int, seed: int = 11) -> F2:
        """Readings of so many trials."""
        noise = np.random.default_rng(seed).normal(size=(trials, len(self.sigma_mm)))
        return self.undisturbed + noise * self.sigma_mm

    @cached_property
    def _gain(self) -> F2:
        """Estimates per whitened reading, without any of the contestants' code."""
        return (np.linalg.inv(self.rows.T @ self.rows) @ self.rows[: len(self.sigma_mm)].T) * self.prior_sd[:, None]

    @cached_property
    def covariance(self) -> F2:
        """How the estimates scatter from trial to trial, by propagation: K Sigma K^T."""
        return self._gain @ self._gain.T

    @cached_property
    def centre(self) -> F1:
        """Estimates of the undisturbed readings."""
        return self._gain @ (self.undisturbed / self.sigma_mm)

    @cached_property
    def u(self) -> F1:
        """How far the estimates scatter from trial to trial, by propagation."""
        return np.sqrt(np.diag(self.covariance))


def linear_case(points: int = 63) -> LinearCase:
    """Order 2 of all 21 error motions, lost motion, cup and length of every bar, two tilts of every mirror: 33 + 3 + 16 + 8."""
    runs, terms = [_bar(i, points) for i in range(4)], smooth_terms(2)
    runs += [_diagonal(f"d{d}", *diagonal_ends(_box(), d), "XYZ", 12) for d in DIAGONALS]
    setup = setup_unknowns(tuple(runs), Priors())
    a = np.concatenate([run_design(MACHINE, terms, r, setup) for r in runs])
    wanted = [k for k, n in enumerate(setup.names) if n.startswith(("cup_", "bar_length_", "tilt_"))]
    kept = [*range(len(terms) + 3), *(len(terms) + 3 + k for k in wanted)]
    sigma = np.concatenate([np.full(r.deviation_mm.size, BAR_SIGMA if r.kind == "bar" else LASER_SIGMA) for r in runs])
    used = np.concatenate(
        [np.arange(r.deviation_mm.size) > (-1 if r.kind == "bar" else 0) for r in runs]
    )  # a laser's first record is its zero
    prior = np.concatenate([term_prior_sd(MACHINE, terms, Priors()), np.full(3, Priors().backlash_mm), setup.prior_sd[wanted]])
    return LinearCase(a[used][:, kept], sigma[used], prior, prior * np.random.default_rng(60).normal(size=len(prior)))


@dataclass(frozen=True)
class HelixCase:
    """Yang's helix of 63 points, six parameters, exact bar length."""

    task: HelixTask
    reading_mm: F1

    def draws(self, trials: int, seed: int = 12) -> F2:
        """Readings of so many trials."""
        return self.reading_mm + self.task.sigma_mm * np.random.default_rng(seed).normal(size=(trials, len(self.reading_mm)))

    @property
    def covariance(self) -> F2:
        """Covariance of the unknowns by propagation, about their true values."""
        j = self.task.jacobian(SIX[None])[1][0] / self.task.sigma_mm
        return np.linalg.inv(j.T @ j)

    @property
    def centre(self) -> F1:
        """Estimates of the undisturbed readings: the truth."""
        return SIX

    @property
    def u(self) -> F1:
        """Standard uncertainties of the unknowns by propagation."""
        return np.sqrt(np.diag(self.covariance))


@cache
def helix_case(points: int = 63) -> HelixCase:
    """Radius 150 mm, three turns, noise 0.5 um, the size of errors of Yang's machine."""
    task = HelixTask(helix_points(np.zeros(3), 150.0, turns=3, n=points, law="angle", axis=2), 150.0, BAR_SIGMA)
    return HelixCase(task, task.jacobian(SIX[None])[0][0])


@cache
def joint_case(helices: int = 10, points: int = 500, steps: int = 24) -> tuple[RunData, ...]:
    """Ten helices of 500 points (two tools), eight step diagonals (two orders of the axes), on a machine of waves with finite rotations."""
    rng = np.random.default_rng(7)
    runs = []
    for i in range(helices):
        runs.append(_measured(_bar(i, points), rng))
    for order in ("XYZ", "ZYX"):
        runs += [_measured(_diagonal(f"d{d}{order}", *diagonal_ends(_box(), d), order, steps), rng) for d in DIAGONALS]
    return tuple(runs)


def _box() -> F2:
    return MACHINE.stroke_mm + np.array([10.0, -10.0])


def _bar(i: int, points: int) -> RunData:
    x, y, z, radius, long = PLACES[i % len(PLACES)]
    centre, radius = np.array([x, y, z], float), radius + 2.0 * (i // len(PLACES))
    p = helix_points(centre, radius, turns=3 + i % 3, n=points, law="area", axis=2)
    t, n = np.arange(points) * 0.1 + 400.0 * i, np.ones(points)
    tool = LONG_TOOL if long else None
    return RunData(f"h{i}", f"h{i}", "bar", p, np.zeros(points), travel_sign(p), t, n, centre, radius, None, 1e-3, True, tool)


def _diagonal(label: str, start: F1, end: F1, order: str, steps: int) -> RunData:
    p = step_diagonal(start, end, steps, order)
    beam = (end - start) / np.linalg.norm(end - start)
    return RunData(label, label, "laser", p, np.zeros(len(p)), travel_sign(p), np.arange(len(p)) * 2.0, np.ones(len(p)), beam=beam)


def _measured(run: RunData, rng: np.random.Generator) -> RunData:
    """The run as the machine of waves gives it, its set-up imperfect."""
    p = run.axes_mm + true_deviation(run.axes_mm, run.tool_mm) - 0.5 * run.sign * np.array([2e-3, 3e-3, 1e-3])
    if run.kind == "bar":
        cup = run.centre_mm + true_deviation(run.centre_mm[None], run.tool_mm)[0] + rng.normal(0, 10e-3, 3)
        reading = np.linalg.norm(p - cup, axis=1) - run.radius_mm + rng.normal(0, 1e-3)
        return replace(run, deviation_mm=reading + rng.normal(0, BAR_SIGMA, len(p)))
    mirror = run.beam + rng.normal(0, 150e-6, 2) @ perpendicular(run.beam)
    turned = mirror + np.cross(true_motions(run.axes_mm)[:, :, 3:].sum(axis=1), mirror)  # the mirror is on the spindle
    reading = np.einsum("ni,ni->n", p - p[0], turned) / (turned @ run.beam) - (run.axes_mm - run.axes_mm[0]) @ run.beam
    return replace(run, deviation_mm=reading + rng.normal(0, LASER_SIGMA, len(p)))


def true_deviation(points: F2, tool_mm: F1 | None = None) -> F2:
    """Waves in all 18 error motions, finite rotations."""
    return exact_deviation_mm(with_tool(MACHINE, tool_mm), points, true_motions(points))


def true_motions(points: F2) -> F3:
    """The error motions, shape (n, 3, 6), mm and rad."""
    wave = np.random.default_rng(70)
    size, length, phase = (
        wave.normal(0, 1, (3, 6)) * np.r_[[4e-3] * 3, [1e-5] * 3],
        wave.uniform(0.7, 2.5, (3, 6)),
        wave.uniform(0, 6, (3, 6)),
    )
    motions = np.empty((len(points), 3, 6))
    for a in range(3):
        motions[:, a] = size[a] * np.sin(2 * np.pi * points[:, a, None] / MACHINE.length_mm[a] / length[a] + phase[a])
    return motions


@dataclass(frozen=True)
class PropagationCase:
    """Predicted deviation at points from correlated coefficients: ``design`` (m, 3, p), values (p,), covariance (p, p)."""

    points_mm: F2
    design: np.ndarray
    theta: F1
    covariance: F2


def propagation_case(points: int = 100) -> PropagationCase:
    """The 33 coefficients of the linear campaign's error motions, with their covariance."""
    case, terms = linear_case(), smooth_terms(2)
    covariance = np.linalg.inv(case.rows.T @ case.rows) * np.outer(case.prior_sd, case.prior_sd)
    at = np.random.default_rng(5).uniform(MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], (points, 3))
    return PropagationCase(at, design(MACHINE, terms, at), case.theta[: len(terms)], covariance[: len(terms), : len(terms)])
