"""Thermal response at standstill: sensitivities and lag of a machine that is known, runs left out, a shift, and what is too little."""

import numpy as np
import pytest

from abbe.models.evaluation.standstill import standstill
from abbe.models.evaluation.thermal_response import Series, StandstillRun
from tests.models.evaluation.heated_machine import LAG_MIN, SETTLED_UM_K, heated_days


def runs(**how):
    return [StandstillRun(f"d{k}", d.t_s, 1e-3 * d.displacement_um, d.temperatures_c) for k, d in enumerate(heated_days(**how))]


@pytest.fixture(scope="module")
def found():
    return standstill(runs())


def test_the_lag_and_what_each_sensor_moves_are_found(found):
    tau, u_tau = found.response.time_constant_s
    assert abs(tau / 60.0 - LAG_MIN) < 0.35 * LAG_MIN
    assert u_tau < 0.5 * tau
    for sensor, truth in enumerate(SETTLED_UM_K):
        value, u = found.response.sensitivity(sensor, settled=True)
        assert abs(1e3 * value - truth) < 3.0 * 1e3 * u
        assert 1e3 * u < 1.5


def test_runs_left_out_are_predicted_better_than_by_temperatures_at_once(found):
    left = found.left_out
    assert left.response_mm < 0.5 * left.static_mm < 0.5 * left.raw_mm
    assert left.response_mm < 1.5e-3
    assert 0.9 <= left.covered <= 1.0
    assert found.shift_absolute is found.shift_since_start is None


def test_the_uncertainty_is_not_wide_for_nothing(found):
    assert 2.0 * np.median(np.concatenate(found.left_out.u_mm)) < 5.0 * found.left_out.response_mm


def test_a_shift_of_the_last_days_is_found_with_its_beginning_and_size():
    shift = standstill(runs(count=12, shifted=(8, 9, 10, 11), shift_um=8.0)).shift_since_start
    assert shift is not None
    assert (shift.first, shift.last) == (8, 11)
    assert abs(shift.size_mm - 8e-3) < 3.0 * shift.u_mm < 6e-3
    assert shift.p < 0.01  # over 45 beginnings and ends


def test_days_without_a_shift_show_none():
    """Of 12 campaigns one may, at p < 0.01."""
    assert sum(Series(runs(seed=seed, minutes=120), since_start=True).response().shift is not None for seed in range(30, 42)) <= 1


def test_temperatures_that_explain_nothing_leave_the_displacement():
    rng = np.random.default_rng(3)
    strange = [StandstillRun(r.label, r.t_s, 1e-4 * np.cumsum(rng.normal(size=r.t_s.size)), r.temperatures_c) for r in runs(minutes=120)]
    left = standstill(strange).left_out
    assert left.response_mm > 0.8 * left.raw_mm
    assert left.covered > 0.85


def test_uneven_times_are_no_matter():
    rng = np.random.default_rng(5)
    kept = [np.append(0, np.sort(rng.choice(np.arange(1, 200), 120, replace=False))) for _ in range(9)]
    thin = [StandstillRun(r.label, r.t_s[k], r.displacement_mm[k], r.temperatures_c[k]) for r, k in zip(runs(), kept, strict=True)]
    assert standstill(thin).left_out.response_mm < 2e-3


def test_few_days_are_refused():
    with pytest.raises(ValueError, match="4 runs at standstill, expected 5 or more"):
        standstill(runs(count=4))
