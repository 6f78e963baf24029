"""Rule G against the exact transforms for all 24 chains, and the ranks that math.md 4.6 states."""

from itertools import permutations

import numpy as np
import pytest

from models.geometry.bases import smooth_terms
from models.geometry.chain import design, deviation_mm, exact_deviation_mm, travel_sign
from models.machine import Machine, split_chain
from models.solvers.identifiability import analyse
from models.volumetric import volume_grid

STROKE = np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]])
CHAINS = [
    "-".join(["w", *order[:k], "b", *order[k:], "t"]) for order in permutations("XYZ") for k in range(4)
]  # 24: 6 orders x 4 places of the bed


@pytest.mark.parametrize("chain", CHAINS)
def test_first_order_differs_from_exact_by_second_order(chain):
    rng = np.random.default_rng(CHAINS.index(chain))
    m = Machine(chain, STROKE, rng.uniform(-300, 300, (3, 3)), np.array([10.0, -20.0, -120.0]))
    p = rng.uniform(STROKE[:, 0], STROKE[:, 1], (50, 3))
    errors = np.concatenate([rng.normal(0, 10e-3, (50, 3, 3)), rng.normal(0, 30e-6, (50, 3, 3))], axis=2)

    def gap(scale):
        return np.abs(exact_deviation_mm(m, p, scale * errors) - deviation_mm(m, p, scale * errors)).max()

    assert gap(1.0) < 1e-5
    assert gap(1.0) / gap(0.5) == pytest.approx(4.0, abs=0.4)


def test_work_side_levers_include_own_travel_and_tool_side_levers_do_not():
    p = np.array([[100.0, 50.0, 25.0]])
    errors = np.zeros((1, 3, 6))
    errors[0, 0, 5] = 1e-6  # ECX
    table = deviation_mm(Machine("w-X-b-Y-Z-t", STROKE), p, errors)
    head = deviation_mm(Machine("w-b-X-Y-Z-t", STROKE), p, errors)
    assert table == pytest.approx(1e-6 * np.array([[-50.0, 100.0, 0.0]]))
    assert head == pytest.approx(1e-6 * np.array([[-50.0, 0.0, 0.0]]))


@pytest.mark.parametrize(("degree", "rank"), [(1, 11), (2, 25), (3, 39)])
def test_rank_of_a_full_vector_map_with_one_tool_is_that_of_the_specification(degree, rank):
    m = Machine("w-Z-b-X-Y-t", np.array([[0, 812.8], [0, 495.0], [0, 508.0]]), tool_mm=np.array([0.0, 0.0, 150.0]))
    terms = smooth_terms(degree)
    points = volume_grid(m.stroke_mm, 6)
    full = design(m, terms, points)
    rigid = np.eye(3)[None].repeat(len(points), 0)
    from models.solvers.identifiability import project_out

    a = project_out(full.reshape(-1, len(terms)), rigid.reshape(-1, 3))
    found = analyse(tuple(t.name for t in terms), a)
    assert (found.n_parameters, found.rank) == (18 * degree - 3, rank)


@pytest.mark.parametrize("bad", ["w-X-Y-b-Z", "X-Y-Z", "w-X-X-b-Z-t", "w-X-Y-Z-t", ""])
def test_a_chain_that_is_no_chain_is_refused(bad):
    with pytest.raises(ValueError, match="chain"):
        split_chain(bad)


def test_travel_sign_holds_while_resting_and_looks_ahead_at_the_start():
    p = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    assert travel_sign(p).tolist() == [[1, 1, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0], [-1, 1, 0]]
