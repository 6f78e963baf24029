"""Reduction of ISO 230-2 to 20 °C against numbers worked out by hand, on three real axis tests and on round ones."""

import json

import numpy as np
import pytest

from abbe.models.evaluation.iso230_2 import Approaches, positioning
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


def test_the_stated_uncertainty_is_the_scatter_of_wrong_temperatures_and_coefficients():
    rng = np.random.default_rng(3)
    trials = [Expansion(11.5e-6 + rng.normal() * 0.6e-6, 0.6e-6, 24.0 + rng.normal() * 0.2, 0.2).strain for _ in range(4000)]
    assert np.std(trials) == pytest.approx(STEEL_AT_24.u_reduced, rel=0.05)


@pytest.mark.parametrize(("name", "value"), [("temperature_c", np.nan), ("u_temperature_k", -0.1), ("u_scale_per_k", -1e-6)])
def test_what_is_no_number_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        Expansion(**{"scale_per_k": 11.5e-6, "u_scale_per_k": 0.6e-6, "temperature_c": 24.0, "u_temperature_k": 0.2} | {name: value})
