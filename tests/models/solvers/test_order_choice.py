"""The order of the model, and rigid6 or 21 error motions, judged on set-ups and on regions that were left out."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import SMOOTH_ORDER, smooth_terms
from abbe.models.paths import diagonal_ends, step_diagonal
from abbe.models.solvers.components import total
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, build, expected_noise, settle, sums_of
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.solvers.observations import RunData, block_average
from abbe.models.solvers.order_choice import CORNER, END, RIGID6, OrderChoice, choose, folds, regions, term_levels
from abbe.models.solvers.priors import Priors
from tests.models.solvers.truth import MACHINE, Truth

MIDDLE = [(300, 250, 170, 100), (280, 240, 180, 90), (320, 260, 190, 90), (290, 265, 175, 95), (310, 235, 185, 95)]


class BentEnds(Truth):
    """Scales and squareness in the middle, where five bars measure; bent towards the ends of the strokes, which one diagonal reaches."""

    def motions(self, p: np.ndarray) -> np.ndarray:
        self.size *= 0.0
        u = p / MACHINE.length_mm - 0.5
        beyond = np.sign(u) * np.maximum(np.abs(u) - 0.3, 0.0) ** 2
        return super().motions(p) + beyond[:, :, None] * np.r_[[120e-3] * 3, [200e-6] * 3]

    def campaign(self) -> tuple[RunData, ...]:
        bars = [block_average(self.bar(f"h{k}", np.array(c[:3], float), c[3]), 150) for k, c in enumerate(MIDDLE)]
        ends = diagonal_ends(MACHINE.stroke_mm + np.array([10.0, -10.0]), "ppp")
        return (*bars, self.laser("d", step_diagonal(*ends, 12)))


@pytest.fixture(scope="module")
def bent() -> tuple[BentEnds, CampaignProblem, CampaignFit]:
    truth = BentEnds(1)
    runs = truth.campaign()
    problem = build(MACHINE, smooth_terms(SMOOTH_ORDER), runs, Priors(), expected_noise(runs, None, None))
    return truth, problem, settle(problem, lambda _: None)


def judged(problem: CampaignProblem, fit: CampaignFit, *, by_region: bool) -> OrderChoice:
    level = term_levels(problem.terms, len(problem.names) - len(problem.terms))
    extra = [sums_of(problem, fit, rows) for rows in regions(problem.runs)] if by_region else []
    return choose(total(fit.parts), (*fit.parts, *extra), fit.components, fit.sizes, level)


def test_left_out_set_ups_inside_would_take_six_parameters_and_left_out_ends_take_21_motions(bent):
    _, problem, fit = bent
    assert judged(problem, fit, by_region=False).chosen == RIGID6
    assert judged(problem, fit, by_region=True).chosen > RIGID6


def test_auto_follows_the_regions_and_its_lengths_along_the_diagonal_are_nearer_to_the_truth(bent):
    truth, problem, _ = bent
    start, end = diagonal_ends(MACHINE.stroke_mm, "ppp")
    p = start + np.linspace(0.0, 1.0, 50)[:, None] * (end - start)
    beam = (end - start) / np.linalg.norm(end - start)

    def left(s: JointSolution) -> float:
        d = (truth.deviation(p) - s.deviation_mm(p)) @ beam
        return float(np.std(d))

    auto, six = (solve_joint(MACHINE, problem.runs, model=m) for m in ("auto", "rigid6"))
    assert auto.model == "rigid21"
    assert left(auto) < 0.5 * left(six)


def test_a_region_is_an_end_of_a_measured_range_or_a_corner(bent):
    _, problem, _ = bent
    at = np.concatenate([r.axes_mm for r in problem.runs])
    away = (at - at.min(axis=0)) / np.ptp(at, axis=0)
    found = regions(problem.runs)
    assert len(found) >= 6
    for rows in found:
        near = np.minimum(away[rows], 1.0 - away[rows])
        assert (near <= END).all(axis=0).any() or (near <= CORNER).all()


def test_the_sums_of_all_readings_are_those_of_the_solution(bent):
    _, problem, fit = bent
    mine, whole = sums_of(problem, fit, np.arange(problem.sigma.size)), total(fit.parts)
    assert mine.gram == pytest.approx(whole.gram, rel=1e-9, abs=1e-6)
    assert mine.count == pytest.approx(whole.count)
    assert mine.square == pytest.approx(whole.square, rel=1e-3)


def test_set_ups_are_held_out_whole():
    runs = Truth(11).campaign()
    shared = tuple(replace(r, setup="same") if r.label in ("h0", "h1") else r for r in runs)
    f = folds(shared)
    assert f[0] == f[1]
    assert len(set(f.tolist())) >= 3
