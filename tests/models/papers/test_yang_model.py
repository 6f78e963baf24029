"""Yang and Kim's models against rule G, simulation and statistics (math.md 4)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from abbe.models.geometry.chain import deviation_mm
from abbe.models.notation.yang import YangErrors, iso_motions, iso_squareness, machine, workpiece_mm
from abbe.models.papers.yang.complete import (
    delta_eq1,
    delta_exact,
    difference_eq3,
    measured_mm,
    reading_eq6,
    reading_eq8,
    second_order_bound_mm,
)
from abbe.models.papers.yang.conditioning import SixParameters, delta_eq2, design_eq9, fit_eq9, spread
from abbe.models.papers.yang.difference import confidence_interval, model_difference
from abbe.models.papers.yang.experiments import hemisphere_fits, origin_plan
from abbe.models.paths import helix_points, helix_points_likely_code
from abbe.models.solvers.helix import fit_helix

STROKE = np.array([[0.0, 812.8], [0.0, 495.0], [0.0, 508.0]])
TRUTH = SixParameters(-8.5619e-5, -1.2229e-4, -8.9221e-5, -2.6575e-5, 3.8588e-5, -1.1094e-4)
small = st.floats(-1e-2, 1e-2)


def errors(rng, n: int, mm: float = 1e-2, rad: float = 3e-5) -> YangErrors:
    return YangErrors(rng.normal(0, mm, (n, 3, 3)), rng.normal(0, rad, (n, 3, 3)), *rng.normal(0, rad, 3))


@settings(max_examples=60, deadline=None)
@given(
    arrays(float, (1, 3, 3), elements=small), arrays(float, (1, 3, 3), elements=small), arrays(float, (9,), elements=st.floats(-500, 500))
)
def test_equation_1_is_rule_g(d, e, where):
    slide, tool, s = where[None, :3], where[3:6], where[6:] * 1e-6
    errors_ = YangErrors(d, e, *s)
    general = deviation_mm(machine(STROKE, tool), workpiece_mm(slide), iso_motions(errors_, slide))
    assert delta_eq1(errors_, slide, tool) == pytest.approx(general, abs=1e-12 + 1e-13 * np.abs(where).max())


def test_what_equation_1_leaves_out_is_of_second_order():
    rng = np.random.default_rng(4)
    slide, tool, e = rng.uniform(STROKE[:, 0], STROKE[:, 1], (40, 3)), np.array([20.0, -30.0, 150.0]), errors(rng, 40)
    half = YangErrors(e.d / 2, e.e / 2, e.sxy / 2, e.sxz / 2, e.syz / 2)
    for small_angles in (False, True):
        full = np.abs(delta_exact(e, slide, tool, small_angles=small_angles) - delta_eq1(e, slide, tool)).max()
        less = np.abs(delta_exact(half, slide, tool, small_angles=small_angles) - delta_eq1(half, slide, tool)).max()
        assert 0 < full < 1e-4
        assert full / less == pytest.approx(4.0, rel=0.01)


def test_the_simplified_model_is_the_complete_one_with_six_errors():
    slide = np.random.default_rng(1).uniform(STROKE[:, 0], STROKE[:, 1], (20, 3))
    d = np.zeros((20, 3, 3))
    for i, slope in enumerate((TRUTH.dxx, TRUTH.dyy, TRUTH.dzz)):
        d[:, i, i] = slope * slide[:, i]
    six = YangErrors(d, np.zeros((20, 3, 3)), TRUTH.sxy, TRUTH.sxz, TRUTH.syz)
    assert delta_eq2(TRUTH, slide) == pytest.approx(delta_eq1(six, slide, np.array([5.0, 6.0, 150.0])), abs=1e-15)


def test_equation_3_is_what_the_simplified_model_leaves_out():
    rng = np.random.default_rng(6)
    slide, tool, e = rng.uniform(STROKE[:, 0], STROKE[:, 1], (20, 3)), np.array([20.0, -30.0, 150.0]), errors(rng, 20)
    for i, slope in enumerate((TRUTH.dxx, TRUTH.dyy, TRUTH.dzz)):
        e.d[:, i, i] = slope * slide[:, i]
    whole = YangErrors(e.d, e.e, TRUTH.sxy, TRUTH.sxz, TRUTH.syz)
    left = delta_eq1(whole, slide, tool) - delta_eq2(TRUTH, slide)
    assert difference_eq3(whole, slide, tool) == pytest.approx(left, abs=1e-15)


def test_squareness_letters_describe_the_angles_between_the_three_lines():
    sxy, sxz, syz = 3e-4, -2e-4, 1e-4
    tip = np.concatenate([np.zeros((1, 3)), 100.0 * np.eye(3)])  # workpiece coordinates
    slide = workpiece_mm(tip)
    zero = np.zeros((4, 3, 3))
    at = tip + deviation_mm(machine(STROKE, np.zeros(3)), tip, iso_motions(YangErrors(zero, zero, sxy, sxz, syz), slide))
    x, y, z = ((p - at[0]) / np.linalg.norm(p - at[0]) for p in at[1:])
    for a, b, angle in ((x, y, sxy), (x, z, sxz), (y, z, syz)):
        assert np.arccos(a @ b) - np.pi / 2 == pytest.approx(angle, abs=2e-7)
    assert iso_squareness(sxy, sxz, syz) == {"C0Y": sxy, "B0Z": -sxz, "A0Z": syz}


@pytest.mark.parametrize("radius", [100.0, 175.0])
def test_readings_of_a_real_slide_turn_three_signs_in_the_printed_matrix(radius):
    origin = np.array([406.4, 0.0, 254.0])
    points = helix_points(origin, radius, turns=5, n=63)
    d, error = workpiece_mm(points - origin), delta_eq2(TRUTH, points) - delta_eq2(TRUTH, origin[None])
    reading = reading_eq6(d, error)
    right = fit_eq9(points, origin, reading, radius)
    printed = fit_eq9(points, origin, reading, radius, z_convention="workpiece")
    assert right.parameters.array() == pytest.approx(TRUTH.array(), abs=0.02e-6)
    assert printed.parameters.array() == pytest.approx(TRUTH.array() * [1, 1, -1, 1, -1, -1], abs=0.02e-6)
    assert right.warnings == ()
    assert "dzz, Sxz and Syz" in printed.warnings[0]
    iso = fit_helix(workpiece_mm(points), reading, workpiece_mm(origin), radius, sigma_mm=1e-6, unknowns="six").estimate.theta
    assert iso * [1, 1, 1, 1, -1, 1] == pytest.approx(right.parameters.array(), abs=1e-12)


def test_covariance_of_equation_9_is_the_scatter_of_repeats():
    origin = np.zeros(3)
    points = helix_points(origin, 175.0, turns=3, n=63)
    rng = np.random.default_rng(8)
    fits = np.array([fit_eq9(points, origin, rng.normal(0, 1e-3, 63), 175.0).parameters.array() for _ in range(1500)])
    stated = np.sqrt(np.diag(fit_eq9(points, origin, np.zeros(63), 175.0).covariance_per_mm2)) * 1e-3
    assert np.std(fits, axis=0) == pytest.approx(stated, rel=0.08)
    assert stated == pytest.approx(spread(design_eq9(points, origin, setup=False)).sigma_per_mm * 1e-3, rel=1e-9)


def test_points_that_leave_a_parameter_open_are_refused():
    flat = np.stack([np.cos(np.arange(20.0)), np.sin(np.arange(20.0)), np.zeros(20)], axis=1) * 100
    with pytest.raises(ValueError, match="at least one coordinate from the centre is zero"):
        fit_eq9(flat, np.zeros(3), np.zeros(20), 100.0)
    with pytest.raises(ValueError, match="six parameters"):
        fit_eq9(flat[:5], np.zeros(3), np.zeros(5), 100.0)
    with pytest.raises(ValueError, match="z_convention"):
        fit_eq9(flat, np.zeros(3), np.zeros(20), 100.0, z_convention="up")


def test_linear_reading_differs_from_the_exact_one_by_no_more_than_the_bound():
    rng = np.random.default_rng(2)
    d = helix_points(np.zeros(3), 175.0, turns=5, n=63)
    error = rng.normal(0, 17e-3, (63, 3))
    off = reading_eq6(d, error) - reading_eq8(d, error)
    bound = second_order_bound_mm(error, 175.0)
    assert (off >= -1e-12).all()  # what is across the bar lengthens it
    assert (off <= bound * (1 + 1e-3)).all()
    across = np.cross(d, [0.3, 0.2, 0.9])
    across *= 30e-3 / np.linalg.norm(across, axis=1)[:, None]
    tight = reading_eq6(d, across) - reading_eq8(d, across)
    assert tight == pytest.approx(second_order_bound_mm(across, 175.0), rel=1e-3)
    assert tight.max() == pytest.approx(2.57e-6, rel=0.01)  # 0.003 µm (math.md 4.2)
    assert measured_mm(d + error, np.zeros(3), 175.0, 0.01) == pytest.approx(reading_eq6(d, error) + 0.01, abs=2e-13)


def complete(p):
    wave = 4e-3 * np.sin(p / 130.0)
    return wave + 2e-3


def nothing(p):
    return np.zeros_like(p)


@pytest.mark.parametrize(
    ("points", "repeats", "law", "least", "most"),
    [(20, 20, "student", 0.93, 0.97), (2, 200, "student", 0.93, 0.97), (2, 200, "normal", 0.85, 0.92)],
)  # 900 trials: standard error 0.7 %; the paper's mean of standard deviations is too short for few points a repeat
def test_interval_of_the_mean_covers_the_true_mean_in_95_of_100_seeds(points, repeats, law, least, most):
    box = np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 500.0]])
    fine = np.linspace(0, 1, 200001)
    true = np.array([complete(lo + fine * (hi - lo)).mean() for lo, hi in box])
    inside = []
    for seed in range(300):
        found = model_difference(complete, nothing, box, seed=seed, points=points, repeats=repeats, law=law)
        inside.append((found.interval_mm[:, 0] <= true) & (true <= found.interval_mm[:, 1]))
    share = np.mean(inside)
    assert least < share < most


def test_standard_deviation_is_pooled_for_student_and_averaged_in_the_papers_way():
    """With two points a repeat, n - 1 and n differ by a factor of 2 in variance: the formulas are written out here."""
    drawn = []

    def recorded(p):
        drawn.append(complete(p))
        return drawn[-1]

    box = np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 500.0]])
    pooled = model_difference(recorded, nothing, box, seed=3, points=2, repeats=6)
    paper = model_difference(recorded, nothing, box, seed=3, points=2, repeats=6, law="normal")
    first, second = drawn[0][0::2], drawn[0][1::2]  # a repeat's two values: variance (a - b)² / 2
    assert pooled.sd_mm == pytest.approx(np.sqrt(((first - second) ** 2 / 2).sum(axis=0) / 6), rel=1e-12)
    assert paper.sd_mm == pytest.approx((np.abs(first - second) / np.sqrt(2)).sum(axis=0) / 6, rel=1e-12)
    half = np.diff(pooled.interval_mm)[:, 0] / 2
    assert half == pytest.approx(2.446911851 * pooled.sd_mm / np.sqrt(12), rel=1e-9)  # t(0.975), 6 degrees of freedom, from a table
    assert np.diff(paper.interval_mm)[:, 0] / 2 == pytest.approx(1.96 * paper.sd_mm / np.sqrt(12), rel=1e-12)


def test_printed_intervals_carry_the_normal_factor_not_students():
    mean, sd = np.array([1.7, 5.3, -5.4]), np.array([1.8, 2.5, 1.9])
    table1 = np.array([[1.66472, 1.73528], [5.251, 5.349], [-5.43724, -5.36276]])
    assert confidence_interval(mean, sd, 10000, law="normal") == pytest.approx(table1, abs=5e-10)
    student = confidence_interval(mean, sd, 10000)
    assert np.abs(student - table1).max() > 1e-6
    assert student == pytest.approx(table1, abs=2e-5)
    assert np.diff(confidence_interval(mean, sd, 5))[0, 0] > 1.3 * np.diff(confidence_interval(mean, sd, 5, law="normal"))[0, 0]
    for bad in (
        {"n": 1},
        {"n": np.nan},
        {"n": 9, "degrees_of_freedom": 0},
        {"n": 9, "level": 1.0},
        {"n": 9, "law": "normal", "level": 0.9},
        {"n": 9, "law": "cauchy"},
    ):
        with pytest.raises(ValueError, match="confidence interval"):
            confidence_interval(mean, sd, **bad)
    for wrong in (-sd, sd * np.nan):
        with pytest.raises(ValueError, match="standard deviations"):
            confidence_interval(mean, wrong, 9)


def test_same_seed_same_points():
    box = np.array([[0.0, 1.0]] * 3)
    a, b, c = (model_difference(complete, nothing, box, seed=s, points=10, repeats=3) for s in (1, 1, 2))
    assert (a.mean_mm == b.mean_mm).all()
    assert (a.mean_mm != c.mean_mm).all()


def test_likely_code_has_the_papers_63_samples_and_stops_short_of_the_equator():
    p = helix_points_likely_code(np.zeros(3), 175.0, turns=5)
    assert p.shape == (63, 3)
    assert np.linalg.norm(p, axis=1) == pytest.approx(175.0)
    assert p[0] == pytest.approx([0, 175, 0])
    assert 0.02 * 175 < p[-1, 1] < 0.022 * 175
    near = helix_points(np.zeros(3), 175.0, turns=5 * 6.2 / (2 * np.pi), n=63, span_rad=1.55)
    assert p == pytest.approx(near, abs=1e-9)
    with pytest.raises(ValueError, match="radius"):
        helix_points_likely_code(np.zeros(3), 0.0, turns=5)


def test_origins_stand_on_the_bed_and_hemispheres_are_checked_against_the_travel():
    plan = origin_plan(STROKE)
    assert plan[0] == pytest.approx([406.4, 0.0, 254.0])
    assert sorted(tuple(p) for p in plan[1:] - plan[0]) == [(-200, 0, -75), (-200, 0, 75), (200, 0, -75), (200, 0, 75)]
    assert all(hemisphere_fits(o, 175.0, STROKE).ok for o in plan)
    assert not hemisphere_fits(plan[0], 260.0, STROKE).ok
    over = hemisphere_fits(plan[1], 250.0, STROKE).over_mm
    assert over == pytest.approx(np.array([[43.6, 0.0], [0.0, 0.0], [71.0, 0.0]]), abs=1e-9)
    points = helix_points(plan[1], 250.0, turns=40, n=5000)
    assert STROKE[:, 0] - points.min(axis=0) == pytest.approx(over[:, 0], abs=0.3)
    upper = hemisphere_fits(np.array([700.0, 300.0, 400.0]), 250.0, STROKE)  # 700 + 250 - 812.8; 300 + 250 - 495; 400 + 250 - 508
    assert upper.over_mm == pytest.approx(np.array([[0.0, 137.2], [0.0, 55.0], [0.0, 142.0]]), abs=1e-9)
    assert not upper.ok
    below = hemisphere_fits(np.array([400.0, -1.0, 254.0]), 100.0, STROKE)
    assert below.over_mm == pytest.approx(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), abs=1e-9)
    vertical = hemisphere_fits(np.array([400.0, 250.0, 400.0]), 150.0, STROKE, axis=2)
    assert vertical.over_mm == pytest.approx(np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 42.0]]), abs=1e-9)
    with pytest.raises(ValueError, match="radius"):
        hemisphere_fits(plan[0], -1.0, STROKE)
    with pytest.raises(ValueError, match="origins"):
        origin_plan(STROKE[:, ::-1])
