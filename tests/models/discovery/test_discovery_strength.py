"""Strength of a named effect and its uncertainty: what they are made of, and the claim on which a curve's unseen line stands."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.polynomial import legendre

from abbe.models.arrays import F1
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.finding import TIME_TRUE_TO_FORM, shape_of, strength_of, true_to_form
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.columns import WITH_CONSTANT, WITH_LINE, WITH_SLOW
from abbe.models.effects.effect import Form

BY_NAME = {e.name: e for e in CATALOGUE}


def problem_of(columns: dict[Any, Any]) -> Any:
    """A campaign that knows nothing but the columns of each signal."""
    return cast(Any, SimpleNamespace(raw=lambda signal, key, values: columns[signal].copy()))


def curves(length: float, count: int = 3000) -> Any:
    """Legendre coefficients, each of mean square 1, and rms of stationary curves with a squared exponential correlation."""
    u, weight = legendre.leggauss(64)
    kernel = np.exp(-0.5 * ((u[:, None] - u) / 2.0 / length) ** 2)
    values, vectors = np.linalg.eigh(kernel)
    drawn = np.random.default_rng(5).normal(size=(count, 64)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    orders = np.arange(13)
    parts = (drawn * weight / 2.0) @ legendre.legvander(u, 12) * np.sqrt(2 * orders + 1)
    return parts, np.sqrt((drawn**2) @ weight / 2.0)


@pytest.mark.parametrize(("claim", "first", "median", "low", "high"), [(WITH_LINE, 2, 2.6, 1.5, 5.0), (WITH_CONSTANT, 1, 1.4, 1.0, 2.6)])
def test_what_a_curves_seen_part_leaves_out_is_as_large_as_stated(
    claim: tuple[float, float], first: int, median: float, low: float, high: float
) -> None:
    parts, whole = curves(0.3)
    ratio = whole / np.linalg.norm(parts[:, first:], axis=1)
    assert np.median(ratio) == pytest.approx(median, rel=0.1)
    assert np.quantile(ratio, [0.16, 0.84]) == pytest.approx([low, high], rel=0.15)
    ratio_claimed, u = claim
    assert np.mean(np.abs(ratio - ratio_claimed) < 2.0 * u) > 0.8


def short_of_the_end(offset: bool, count: int = 300) -> F1:
    """Final size of a warm-up with two time constants over that of the one exponential that fits 160 minutes of it best."""
    rng, t, out = np.random.default_rng(6), np.linspace(600.0, 9500.0, 40), []
    for _ in range(count):
        tau, slow, share = rng.uniform(1200.0, 6000.0), np.exp(rng.choice([-1, 1]) * rng.uniform(0.6, 1.4)), rng.uniform(0.15, 0.6)
        rise = 1.0 - (1.0 - share) * np.exp(-t / tau) - share * np.exp(-t / (slow * tau))
        tried = []
        for one in np.geomspace(300.0, 10000.0, 60):
            columns = np.column_stack([-np.expm1(-t / one), np.ones(t.size)])[:, : 1 + offset]
            c, *_ = np.linalg.lstsq(columns, rise, rcond=None)
            tried.append((float(np.sum((rise - columns @ c) ** 2)), 1.0 / float(c[0])))
        out.append(min(tried)[1])
    return np.array(out)


def test_a_warm_up_ends_as_much_above_its_exponential_as_stated() -> None:
    ratio, u = WITH_SLOW
    for short in (short_of_the_end(True), short_of_the_end(False)):
        assert np.median(short) == pytest.approx(ratio, abs=0.03)
        assert np.mean(np.abs(short - ratio) < 2.0 * u) > 0.85
    (c, values), plain = (np.array([40.0]), {"tau_s": 3000.0}), np.ones((6, 1))
    effect = BY_NAME["spindle_thermal_drift"]
    strength, _ = strength_of(problem_of({effect.signal: plain}), Pick(effect, "X", values), c, np.zeros((1, 1)))
    assert strength == pytest.approx(40.0 * ratio)


def test_straightness_is_stated_with_its_line_and_says_how_unsure_that_is() -> None:
    effect = BY_NAME["straightness"]
    pick = Pick(effect, "EYX")
    c = np.array([3.0, 0.0, 0.0, 4.0, 0.0])
    strength, u = strength_of(problem_of({effect.signal: np.eye(8, 5)}), pick, c, np.zeros((5, 5)))
    assert strength == pytest.approx(5.0 * WITH_LINE[0])
    assert u == pytest.approx(np.hypot(5.0 * WITH_LINE[1], true_to_form("straightness", "geometry") * strength))


def test_uncertainty_of_a_strength_is_that_of_its_coefficient_and_of_its_form() -> None:
    effect = BY_NAME["backlash"]
    problem = problem_of({effect.signal: np.ones((6, 1))})
    for sd in (0.0, 0.4):
        strength, u = strength_of(problem, Pick(effect, "X"), np.array([4.0]), np.array([[sd**2]]))
        assert strength == pytest.approx(4.0)
        assert u == pytest.approx(np.hypot(sd, 4.0 * true_to_form("backlash", "drive")))


def test_only_a_form_that_carries_the_size_changes_the_strength() -> None:
    effect = BY_NAME["backlash"]
    beside, modulated = (Form(name, lambda paths, key, values: []) for name in ("wind-up", "modulated"))
    columns = {effect.signal: np.ones((6, 1)), beside.signal: np.ones((6, 1)), modulated.signal: np.ones((6, 1))}
    c, cov = np.array([4.0, 1.0]), np.zeros((2, 2))
    assert strength_of(problem_of(columns), Pick(effect, "X", forms=(beside,)), c, cov)[0] == pytest.approx(4.0)
    assert strength_of(problem_of(columns), Pick(effect, "X", forms=(modulated,)), c, cov)[0] == pytest.approx(5.0)


def test_a_time_constant_is_less_sure_than_its_fit_and_a_pitch_is_not() -> None:
    warm = shape_of(Pick(BY_NAME["squareness_thermal"], "XY", {"tau_s": 1000.0}), {"tau_s": 40.0})
    assert warm["tau_s"][0] == 1000.0
    assert warm["tau_s"][1] == pytest.approx(np.hypot(40.0, 1000.0 * TIME_TRUE_TO_FORM))
    assert shape_of(Pick(BY_NAME["cyclic_error"], "X", {"pitch_mm": 10.0}), {"pitch_mm": 0.01})["pitch_mm"] == (10.0, 0.01)


def test_what_a_sensor_followed_is_part_of_a_swing_and_what_is_constant_in_it_is_not() -> None:
    """Air that swings by 6 K and stands 5 K above where the sensor began; the wave beside the sensor has next to nothing left to hold."""
    effect = BY_NAME["air_refraction"]
    by = {form.name: form for form in effect.forms}
    t = np.linspace(0.0, 1.3, 200)  # cycles
    waves, ones = 2.0 * np.pi * t, np.ones(200)
    columns = {
        effect.signal: np.column_stack([np.sin(waves), np.cos(waves)]),
        by["sensor"].signal: (5.0 + 6.0 * np.sin(waves))[:, None],
        by["offset and drift"].signal: np.column_stack([ones, t]),
    }
    pick = Pick(effect, "", {"period_s": 5000.0}, forms=(by["sensor"],))
    strength, u = strength_of(problem_of(columns), pick, np.array([0.1, 0.0, 1.0]), np.zeros((3, 3)))
    assert strength == pytest.approx(6.1, abs=1e-6)
    assert u > 0.3  # with the constant taken for a part of the swing the strength is another: that much is not known
    assert u < 6.0
