"""Random machines: how far rule G is from the exact transforms, the analytic derivatives, and what a change of datum leaves alone."""

import os
import time
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import (
    all_chains,
    design,
    deviation_mm,
    exact_deviation_mm,
    exact_jacobian,
    motion_jacobian,
    squareness_jacobian,
    squareness_motions,
)
from abbe.models.machine import Machine
from tests.experiments.mathematics.datum import (
    change_datum,
    datum_slopes,
    lines_from_squareness,
    squareness_from_lines,
    turned_deviation_mm,
)

MACHINES = 10_000 if os.environ.get("ABBE_TEST_LONG") == "1" else 1000
CHAINS = all_chains()
DATUMS = ["".join(p) for p in permutations("XYZ", 2)]
STROKE = np.array([[0.0, 1000.0], [0.0, 800.0], [0.0, 600.0]])
SEEDS = st.integers(0, 2**32 - 1)
PROPERTY = settings(max_examples=100, deadline=None, derandomize=True)


def random_machine(rng, n, um=20.0, urad=50.0):
    """A machine of any chain with pivots and strokes, n positions, a tool per position, and error motions of the usual size."""
    start = rng.uniform(-500, 0, 3)
    stroke = np.stack([start, start + rng.uniform(200, 2000, 3)], axis=1)
    m = Machine(CHAINS[rng.integers(24)], stroke, rng.uniform(-500, 500, (3, 3)))
    motions = rng.normal(0.0, 1.0, (n, 3, 6)) * np.array([um * 1e-3] * 3 + [urad * 1e-6] * 3)
    return m, rng.uniform(stroke[:, 0], stroke[:, 1], (n, 3)), motions, rng.uniform(-300, 300, (n, 3))


def test_what_the_first_order_neglects_falls_by_four_when_the_errors_are_halved_on_every_machine():
    """Statistic: rms of |exact - first order| over 8 points, one ratio per machine; every one has to lie within 4 +- 0.4.

    At 20 um and 50 urad the second order is 2e-6 to 4e-5 mm and the rounding of the two sums 1e-16 mm, so rounding plays no part.
    """
    rng = np.random.default_rng(20_000)
    ratio, size = np.empty(MACHINES), np.empty(MACHINES)
    for i in range(MACHINES):
        m, p, motions, tools = random_machine(rng, 8)
        both, twice = np.concatenate([motions, 0.5 * motions]), lambda a: np.concatenate([a, a])
        args = (m, twice(p), both, twice(tools))
        gap = exact_deviation_mm(*args) - deviation_mm(*args)
        full, half = np.sqrt((gap.reshape(2, 8, 3) ** 2).sum(axis=2).mean(axis=1))
        ratio[i], size[i] = full / half, full
    assert (np.abs(ratio - 4.0) <= 0.4).all()
    assert np.abs(ratio - 4.0).max() < 1e-3  # third order is 1e-4 of second
    assert size.min() > 1e-6
    assert size.max() < 1e-4


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize(
    "urad", [0.0, 50.0, 1e6]
)  # no errors, the usual ones, and 1 rad: the small-angle limit and both branches of its series
def test_exact_jacobian_is_the_derivative_of_the_exact_kinematics(chain, urad):
    rng = np.random.default_rng(CHAINS.index(chain))
    n = 12
    _, p, motions, tools = random_machine(rng, n, urad=urad)
    m = Machine(chain, STROKE, rng.uniform(-500, 500, (3, 3)))
    found = exact_jacobian(m, p, motions, tools)
    assert found.shape == (n, 3, 3, 6)
    for j in range(3):
        for k in range(6):
            step = np.zeros((n, 3, 6))
            step[:, j, k] = 1e-2 if k < 3 else 2e-5
            slope = exact_deviation_mm(m, p, motions + step, tools) - exact_deviation_mm(m, p, motions - step, tools)
            slope /= 2.0 * step[0, j, k]
            size = np.linalg.norm(found[:, :, j, k], axis=1)
            assert (np.linalg.norm(slope - found[:, :, j, k], axis=1) <= 1e-7 * size).all(), (j, k)


@PROPERTY
@given(SEEDS)
def test_motion_jacobian_is_linear_and_the_exact_one_without_errors(seed):
    rng = np.random.default_rng(seed)
    m, p, motions, tools = random_machine(rng, 7)
    found = motion_jacobian(m, p, tools)
    assert found == pytest.approx(exact_jacobian(m, p, np.zeros_like(motions), tools), abs=1e-12)
    h = 1e-3
    for j in range(3):
        for k in range(6):
            step = np.zeros_like(motions)
            step[:, j, k] = h
            slope = (deviation_mm(m, p, motions + step, tools) - deviation_mm(m, p, motions - step, tools)) / (2 * h)
            size = np.linalg.norm(found[:, :, j, k], axis=1)
            assert (np.linalg.norm(slope - found[:, :, j, k], axis=1) <= 1e-7 * np.maximum(size, 1e-3)).all()


@PROPERTY
@given(SEEDS)
def test_squareness_jacobian_is_the_derivative_with_respect_to_the_angles(seed):
    rng = np.random.default_rng(seed)
    m, p, motions, tools = random_machine(rng, 7)
    start = None if rng.random() < 0.5 else m.stroke_mm[:, 0]
    exact = squareness_jacobian(p, start, motion=exact_jacobian(m, p, motions, tools))
    first = squareness_jacobian(p, start)
    x = p - (0.0 if start is None else start)
    zero = np.zeros(7)  # conventions: Y line (-C0Y, 1, 0), Z line (B0Z, -A0Z, 1)
    by_hand = [[-x[:, 1], zero, zero], [x[:, 2], zero, zero], [zero, -x[:, 2], zero]]
    assert first == pytest.approx(np.array(by_hand).transpose(2, 1, 0), abs=1e-12)
    h = 1e-5
    for k in range(3):
        step = h * squareness_motions(p, start)[..., k]
        slope = (exact_deviation_mm(m, p, motions + step, tools) - exact_deviation_mm(m, p, motions - step, tools)) / (2 * h)
        assert np.linalg.norm(slope - exact[:, :, k]) <= 1e-7 * np.linalg.norm(exact[:, :, k])


def test_squareness_from_the_start_of_the_stroke_is_the_column_of_the_solver():
    m, p, _, _ = random_machine(np.random.default_rng(3), 9)
    columns = design(m, smooth_terms(1), p)[:, :, -3:]
    assert squareness_jacobian(p, m.stroke_mm[:, 0]) == pytest.approx(columns, abs=1e-12)


def with_squareness(p, motions, angles, datum):
    out = motions.copy()
    out[:, :, :3] += datum_slopes(angles, datum) * p[:, :, None]
    return out


@PROPERTY
@given(SEEDS, st.sampled_from(DATUMS), st.sampled_from(DATUMS))
def test_datum_changes_distances_in_second_order_only(seed, one, other):
    """First-order changes of all distances are equal to rounding; the distances themselves differ, by a part that halving divides by 4."""
    rng = np.random.default_rng(seed)
    m, p, motions, tools = random_machine(rng, 8)
    angles = rng.normal(0, 50e-6, 3)
    i, j = np.triu_indices(8, 1)
    unit = (p[i] - p[j]) / pdist(p)[:, None]

    def linear(datum):
        d = deviation_mm(m, p, with_squareness(p, motions, angles, datum), tools)
        return ((d[i] - d[j]) * unit).sum(axis=1)

    def distances(datum, scale, f):
        return pdist(p + f(m, p, scale * with_squareness(p, motions, angles, datum), tools))

    assert linear(one) == pytest.approx(linear(other), abs=1e-13)
    for f in (deviation_mm, exact_deviation_mm):
        # 100 and 50 times the usual size, so that the part left, some 0.1 mm, stands far above the rounding of the distances
        full, half = (np.linalg.norm(distances(one, s, f) - distances(other, s, f)) for s in (100.0, 50.0))
        assert full < 5.0
        if one != other and full > 1e-6:
            assert full / half == pytest.approx(4.0, abs=0.4)


@PROPERTY
@given(SEEDS, st.sampled_from(DATUMS), st.sampled_from(DATUMS))
def test_finite_rotation_to_another_datum_leaves_distances_to_rounding(seed, one, other):
    rng = np.random.default_rng(seed)
    m, p, motions, tools = random_machine(rng, 8)
    angles = rng.normal(0, 1e-3, 3)
    field = exact_deviation_mm(m, p, with_squareness(p, motions, angles, one), tools)
    lines = lines_from_squareness(angles, one)
    change = change_datum(lines, other)
    turned = turned_deviation_mm(p, field, change.rotation_rad)
    assert pdist(p + turned) == pytest.approx(pdist(p + field), abs=5e-12, rel=0)
    if one[0] != other[0]:
        assert np.abs(turned - field).max() > 1e-4  # it is not that nothing happened
    # the lines themselves turn along: whoever moves along them gets the same points in either frame
    assert p @ change.lines == pytest.approx(p @ lines + turned_deviation_mm(p @ lines, np.zeros((8, 3)), change.rotation_rad), abs=5e-12)


@PROPERTY
@given(SEEDS, st.sampled_from(DATUMS), st.sampled_from(DATUMS))
def test_lines_and_squareness_are_one_thing_seen_from_any_datum(seed, one, other):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-0.1, 0.1, 3)
    lines = lines_from_squareness(angles, one)
    assert squareness_from_lines(rng.uniform(0.1, 9.0, (3, 1)) * lines) == pytest.approx(angles, abs=1e-14)
    assert np.degrees(np.arccos(lines[0] @ lines[1])) - 90.0 == pytest.approx(np.degrees(angles[0]), abs=1e-12)  # obtuse: C0Y > 0
    changed = change_datum(lines, other)
    assert changed.lines == pytest.approx(lines_from_squareness(angles, other), abs=1e-14)
    assert change_datum(changed.lines, one).lines == pytest.approx(lines, abs=1e-14)
    small = 1e-4 * angles
    first = np.eye(3) + datum_slopes(small, one)
    assert first == pytest.approx(lines_from_squareness(small, one), abs=3e-10)  # second order of 1e-5
    # to first order the rotation is what turns the old slopes into the new
    rotation = change_datum(lines_from_squareness(small, one), other).rotation_rad
    assert datum_slopes(small, other) == pytest.approx(datum_slopes(small, one) + np.cross(rotation, np.eye(3)), abs=3e-10)


def test_the_papers_datums():
    a, b1, b2 = 3e-5, -2e-5, 7e-5  # obtuse: theta_XY, theta_XZ, theta_YZ
    iso = np.array([a, -b1, b2])
    assert datum_slopes(iso, "XY").tolist() == [[0, 0, 0], [-a, 0, 0], [-b1, -b2, 0]]  # Wang (9); ISO (-C0Y, 1, 0), (B0Z, -A0Z, 1)
    assert datum_slopes(iso, "YX").tolist() == [[0, -a, 0], [0, 0, 0], [-b1, -b2, 0]]  # Pahk: X (1, -alpha, 0), Z (-beta1, -beta2, 1)
    assert datum_slopes(iso, "ZX").tolist() == [[0, 0, -b1], [-a, 0, -b2], [0, 0, 0]]  # Yang: X (1, 0, -Sxz), Y (-Sxy, 1, -Syz)


@pytest.mark.parametrize("datum", ["", "X", "XX", "XA", "xy", "XYZ"])
def test_a_datum_that_is_none_is_refused(datum):
    with pytest.raises(ValueError, match="datum"):
        datum_slopes(np.zeros(3), datum)


def test_bad_angles_and_lines_are_refused():
    with pytest.raises(ValueError, match="squareness"):
        lines_from_squareness(np.array([0.0, 1.6, 0.0]))
    with pytest.raises(ValueError, match="lines"):
        squareness_from_lines(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="lines"):
        change_datum(np.eye(2), "XY")
    lines = np.eye(3)
    lines[1, 1] = np.nan
    with pytest.raises(ValueError, match="finite numbers"):
        change_datum(lines, "XY")
    for second in ([2.0, 0.0, 0.0], [-1.0, 1e-12, 0.0]):
        with pytest.raises(ValueError, match="the X and the Y line are parallel"):
            change_datum(np.array([[1.0, 0.0, 0.0], second, [0.0, 0.0, 1.0]]), "XY")
    with pytest.raises(ValueError, match="the Z line has no direction"):
        squareness_from_lines(np.diag([1.0, 1.0, 0.0]))


@pytest.mark.parametrize("size", [1e-300, 1e300])
def test_lines_of_any_length_are_the_same_lines(size):
    lines = lines_from_squareness(np.array([1e-3, 2e-3, -3e-3]), "ZX")
    assert squareness_from_lines(size * lines) == pytest.approx([1e-3, 2e-3, -3e-3], abs=1e-15)


def test_shapes_are_checked_everywhere_and_lists_are_arrays():
    m, p, motions, _ = random_machine(np.random.default_rng(2), 4)
    for call in (
        lambda: motion_jacobian(m, p[:, :1]),
        lambda: motion_jacobian(m, p[0]),
        lambda: squareness_motions(p[:, :2]),
        lambda: squareness_jacobian(p[:, :2]),
        lambda: squareness_jacobian(p, np.zeros(2)),
        lambda: squareness_jacobian(p, motion=np.zeros((3, 3, 3, 6))),
        lambda: exact_jacobian(m, p[:3], motions),
        lambda: deviation_mm(m, p[0], motions),
        lambda: exact_deviation_mm(m, p, motions[..., :3]),
    ):
        with pytest.raises(ValueError, match="shape"):
            call()
    assert deviation_mm(m, p.tolist(), motions.tolist()).tolist() == deviation_mm(m, p, motions).tolist()
    assert exact_deviation_mm(m, p.tolist(), motions.tolist()).tolist() == exact_deviation_mm(m, p, motions).tolist()
    assert exact_jacobian(m, p.tolist(), motions.tolist()).tolist() == exact_jacobian(m, p, motions).tolist()
    p[1, 0] = np.nan
    assert np.isnan(deviation_mm(m, p, motions)).any(axis=1).tolist() == [False, True, False, False]


def test_forty_thousand_points_take_a_fraction_of_a_second():
    m, p, motions, tools = random_machine(np.random.default_rng(1), 40_000)
    begin = time.process_time()
    exact_deviation_mm(m, p, motions, tools)
    assert time.process_time() - begin < 2.0
