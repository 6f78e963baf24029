"""Where the error is known worse than it is large: not compensated, no step, and by the identified field never worse than nothing."""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from abbe.models.compensation.distances import inner_box_mm, random_pairs
from abbe.models.compensation.grid import blend, compensable_nodes, grid_table, nodes_mm, trilinear
from abbe.models.geometry.volume import remove_rigid, rigid_design
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observations import block_average
from tests.models.solvers.truth import MACHINE, Truth

NODES = (np.linspace(0.0, 600.0, 5), np.linspace(0.0, 500.0, 4), np.linspace(0.0, 450.0, 4))
POINTS = nodes_mm(NODES)
BOX = np.array([[n[0], n[-1]] for n in NODES])
SHAPE = (5, 4, 4)


def field(seed, bend=1.0):
    """A smooth random error with a rigid motion on top, at the nodes, mm."""
    rng = np.random.default_rng(seed)
    u = POINTS / BOX[:, 1]
    smooth = sum(rng.normal(0, 10e-3, 3) * np.sin(bend * u @ rng.normal(0, 3.0, 3) + rng.uniform(0, 6.3))[:, None] for _ in range(4))
    return (smooth + np.cross(rng.normal(0, 1e-4, 3), POINTS) + rng.normal(0, 1.0, 3)).reshape(*SHAPE, 3)


def distance_errors(error, correction, pairs):
    ends = [trilinear(NODES, error + correction, p) for p in (pairs.first_mm, pairs.second_mm)]
    return np.einsum("ni,ni->n", pairs.unit, ends[1] - ends[0])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95), st.sampled_from([0.3, 1.0, 5.0]))
@settings(max_examples=40, deadline=None)
def test_no_mask_makes_distances_of_the_identified_field_worse_than_doing_nothing(seed, share, bend):
    error = field(seed, bend)
    mask = np.random.default_rng(seed + 1).random(SHAPE) < share
    correction, done = blend(NODES, error, mask)
    promised, others = random_pairs(BOX), random_pairs(BOX, 4000, seed=77)
    before, after = (np.sum(distance_errors(error, c, promised) ** 2) for c in (np.zeros_like(error), correction))
    assert after <= before * (1 + 1e-9)
    before, after = (np.sum(distance_errors(error, c, others) ** 2) for c in (np.zeros_like(error), correction))
    assert after <= before * 1.05  # pairs that the rule has never seen
    assert done.any() == bool(np.abs(correction).max() > 0)
    assert not np.abs(correction[~done]).any()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_all_nodes_compensated_leaves_no_distance_wrong(seed):
    error = field(seed)
    correction, done = blend(NODES, error, np.ones(SHAPE, dtype=bool))
    assert done.all()
    assert np.abs(distance_errors(error, correction, random_pairs(BOX, 300, seed=2))).max() < 1e-9
    assert correction.reshape(-1, 3) == pytest.approx(-remove_rigid(POINTS, error.reshape(-1, 3)), abs=1e-9)


def test_inside_an_uncompensated_region_no_distance_changes_and_outside_all_are_right():
    error, mask = field(4), np.ones(SHAPE, dtype=bool)
    mask[:3] = False
    correction, done = blend(NODES, error, mask)
    assert (done == mask).all()
    left = random_pairs(np.array([[0.0, 300.0], [0.0, 500.0], [0.0, 450.0]]), 500, seed=3)
    assert distance_errors(error, correction, left) == pytest.approx(distance_errors(error, 0 * correction, left), abs=1e-12)
    right = random_pairs(np.array([[450.0, 600.0], [0.0, 500.0], [0.0, 450.0]]), 500, seed=3)
    assert np.abs(distance_errors(error, correction, right)).max() < 1e-9


def test_the_border_is_no_larger_than_the_error_that_is_left_uncorrected():
    for seed in range(20):
        error, mask = field(seed), np.ones(SHAPE, dtype=bool)
        mask[:2] = False
        correction, done = blend(NODES, error, mask)
        if not done.any():
            continue
        across = random_pairs(BOX, 2000, seed=9)
        whole = distance_errors(error, 0 * correction, across)
        after = distance_errors(error, correction, across)
        assert np.abs(after).max() <= 1.1 * np.abs(whole).max()
        frame, motion = rigid_design(POINTS), done.reshape(-1)
        rest = (error + correction).reshape(-1, 3)
        fit = np.linalg.lstsq(frame[motion].reshape(-1, 6), rest[motion].ravel(), rcond=None)[0]
        step = np.linalg.norm((rest - frame @ fit).reshape(*SHAPE, 3)[1], axis=-1)  # the compensated side of the border has none
        free = np.linalg.norm(remove_rigid(POINTS, error.reshape(-1, 3)), axis=1)
        assert step.max() <= 1.5 * free.max()


def worst_error(mask):
    """The error that the rule would make worst with this mask: largest eigenvalue of "after" against "before", quadratic in the error."""
    n, pairs = len(POINTS), random_pairs(BOX)
    free = np.repeat(mask.reshape(-1), 3)
    units = np.eye(3 * n).reshape(3 * n, *SHAPE, 3)
    to_distance = np.stack([distance_errors(unit, 0 * unit, pairs) for unit in units], axis=1)
    moves = rigid_design(POINTS).reshape(-1, 6) * free[:, None]
    frame = np.linalg.lstsq(to_distance @ moves, -to_distance * ~free, rcond=None)[0]
    after = to_distance * ~free + to_distance @ moves @ frame
    before = to_distance.T @ to_distance
    little = 1e-6 * np.trace(before) / len(before) * np.eye(3 * n)
    error = linalg.eigh(after.T @ after, before + little, subset_by_index=[3 * n - 1, 3 * n - 1])[1][:, 0]
    return (0.02 * error / np.abs(error).max()).reshape(*SHAPE, 3)


@pytest.mark.parametrize(("seed", "share"), [(0, 0.5), (2, 0.9), (4, 0.1)])
def test_where_the_rule_would_do_harm_nothing_is_compensated(seed, share):
    """Random errors never get there: it takes the worst error there is for a mask (2 to 5 times the sum of squares)."""
    mask = np.random.default_rng(seed).random(SHAPE) < share
    error = worst_error(mask)
    correction, done = blend(NODES, error, mask)
    assert mask.any()
    assert not done.any()
    assert not correction.any()
    whole, all_done = blend(NODES, error, np.ones(SHAPE, dtype=bool))  # the same error, all of it known, is compensated
    assert all_done.all()
    assert np.abs(distance_errors(error, whole, random_pairs(BOX, 300, seed=2))).max() < 1e-9


def corner_campaign(truth):
    """Ball-bar helices in one corner of a large volume: little is known of the rest."""
    runs = []
    for k, c in enumerate([(110, 110, 20), (140, 120, 60)]):
        centre = np.array(c, float)
        runs.append(block_average(truth.bar(f"c{k}", centre, 90.0), 200))
    return tuple(runs)


PAIRS = random_pairs(inner_box_mm(MACHINE), 3000, seed=4)


def true_rms(truth, correction):
    off = [truth.deviation(p + correction(p)) + correction(p) for p in (PAIRS.first_mm, PAIRS.second_mm)]
    return float(np.sqrt(np.mean(PAIRS.error_mm(*off) ** 2)))


def test_what_a_campaign_in_one_corner_does_not_know_is_marked_and_machines_together_are_not_harmed():
    """ "No worse" is promised for the identified field. A true machine may become worse; all together may not, and less than unmasked.

    Four machines; eight with ``ABBE_TEST_LONG=1``.
    """
    before, masked, full = [], [], []
    for seed in range(1, 9 if os.environ.get("ABBE_TEST_LONG") == "1" else 5):
        truth = Truth(seed)
        s = solve_joint(MACHINE, corner_campaign(truth))
        mask = compensable_nodes(s, (7, 6, 5))
        assert not mask.all()  # seen: 0 to 0.63 of the nodes are compensated
        table = grid_table(s, (7, 6, 5), compensable=mask)
        left_alone = table.correction_mm[~table.compensated]
        assert np.abs(left_alone - left_alone[0]).max() < 1e-12
        before.append(true_rms(truth, np.zeros_like))
        masked.append(true_rms(truth, table.correction_at))
        full.append(true_rms(truth, grid_table(s, (7, 6, 5)).correction_at))
    ratio, without = (np.array(v) / before for v in (masked, full))
    assert ratio.mean() < 1.0  # seen: 0.90
    assert ratio.max() < 1.2  # one machine may lose; seen: 1.01
    assert without.max() > 1.2  # the same campaigns do harm without the mask; seen: 1.37


def test_a_good_campaign_leaves_almost_nothing_uncompensated_and_loses_nothing_by_the_mask(solved_truth):
    truth, s = solved_truth(2)
    mask = compensable_nodes(s, (9, 9, 9))
    assert mask.mean() > 0.9
    masked, full = (true_rms(truth, grid_table(s, (9, 9, 9), compensable=m).correction_at) for m in (mask, None))
    assert masked < 1.5 * full
