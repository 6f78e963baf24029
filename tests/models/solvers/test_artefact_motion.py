"""What the motions above the orders of a model add to weighted sums of a machine's deviations."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import legendre

from abbe.models.geometry.bases import ROUGH_ORDER, rough_terms, smooth_terms
from abbe.models.solvers.artefact import Fine
from abbe.models.solvers.artefact_motion import above_orders_mm2, unfollowed_mm2
from abbe.models.solvers.priors import ROUGH_LENGTH_MM, Priors

LENGTH_MM = np.array([800.0, 500.0, 450.0])
PLATE = np.array([[x, y, 200.0] for x in (100.0, 250.0, 400.0) for y in (60.0, 160.0, 260.0, 360.0)])


def solution(*, rough: bool = True, fine: tuple[Fine, ...] = ()) -> Any:
    """The parts of a solution that matter here: rough motions twice as large as documented, on a machine half as large."""
    return SimpleNamespace(
        terms=smooth_terms(12) + (rough_terms() if rough else ()),
        size_factors={"rough": 2.0, "machine": 0.5},
        machine=SimpleNamespace(length_mm=LENGTH_MM),
        data=(SimpleNamespace(points=SimpleNamespace(fine=fine)),),
    )


def test_the_variance_above_the_orders_is_what_drawn_motions_have_left() -> None:
    rng, nodes = np.random.default_rng(4), 400
    u, weight = legendre.leggauss(nodes)
    values = legendre.legvander(u, ROUGH_ORDER)
    for length, found in zip(LENGTH_MM, above_orders_mm2(solution()), strict=True):
        process = np.exp(-np.abs(u[:, None] - u) * length / 2.0 / ROUGH_LENGTH_MM)
        drawn = Priors().rough_mm * np.linalg.cholesky(process + 1e-12 * np.eye(nodes)) @ rng.standard_normal((nodes, 2000))
        series = ((np.arange(ROUGH_ORDER + 1) + 0.5)[:, None] * values.T * weight) @ drawn
        left = drawn - values @ series
        assert found == pytest.approx(float(weight @ (left**2).mean(axis=1)) / 2.0, rel=0.05)
    assert not above_orders_mm2(solution(rough=False)).any()


def test_a_motion_is_one_value_at_each_position_of_its_axis() -> None:
    """Sums of drawn motions of X and Y along x and y scatter as stated; where each position has its own unknown, nothing is added."""
    rng = np.random.default_rng(5)
    weights = rng.standard_normal((3, len(PLATE), 3)) * [1.0, 1.0, 0.0]
    size = np.sqrt(above_orders_mm2(solution()))
    columns, rows = np.unique(PLATE[:, 0], return_inverse=True)[1], np.unique(PLATE[:, 1], return_inverse=True)[1]
    moved = size[0] * rng.standard_normal((20000, 3, 3))[:, columns] + size[1] * rng.standard_normal((20000, 4, 3))[:, rows]
    sums = np.einsum("knc,rnc->rk", weights, moved)
    assert unfollowed_mm2(solution(), PLATE, weights) == pytest.approx(sums.var(axis=0), rel=0.05)
    followed = tuple(Fine(0, 0, x) for x in (100.0, 250.0, 400.0)) + tuple(Fine(1, 1, y) for y in (60.0, 160.0, 260.0, 360.0))
    along_x = weights * [1.0, 0.0, 0.0]
    of_y = np.add.reduceat(along_x.reshape(3, 3, 4, 3).sum(axis=1), [0, 1, 2, 3], axis=1)
    assert unfollowed_mm2(solution(fine=followed), PLATE, along_x) == pytest.approx(size[1] ** 2 * (of_y**2).sum(axis=(1, 2)))
