"""Probe: frame, master sphere, lobing map, and the point that a touch really had."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.papers.probe.calibration import calibrate, fit_sphere, map_of_pattern, master_sphere_pattern, without_absorbed
from abbe.models.papers.probe.model import (
    LobingMap,
    combined_deviation_mm,
    contact_point_mm,
    direction,
    direction_angles,
    printed_eq17_mm,
    probe_error_mm,
    probe_frame,
    to_machine,
    to_probe,
)

ANGLE = st.floats(-10.0, 10.0)
PATTERN = master_sphere_pattern()
NORMAL = direction(PATTERN[:, 0], PATTERN[:, 1])


def lobe(ph, th):
    return 0.004 * np.sin(ph) ** 2 * np.cos(3 * th + 0.3) + 0.002 * (np.cos(ph) ** 2 - 1 / 3) + 0.001 * np.sin(2 * ph) * np.cos(th)


def some_map(seed=0) -> LobingMap:
    rng = np.random.default_rng(seed)
    return LobingMap(np.deg2rad([30.0, 60.0, 90.0]), np.deg2rad([10.0, 100.0, 200.0, 300.0]), rng.normal(size=(3, 4)), 0.5)


@given(ANGLE, ANGLE)
def test_the_frame_is_a_rotation_and_is_rz_ry(tilt, roll):
    tp = probe_frame(tilt, roll)
    assert tp.T @ tp == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(tp) == pytest.approx(1.0)
    (sa, ca), (sb, cb) = (np.sin(tilt), np.cos(tilt)), (np.sin(roll), np.cos(roll))
    rz, ry = np.array([[cb, -sb, 0], [sb, cb, 0], [0, 0, 1]]), np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
    assert tp == pytest.approx(rz @ ry, abs=1e-15)


@given(st.floats(0.01, 3.1), ANGLE)
def test_the_axes_are_the_vector_products_of_equation_11(tilt, roll):
    x, y, z = probe_frame(tilt, roll).T
    across = np.cross(z, [0.0, 0.0, 1.0])
    assert y == pytest.approx(across / np.linalg.norm(across), abs=1e-11)
    assert x == pytest.approx(np.cross(y, z), abs=1e-14)


def test_without_tilt_the_limit_is_taken():
    assert probe_frame(0.0, 0.7) == pytest.approx(probe_frame(1e-9, 0.7), abs=2e-9)
    assert probe_frame(0.0, 0.7)[:, 2] == pytest.approx([0, 0, 1])
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            probe_frame(bad, 0.0)


@given(ANGLE, ANGLE, st.floats(1e-6, np.pi - 1e-6), st.floats(0.0, 6.28))
def test_directions_there_and_back(tilt, roll, ph, th):
    tp, v = probe_frame(tilt, roll), direction(ph, th)
    assert to_machine(tp, to_probe(tp, v)) == pytest.approx(v, abs=1e-14)
    ph2, th2 = direction_angles(5.0 * v)
    assert ph2 == pytest.approx(ph, abs=1e-14)
    assert np.sin(ph) * np.cos(th2 - th) == pytest.approx(np.sin(ph), abs=1e-13)
    assert 0.0 <= th2 < 2 * np.pi


def test_printed_equation_12_is_the_wrong_way_round():
    tp, v = probe_frame(0.4, 1.1), np.array([0.6, 0.0, 0.8])
    along = probe_frame(0.4, 1.1)[:, 2]
    assert to_probe(tp, along) == pytest.approx([0, 0, 1], abs=1e-15)  # the probe's own axis is its z'
    assert tp @ v != pytest.approx(to_probe(tp, v), abs=0.1)
    for bad in ([0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [1.0, 2.0]):
        with pytest.raises(ValueError, match="probe"):
            direction_angles(np.array(bad))


def test_the_pattern_has_101_directions():
    assert PATTERN.shape == (101, 2)
    assert np.rad2deg(np.unique(PATTERN[:, 0])) == pytest.approx([0, 18, 36, 54, 72, 90])
    assert len({(round(a, 9), round(b, 9)) for a, b in PATTERN}) == 101
    assert master_sphere_pattern(3, 8, 0.3).shape == (25, 2)
    for bad in ((0, 20), (5, 2), (6, 20)):
        with pytest.raises(ValueError, match="pattern"):
            master_sphere_pattern(*bad)


@settings(max_examples=20, deadline=None)
@given(st.floats(-500, 500), st.floats(-500, 500), st.floats(-500, 500), st.floats(0.5, 80.0))
def test_a_perfect_sphere_comes_back(x, y, z, radius):
    fit = fit_sphere(np.array([x, y, z]) + radius * NORMAL)
    assert fit.centre_mm == pytest.approx([x, y, z], abs=1e-10)
    assert fit.radius_mm == pytest.approx(radius, abs=1e-10)
    assert fit.noise_mm() < 1e-10


def test_the_lobing_comes_back_but_for_four_functions():
    centre, master, ball = np.array([120.0, 80.0, 60.0]), 25.006, 1.0
    injected = lobe(*PATTERN.T)
    found = calibrate(centre + (master + ball - injected)[:, None] * NORMAL, PATTERN, master)
    assert found.probe_mm == pytest.approx(without_absorbed(PATTERN, injected), abs=3e-8)  # 3e-5 um, math.md 7
    columns = np.column_stack([NORMAL, np.ones(101)])
    assert columns.T @ found.probe_mm == pytest.approx(np.zeros(4), abs=1e-6)
    absorbed = np.linalg.lstsq(columns, injected, rcond=None)[0]
    assert found.fit.centre_mm - centre == pytest.approx(-absorbed[:3], abs=1e-6)
    assert found.effective_radius_mm == pytest.approx(ball - absorbed[3], abs=1e-6)


def test_lobing_of_the_absorbed_kind_is_invisible():
    hidden = NORMAL @ np.array([0.001, -0.002, 0.003]) + 0.004
    assert without_absorbed(PATTERN, hidden) == pytest.approx(np.zeros(101), abs=1e-16)


def test_uncertainties_on_a_hemisphere_agree_with_draws():
    rng, noise = np.random.default_rng(31), 1e-3
    centre, master = np.array([10.0, 20.0, 30.0]), 25.006
    found = calibrate(centre + (master + 1.0) * NORMAL, PATTERN, master)
    assert found.fit.sigma == pytest.approx([0.18, 0.18, 0.29, 0.18], abs=0.006)
    assert found.fit.correlation[2, 3] == pytest.approx(-0.84, abs=0.005)
    drawn = [calibrate(centre + (master + 1.0 + rng.normal(0, noise, (101, 1))) * NORMAL, PATTERN, master) for _ in range(300)]
    values = np.array([[*d.fit.centre_mm, d.effective_radius_mm] for d in drawn])
    of_fit, of_map = found.uncertainty_mm(noise)
    assert values.std(axis=0) == pytest.approx(of_fit, rel=0.15)
    assert np.sqrt((np.array([d.probe_mm for d in drawn]) ** 2).mean(axis=0)) == pytest.approx(of_map, rel=0.2)
    assert (of_map**2).sum() == pytest.approx(noise**2 * (101 - 4))


def test_calibration_refuses_what_it_cannot_use():
    good = 26.0 * NORMAL
    for centres, angles, radius, words in (
        (good[:3], PATTERN[:3], 25.0, "four or more points"),
        (good[:100], PATTERN, 25.0, "fit together"),
        (good, PATTERN, -1.0, "positive"),
        (good * np.nan, PATTERN, 25.0, "finite"),
        (good, PATTERN + np.inf, 25.0, "finite"),
        (good[:20], PATTERN[:20], 25.0, "do not determine"),
        (np.ones((5, 3)), PATTERN[:5], 25.0, "coincide"),
    ):
        with pytest.raises(ValueError, match=words):
            calibrate(centres, angles, radius)


@settings(max_examples=60)
@given(st.floats(0.0, np.pi / 2), st.floats(-20.0, 20.0), st.integers(-3, 3))
def test_the_map_goes_round_and_stays_within_its_values(ph, th, turns):
    lobing = some_map()
    value = lobing.at_angles(ph, th)
    assert lobing.at_angles(ph, th + 2 * np.pi * turns) == pytest.approx(value, abs=1e-12)
    assert min(lobing.values_mm.min(), 0.5) - 1e-12 <= value <= max(lobing.values_mm.max(), 0.5) + 1e-12


def test_the_map_holds_its_nodes_and_is_bilinear_between_them():
    lobing = some_map()
    ph, th = np.meshgrid(lobing.colatitude_rad, lobing.longitude_rad, indexing="ij")
    assert lobing.at_angles(ph, th) == pytest.approx(lobing.values_mm, abs=1e-14)
    assert lobing.at_angles(np.zeros(7), np.linspace(0, 6, 7)) == pytest.approx(np.full(7, 0.5))
    half = lobing.at_angles(np.deg2rad(45.0), np.deg2rad(335.0))  # halfway across the seam between 300 and 370 degrees
    assert half == pytest.approx(lobing.values_mm[:2, [3, 0]].mean())
    assert lobing.at_angles(np.deg2rad(15.0), np.deg2rad(100.0)) == pytest.approx((0.5 + lobing.values_mm[0, 1]) / 2)
    assert lobing.at(np.array([0.0, 0.0, 2.0])) == pytest.approx(0.5)


def test_no_data_no_value():
    lobing = some_map()
    with pytest.raises(ValueError, match=r"1 directions beyond the outermost circle \(colatitude 90\.100 degrees\): no data"):
        lobing.at_angles(np.deg2rad([10.0, 90.1]), np.zeros(2))
    with pytest.raises(ValueError, match="no data"):
        lobing.at(np.array([0.0, 0.1, -1.0]))
    assert np.isfinite(lobing.at(np.array([1.0, 0.0, -1e-12])))  # rounding of a direction on the equator
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            lobing.at_angles(bad, 0.0)
        with pytest.raises(ValueError, match="finite"):
            lobing.at_angles(0.1, bad)
    good = (np.array([0.5, 1.0]), np.array([0.0, 3.0]), np.zeros((2, 2)), 0.0)
    for k, value in ((0, np.array([1.0, 0.5])), (0, np.array([0.0, 1.0])), (1, np.array([0.0, 6.3])), (2, np.zeros((2, 3))), (3, np.nan)):
        with pytest.raises(ValueError, match="lobing map"):
            LobingMap(*good[:k], value, *good[k + 1 :])


def test_a_pattern_becomes_a_map():
    values = np.arange(101.0)
    lobing = map_of_pattern(PATTERN, values)
    assert lobing.at(NORMAL) == pytest.approx(values, abs=1e-9)
    with pytest.raises(ValueError, match="exactly one touch at the pole"):
        map_of_pattern(PATTERN[:100], values[:100])


def test_angles_of_directions_are_the_pattern_again():
    """There and back the angles differ in the last digit; a whole turn is not a turn; lists are arrays; the order does not matter."""
    back = np.stack(direction_angles(NORMAL), axis=1)
    assert (back != PATTERN).any()
    turned = PATTERN + np.where(PATTERN[:, 1:] == 0.0, [0.0, 2 * np.pi], 0.0)
    order = np.random.default_rng(3).permutation(101)
    values = np.arange(101.0)
    for angles in (back, turned, PATTERN - [0.0, 4 * np.pi], PATTERN[order].tolist()):
        mixed = values[order].tolist() if isinstance(angles, list) else values
        lobing = map_of_pattern(angles, mixed)
        assert lobing.values_mm.shape == (5, 20)
        assert lobing.at(NORMAL) == pytest.approx(values, abs=1e-7)
    found = calibrate(26.0 * NORMAL, back, 25.0).lobing_map()
    assert np.abs(found.values_mm).max() < 1e-12


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(-7.0, 7.0), st.integers(3, 9))
def test_real_touches_up_to_half_a_degree_off_make_the_map(seed, turn, longitudes):
    rng = np.random.default_rng(seed)
    pattern = master_sphere_pattern(4, longitudes, 0.3)
    pattern[:, 1] += turn
    n = direction(*pattern.T)
    aside = np.cross(n, rng.normal(size=n.shape))
    way = np.deg2rad(0.45) * rng.uniform(0.1, 1.0, (len(n), 1))
    touched = np.stack(direction_angles(np.cos(way) * n + np.sin(way) * aside / np.linalg.norm(aside, axis=1, keepdims=True)), axis=1)
    values = rng.normal(size=len(n))
    lobing = map_of_pattern(touched, values, np.deg2rad(0.5))
    inner = pattern[:, 0] < lobing.colatitude_rad[-1]
    assert lobing.colatitude_rad == pytest.approx(np.unique(pattern[:-1, 0]), abs=np.deg2rad(0.5))
    assert np.sort(lobing.values_mm.ravel()).tolist() == np.sort(values[:-1]).tolist()
    assert lobing.pole_mm == values[-1]
    assert np.abs(lobing.at(n[inner]) - values[inner]).max() < 0.4  # within a tenth of the way to the next node
    with pytest.raises(ValueError, match="lobing map"):
        map_of_pattern(touched, values)


def test_directions_that_form_no_pattern_are_said():
    values, twice, gap = np.arange(101.0), PATTERN.copy(), PATTERN.copy()
    twice[7] = twice[6]
    gap[3, 1] += np.deg2rad(3.0)
    many = np.column_stack([np.linspace(0.3, 1.5, 101), np.zeros(101)])
    many[0] = 0.0
    for angles, v, tolerance, words in (
        (twice, values, 1e-9, "2 touches at colatitude 90, longitude 108 degrees"),
        (gap, values, 1e-9, "5 circles and 21 longitudes were found"),
        (PATTERN, values[:50], 1e-9, "do not fit together"),
        (PATTERN[:, :1], values, 1e-9, "do not fit together"),
        (PATTERN, values * np.nan, 1e-9, "finite"),
        (PATTERN, values, 0.0, "tolerance above 0"),
        (many, values, 0.02, "touches of colatitude 17.8763 to 85.9437 degrees are closer than the tolerance"),
        (PATTERN, values, np.deg2rad(10), "touches of colatitude"),
        (PATTERN[100:], values[100:], 1e-9, "exactly one touch at the pole; 1 of 1 touches are at the pole"),
    ):
        with pytest.raises(ValueError, match=words):
            map_of_pattern(angles, v, tolerance)


def test_four_points_say_nothing_about_noise():
    good = 26.0 * NORMAL[[0, 5, 45, 100]]
    fit = fit_sphere(good)
    assert np.isnan(fit.noise_mm())
    assert np.isfinite(fit_sphere(26.0 * NORMAL[[0, 5, 45, 70, 100]]).noise_mm())
    calibration = calibrate(26.0 * NORMAL, PATTERN, 25.0)
    assert np.isnan(calibration.uncertainty_mm(fit.noise_mm())[0]).all()
    for bad in (-1.0, np.inf):
        with pytest.raises(ValueError, match="noise_mm must be finite and not negative"):
            calibration.uncertainty_mm(bad)


def test_touches_of_a_ring_come_out_on_the_ring():
    """Calibrate, then touch another part with a tilted probe and a machine that is off: the corrected points lie on the part."""
    tilt, roll, ball = 0.3, 2.0, 1.0
    tp = probe_frame(tilt, roll)
    injected = without_absorbed(PATTERN, lobe(*PATTERN.T))
    true_map = map_of_pattern(PATTERN, injected)
    calibration = calibrate((25.0 + ball - injected)[:, None] * NORMAL, PATTERN, 25.0)
    rng = np.random.default_rng(33)
    own = direction(rng.uniform(0.1, 1.5, 50), rng.uniform(0, 6.28, 50))
    outward = to_machine(np.broadcast_to(tp, (50, 3, 3)), own)
    part, off = rng.uniform(0, 500, (50, 3)), rng.normal(0, 0.01, (50, 3))
    late = true_map.at(own)
    # A late trigger: the ball's centre is read too near the part; the machine stands `off` from what it reads.
    reading = part + (ball - late)[:, None] * outward - off
    found = probe_error_mm(calibration.lobing_map(), tp, outward)
    point = contact_point_mm(reading, combined_deviation_mm(off, found, outward), calibration.effective_radius_mm, outward)
    assert point == pytest.approx(part, abs=2e-7)


def test_a_late_trigger_moves_the_corrected_centre_outward_and_equation_17_has_two_readings():
    off, n = np.array([[0.001, 0.002, 0.003]]), np.array([[0.6, 0.0, 0.8]])
    assert ((combined_deviation_mm(off, np.array([0.004]), n) - off) * n).sum() == pytest.approx(0.004)
    approach, outward = (printed_eq17_mm(off, np.array([0.004]), n, m) for m in ("approach", "outward"))
    assert approach == pytest.approx(combined_deviation_mm(off, np.array([0.004]), n))
    assert approach + outward == pytest.approx(2 * off)
    with pytest.raises(ValueError, match="approach"):
        printed_eq17_mm(off, np.array([0.004]), n, "sideways")
    for bad in (2 * n, n * np.nan):
        with pytest.raises(ValueError, match=r"unit|finite"):
            combined_deviation_mm(off, np.array([0.004]), bad)
    with pytest.raises(ValueError, match="fit together"):
        combined_deviation_mm(off, np.array([0.004, 0.004]), n)
    with pytest.raises(ValueError, match="finite"):
        contact_point_mm(off, off, np.nan, n)


def test_the_stored_sphere_comes_from_its_stated_lobing(shared):
    sphere = json.loads((shared / "vectors" / "probe.json").read_text())["sphere"]
    assert np.array(sphere["colat_lon"]) == pytest.approx(PATTERN, abs=1e-15)
    away = np.linalg.norm(np.array(sphere["ball_centres"]) - sphere["centre"], axis=1)
    assert away + lobe(*PATTERN.T) == pytest.approx(np.full(101, sphere["Rs"] + 1.0), abs=1e-13)
