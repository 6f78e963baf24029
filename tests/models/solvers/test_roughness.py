"""Rough machines: the evidence for what is rough, the lead of a screw by its period, and maps that stay inside their prior."""

import os

import numpy as np
import pytest

from abbe.models.geometry.bases import SMOOTH_ORDER, smooth_terms
from abbe.models.paths import straight_line
from abbe.models.solvers.assessment import map_against_prior
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.solvers.priors import Priors, rough_root, size_model, smooth_shapes
from abbe.models.solvers.roughness import periods, rough_lines
from tests.models.solvers.truth import MACHINE, Truth

LONG = os.environ.get("ABBE_TEST_LONG") == "1"


class Screw(Truth):
    """A lead error of 2 µm with a period of 10 mm on X."""

    def motions(self, p: np.ndarray) -> np.ndarray:
        out = super().motions(p)
        out[:, 0, 0] += 2e-3 * np.sin(2 * np.pi * p[:, 0] / 10.0 + 0.3)
        return out


class Walk(Truth):
    """Straightness and positioning that wander like a random walk: kinks at every length."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        step = np.random.default_rng([seed, 5]).normal(size=(3, 3, 401)) * 0.5e-3
        self.walk = np.cumsum(step, axis=2)

    def motions(self, p: np.ndarray) -> np.ndarray:
        out = super().motions(p)
        for a in range(3):
            for c in range(3):
                out[:, a, c] += np.interp(p[:, a] / MACHINE.length_mm[a], np.linspace(0, 1, 401), self.walk[a, c])
        return out


def fine_line(truth: Truth) -> tuple:
    """The campaign, and a line along X with a reading every 2 mm, as a manufacturer records a screw."""
    start, end = np.array([5.0, 250.0, 225.0]), np.array([595.0, 250.0, 225.0])
    return (*truth.campaign(), truth.laser("fine", straight_line(start, end, 300)))


def test_the_lead_of_a_screw_is_named_with_its_period_and_the_spacing_of_a_table_that_follows_it():
    solution = solve_joint(MACHINE, fine_line(Screw(5)))
    (found,) = periods(solution)
    assert found.motion == "EXX"
    assert abs(found.period_mm - 10.0) < 2.0 * found.u_period_mm < 0.05
    assert abs(found.amplitude_mm - 2e-3) < 3.0 * found.u_amplitude_mm < 0.4e-3
    assert rough_lines(solution)[0].startswith("EXX: ")
    assert "only a table with points every 2.5 mm or less follows it" in rough_lines(solution)[0]


@pytest.fixture(scope="module")
def smooth() -> JointSolution:
    return solve_joint(MACHINE, fine_line(Truth(6)))


@pytest.fixture(scope="module")
def rough() -> tuple[Truth, JointSolution]:
    truth = Walk(6)
    return truth, solve_joint(MACHINE, fine_line(truth))


def test_no_period_is_claimed_where_there_is_none(smooth, rough):
    assert periods(smooth) == ()
    assert periods(rough[1]) == ()


def test_only_a_rough_machine_is_solved_for_rough_parts_and_its_map_is_better_than_no_map(smooth, rough, solved_truth):
    truth, found = rough
    for one in (smooth, solved_truth(2)[1]):
        assert max(t.order for t in one.terms) == SMOOTH_ORDER
        assert rough_lines(one) == ()
    assert max(t.order for t in found.terms) > SMOOTH_ORDER
    assert rough_lines(found)
    p = np.random.default_rng(1).uniform(MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], (300, 3))
    rigid = np.column_stack([np.ones(300), p])  # offsets and rotations, and as much of scale and squareness: the same for both
    left = [d - rigid @ np.linalg.lstsq(rigid, d, rcond=None)[0] for d in (truth.deviation(p), truth.deviation(p) - found.deviation_mm(p))]
    assert np.std(left[1]) < 0.8 * np.std(left[0])


@pytest.mark.parametrize("seed", range(500) if LONG else [1, 2, 401])
def test_poor_campaigns_never_make_a_machine_less_known_than_its_prior_or_a_map_larger_than_it_and_the_readings(seed):
    """Three runs, one corner, one diagonal, whatever is left of a campaign: nothing explodes outside of what was measured.

    A step diagonal alone (401 of 500) gives such a map. `carried` refuses it, and Abbe solves for six parameters instead.
    """
    rng = np.random.default_rng([seed, 18])
    truth = (Truth, Walk)[seed % 2](1000 + seed)
    runs = truth.campaign()
    some = tuple(runs[i] for i in sorted(rng.choice(len(runs), int(rng.integers(1, 6)), replace=False)))
    solution = solve_joint(MACHINE, some)
    against = map_against_prior(solution)
    measured = max(float(np.sqrt(np.mean(r.deviation_mm**2))) for r in some)
    assert against.u_mm <= against.prior_mm
    if seed == 401:
        assert not against.carried
    else:
        assert against.predicted_mm <= against.prior_mm + 2.0 * measured
    posterior, prior = solution.estimate.covariance.diagonal(), solution.prior_sd**2
    assert (posterior <= prior * (1 + 1e-9)).all()


def test_sizes_never_grow_with_the_order_whatever_the_data_say():
    model = size_model(MACHINE, smooth_terms(SMOOTH_ORDER), (), np.ones(0), Priors())
    highest = np.where(np.isfinite(model.high), model.high, 6.0)
    size = np.linalg.norm(model.root * np.exp(0.5 * model.design @ np.minimum(highest, 2.0 * np.log(5.0))), axis=1)
    for block in model.blocks:
        assert size[block][-1] < size[block][:2].max()
    shapes, variance = smooth_shapes(SMOOTH_ORDER, 0.1)
    assert np.diff(variance).max() <= 0.0
    assert shapes.T @ shapes == pytest.approx(np.eye(len(shapes)), abs=1e-9)
    rough = np.linalg.norm(rough_root(13, 36, 0.05), axis=1)
    assert rough[-1] < 1.05 * rough[0]
