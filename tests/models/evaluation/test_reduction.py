"""Reduction of ISO 230-2 to 20 °C against numbers worked out by hand, on three real axis tests and on round ones."""

import json

import numpy as np
import pytest

from abbe.models.evaluation.iso230_2 import Approaches, ScaleBudget, positioning
from abbe.models.evaluation.reduction import Expansion, reduced

STEEL_AT_24 = Expansion(11.5e-6, 0.6e-6, 24.0, 0.2)
EXACT_UM = 1e-9

BY_HAND = {
    "x": {
        "forward": [-7.902, 10.990, -8.228, 1.318, 4.744],
        "backward": [-10.634, 12.256, -0.886, 26.816, -30.308],
        "E": 57.124,
        "M": 26.849,
        "B": 35.052,
        "A": 201.145978269611,
    },
    "y": {
        "forward": [-2.334, 8.030, 2.692, 12.528, 4.546],
        "backward": [-4.896, 0.830, -6.704, -2.484, -14.046],
        "E": 26.574,
        "M": 9.772,
        "B": 18.592,
        "A": 96.585905301277,
    },
    "z": {
        "forward": [-18.004, 23.028, 8.520, -12.074, -16.502],
        "backward": [2.564, 1.182, -10.896, 5.082, 15.258],
        "E": 41.032,
        "M": 19.825,
        "B": 31.760,
        "A": 63.298603179432,
    },
}


def axis_test(shared, axis: str) -> Approaches:
    """The five cycles of a real test, mm."""
    cells: dict[tuple[float, int], list[float]] = {}
    for k in range(1, 6):
        c = json.loads((shared / "data" / "axis-tests" / f"week42-{axis}" / f"r0{k}.json").read_text())["columns"]
        for x, d, v in zip(c[f"{axis}_mm"], c["direction"], c["deviation_mm"], strict=True):
            cells.setdefault((x, d), []).append(v)
    places = sorted({x for x, _ in cells})
    return Approaches(np.array(places), *(np.array([cells[x, d] for x in places]) for d in (1, -1)))


@pytest.mark.parametrize("axis", "xyz")
def test_real_axis_tests_at_24_degrees_by_hand(shared, axis):
    """A steel scale (11.5 µm/m/K) at 24 °C is 11.5 · 4 = 46 µm/m too long; five positions 2 mm apart give 0.092 µm from one to the next.

    So 0, 0.092, 0.184, 0.276, 0.368 µm come off the mean deviations at the five positions, in both directions. In µm, x as measured:

        + (-64.74 + 23.19 + 41.55 - 15.78 - 23.73) / 5 = -7.902, then  11.082  -8.044   1.594    5.112
        - (-81.87 -  9.45 -  3.94 + 26.25 + 15.84) / 5 = -10.634, then 12.348  -0.702  27.092  -29.940

    and reduced: + -7.902 10.990 -8.228 1.318 4.744 and - -10.634 12.256 -0.886 26.816 -30.308. From these: E = 26.816 + 30.308 = 57.124
    (57.032 as measured); M = 14.067 - (-12.782) = 26.849 (26.757), between the fourth position and the last; B = 4.744 + 30.308 = 35.052
    as before. In y and z likewise: E = 26.574 (26.482) and 41.032 (41.124). In x, A lies at one position and stays; in y it falls by
    0.092 (96.677905301277), in z it grows by 0.184 (63.114603179432), both with scatter from exact decimal arithmetic.
    """
    wanted, measured = BY_HAND[axis], positioning(axis_test(shared, axis))
    found = positioning(reduced(axis_test(shared, axis), STEEL_AT_24))
    assert found.mean_forward_mm * 1e3 == pytest.approx(wanted["forward"], abs=EXACT_UM)
    assert found.mean_backward_mm * 1e3 == pytest.approx(wanted["backward"], abs=EXACT_UM)
    for name in "EMBA":
        assert getattr(found, name).value_mm * 1e3 == pytest.approx(wanted[name], abs=EXACT_UM), name
    assert found.R.value_mm == pytest.approx(measured.R.value_mm, abs=EXACT_UM * 1e-3)


def flat(slope: float) -> Approaches:
    """One cycle over 1 m, whose deviation grows by ``slope`` mm per mm, away from the axis' zero."""
    at = np.array([200.0, 700.0, 1200.0])
    return Approaches(at, (slope * at)[:, None], (slope * at - 0.003)[:, None])


@pytest.mark.parametrize(
    ("t", "laser", "left_um"),
    [(24.0, 0.0, 0.0), (20.0, 0.0, 46.0), (16.0, 0.0, 92.0), (24.0, 11.5e-6, 46.0), (24.0, 1.5e-6, 6.0)],
    ids=["warm", "at 20 °C", "cold", "laser has taken it off", "laser has taken off a part"],
)
def test_sign_of_the_reduction(t, laser, left_um):
    """An axis that reads 46 µm too far over 1 m: a warm scale explains it, a cold one hides as much again (46 + 46)."""
    r = reduced(flat(46e-6), Expansion(11.5e-6, 0.6e-6, t, 0.2, laser))
    assert (r.forward_mm[-1, 0] - r.forward_mm[0, 0]) * 1e3 == pytest.approx(left_um, abs=1e-9)
    assert r.forward_mm[0, 0] == flat(46e-6).forward_mm[0, 0]
    assert (r.forward_mm - r.backward_mm)[:, 0] == pytest.approx([0.003] * 3)


def test_uncertainty_by_hand():
    """At 24 °C: 11.5 · 0.2 = 2.3 µm/m of temperature; 4 · 0.6 = 2.4 µm/m of the coefficient; together √(5.29 + 5.76) = √11.05 µm/m."""
    assert STEEL_AT_24.strain == pytest.approx(46e-6)
    assert STEEL_AT_24.u_as_measured == pytest.approx(2.3e-6)
    assert STEEL_AT_24.u_reduced == pytest.approx(np.sqrt(11.05) * 1e-6)
    assert Expansion(11.5e-6, 0.6e-6, 20.0, 0.2).u_reduced == pytest.approx(2.3e-6)


@pytest.mark.parametrize(
    ("t", "laser", "as_measured", "reduced_um"),
    [(20.0, 11.5e-6, 2.3, 2.3), (24.0, 11.5e-6, 2.3, np.hypot(2.3, 2.4)), (24.0, 3.5e-6, np.hypot(1.6, 0.7), np.sqrt(8.81))],
    ids=["all taken off at 20 °C", "all taken off at 24 °C", "a part"],
)
def test_the_sensor_of_the_laser_has_an_error_of_its_own(t, laser, as_measured, reduced_um):
    """Laser set to 3.5: (11.5 - 3.5) · 0.2 = 1.6, 3.5 · 0.2 = 0.7 and 4 · 0.6 = 2.4 µm/m: 2.56 + 0.49 + 5.76 = 8.81."""
    one = Expansion(11.5e-6, 0.6e-6, t, 0.2, laser)
    assert one.u_as_measured == pytest.approx(as_measured * 1e-6)
    assert one.u_reduced == pytest.approx(reduced_um * 1e-6)


@pytest.mark.parametrize("laser", [3.5e-6, 11.5e-6, 17e-6])
@pytest.mark.parametrize("t", [20.0, 24.0])
def test_the_stated_uncertainty_is_the_scatter_of_what_is_left_with_the_laser_compensating(t, laser):
    """A perfect axis, read by a laser whose own sensor errs, reduced with a stated temperature and coefficient that err."""
    rng, left, read = np.random.default_rng(5), [], []
    for _ in range(4000):
        scale, e, e_laser = 11.5e-6 + rng.normal() * 0.6e-6, rng.normal() * 0.2, rng.normal() * 0.2
        measured = scale * (t - 20.0) - laser * (t + e_laser - 20.0)
        left.append(measured - Expansion(11.5e-6, 0.6e-6, t + e, 0.2, laser).strain)
        read.append(11.5e-6 * (t - 20.0) - laser * (t + e_laser - 20.0) - Expansion(11.5e-6, 0.6e-6, t + e, 0.2, laser).strain)
    stated = Expansion(11.5e-6, 0.6e-6, t, 0.2, laser)
    assert np.std(left) == pytest.approx(stated.u_reduced, rel=0.05)
    assert np.std(read) == pytest.approx(stated.u_as_measured, rel=0.05)
    assert abs(np.mean(left)) < 3.0 * stated.u_reduced / np.sqrt(4000.0)


def five_cycles(slope: float, scatter_mm: float = 0.0) -> Approaches:
    """Five cycles over 1 m of an axis whose only error is ``slope``; ``scatter_mm``: of the cycles at the middle."""
    at = np.array([200.0, 450.0, 700.0, 950.0, 1200.0])
    read = np.repeat((slope * at)[:, None], 5, axis=1)
    read[2] += scatter_mm * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    return Approaches(at, read, read)


def test_a_flat_steel_axis_is_not_known_better_than_its_slope():
    """Reduced, all deviations are 0: a slope of u per length makes E, M and A u · 1 m = √11.05 µm, and no reversal."""
    p = positioning(reduced(five_cycles(STEEL_AT_24.strain), STEEL_AT_24), ScaleBudget(slope=STEEL_AT_24.u_reduced))
    for name in ("E", "E_forward", "E_backward", "M", "A", "A_forward", "A_backward"):
        figure = getattr(p, name)
        assert figure.value_mm == pytest.approx(0.0, abs=1e-12), name
        assert figure.u_mm * 1e3 == pytest.approx(np.sqrt(11.05)), name
    assert p.B.u_mm == p.R.u_mm == 0.0


@pytest.mark.parametrize("true", [0.0, 2e-6, -46e-6])
@pytest.mark.parametrize("scatter_mm", [0.0, 0.001, 0.02])
def test_a_slope_error_of_the_stated_uncertainty_stays_inside_U(true, scatter_mm):
    """Also where one position decides both ends of A, and where the slope turns over."""
    u = STEEL_AT_24.u_reduced
    truth = positioning(five_cycles(true, scatter_mm))
    for wrong in np.linspace(-u, u, 9):
        found = positioning(five_cycles(true + wrong, scatter_mm), ScaleBudget(slope=u))
        for name in "EMA":
            figure, real = getattr(found, name), getattr(truth, name)
            assert abs(figure.value_mm - real.value_mm) <= 2.0 * figure.u_mm + 1e-12, (name, wrong)


def test_between_far_extremes_the_slope_counts_by_the_travel():
    ramp = five_cycles(46e-6)
    for name in "EMA":
        assert getattr(positioning(ramp, ScaleBudget(slope=3e-6)), name).u_mm == pytest.approx(3e-3), name


def test_the_stated_uncertainty_is_the_scatter_of_wrong_temperatures_and_coefficients():
    rng = np.random.default_rng(3)
    trials = [Expansion(11.5e-6 + rng.normal() * 0.6e-6, 0.6e-6, 24.0 + rng.normal() * 0.2, 0.2).strain for _ in range(4000)]
    assert np.std(trials) == pytest.approx(STEEL_AT_24.u_reduced, rel=0.05)


@pytest.mark.parametrize(("name", "value"), [("temperature_c", np.nan), ("u_temperature_k", -0.1), ("u_scale_per_k", -1e-6)])
def test_what_is_no_number_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        Expansion(**{"scale_per_k": 11.5e-6, "u_scale_per_k": 0.6e-6, "temperature_c": 24.0, "u_temperature_k": 0.2} | {name: value})
