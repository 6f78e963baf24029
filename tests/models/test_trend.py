"""False alarms at the stated rate, drifts found in the stated time, intervals that hold the truth as often as they say. Fixed seeds."""

from __future__ import annotations

import os

import numpy as np
import pytest

from abbe.models.trend import CUSUM_H, MIN_CHECKS, average_run_length, cusum, ewma, forecast, standardised, trend

LONG = bool(os.environ.get("ABBE_TEST_LONG"))


def run_lengths(rng: np.random.Generator, series: int, n: int, shift: float = 0.0, before: int = 0) -> tuple[int, int]:
    """Checks that passed (from ``before`` on) and alarms, each series up to its first alarm; uncertainties differ fourfold."""
    checks = alarms = 0
    for _ in range(series):
        u = rng.uniform(0.5, 2.0, n)
        y = 12.0 + u * (rng.normal(size=n) + shift * (np.arange(n) >= before))
        sums = np.maximum(*cusum(standardised(y, u)))[before:]
        found = np.flatnonzero(sums > CUSUM_H)
        checks += int(found[0]) + 1 if len(found) else len(sums)
        alarms += len(found) > 0
    return checks, alarms


def test_the_run_length_of_the_textbook() -> None:
    # Montgomery, Introduction to Statistical Quality Control, table of the two-sided CUSUM with k = 1/2, h = 5.
    for shift, length in ((0.0, 465.0), (0.5, 38.0), (1.0, 10.4), (1.5, 5.75), (2.0, 4.01)):
        assert average_run_length(shift) == pytest.approx(length, rel=0.01)


def test_false_alarms_come_at_the_stated_rate() -> None:
    checks, alarms = run_lengths(np.random.default_rng(8), 4000 if LONG else 700, 500)
    # The number of alarms in so many checks is nearly Poisson's: three of its standard deviations.
    assert checks / alarms == pytest.approx(average_run_length(), rel=3 / np.sqrt(alarms))


def test_standardised_figures_are_normal_and_independent_whatever_the_uncertainties() -> None:
    rng = np.random.default_rng(5)
    z = np.array([standardised(7 + 0.3 * u * rng.normal(size=30), u) for u in rng.uniform(0.1, 3.0, (6000, 30))])[:, 2:]
    assert np.mean(z) == pytest.approx(0.0, abs=0.01)
    assert np.std(z) == pytest.approx(1.0, abs=0.01)
    assert np.mean(np.abs(z) > 1.96) == pytest.approx(0.05, abs=0.003)
    assert np.mean(z[:, 1:] * z[:, :-1]) == pytest.approx(0.0, abs=0.01)


def test_ewma_limits_hold_from_the_first_check() -> None:
    rng = np.random.default_rng(6)
    over = []
    for _ in range(3000):
        mean, limit = ewma(rng.normal(size=20))
        over.append(np.abs(mean) > limit)
    share = np.mean(over, axis=0)
    assert share.max() < 0.0075  # two-sided 2.962 standard deviations: 0.0031
    assert share.mean() == pytest.approx(0.0031, abs=0.001)


def test_a_step_of_one_standard_deviation_is_found_in_the_stated_time() -> None:
    """Stated for a known mean: 10.4 checks. The mean is learned from 60 checks here, which costs a few checks more."""
    checks, alarms = run_lengths(np.random.default_rng(9), 400, 160, shift=1.0, before=60)
    assert alarms >= 390
    assert 9.0 < checks / alarms < 17.0


@pytest.mark.parametrize(("slope", "within"), [(0.1, 22), (0.3, 11)])
def test_a_drift_is_found_and_dated(slope: float, within: int) -> None:
    """``slope``: standard deviations a check, after 40 quiet checks; 95 of 100 are found in time, dated within 12 checks."""
    rng = np.random.default_rng(11)
    found, dated = [], []
    for _ in range(200):
        t = np.sort(rng.uniform(0, 80, 80))
        u = rng.uniform(0.8, 1.2, 80)
        y = 10 + slope * np.maximum(np.arange(80) - 39, 0) + u * rng.normal(size=80)
        answer = trend(t, y, u, 40.0)
        assert (answer.state, answer.direction) == ("drifting", 1)
        assert answer.found is not None
        assert answer.since is not None
        found.append(answer.found - 40)
        dated.append(abs(answer.since - 40))
    assert np.quantile(found, 0.95) <= within
    assert np.quantile(dated, 0.9) <= 12


CASES = [
    ("a straight line", 0.0, 0.15, 25),
    ("an onset after 20 days", 20.0, 0.2, 12),
    ("an onset after 40 days", 40.0, 0.3, 10),
    ("a long ramp", 40.0, 0.15, 25),
]
PLAYED = CASES if LONG else CASES[:2]


@pytest.mark.parametrize(("name", "quiet", "slope", "ramp"), PLAYED, ids=[case[0] for case in PLAYED])
def test_intervals_hold_the_truth_as_often_as_they_say(name: str, quiet: float, slope: float, ramp: int) -> None:
    """93 to 97 of 100 intervals of 95 %, over uneven times and uncertainties, the onset unknown."""
    rng = np.random.default_rng(3)
    hits = []
    for _ in range(4000 if LONG else 1500):
        n = int(quiet) + ramp
        t, u = np.sort(rng.uniform(0, n, n)), rng.uniform(0.5, 1.5, n)
        y = 5 + slope * np.maximum(t - quiet, 0) + 0.8 * u * rng.normal(size=n)
        reached = n + 40.0
        ahead = forecast(t, y, u, 5 + slope * (reached - quiet))
        if not ahead.reason:
            hits.append(ahead.low <= reached - t[-1] <= ahead.high)
    assert len(hits) > 1000
    assert 0.93 - 0.005 <= np.mean(hits) <= 0.97 + 0.005  # 0.005: one standard deviation of the share itself


def test_without_drift_nothing_is_said_about_the_limit() -> None:
    rng = np.random.default_rng(4)
    told = []
    for _ in range(1000):
        u = rng.uniform(0.5, 1.5, 30)
        ahead = forecast(np.arange(30.0), 5 + u * rng.normal(size=30), u, 20.0)
        assert (ahead.reason == "") == bool(np.isfinite(ahead.days))
        told.append(ahead.reason == "")
    assert np.mean(told) < 0.02  # 1 % at each end of the slope, and the day of the onset is free


@pytest.mark.parametrize(
    ("y", "limit", "reason"),
    [
        (np.arange(5.0), 20.0, "not known: 5 checks are too few"),
        (np.arange(9.0), None, "there is no limit"),
        (9 - np.arange(9.0) + 0.1 * np.sin(np.arange(9.0)), 20.0, "moves away from the limit"),
    ],
)
def test_what_is_not_known_says_why(y: np.ndarray, limit: float | None, reason: str) -> None:
    ahead = forecast(np.arange(float(len(y))), y, np.ones(len(y)), limit)
    assert ahead.reason == reason
    assert np.isnan(ahead.days)


def test_a_limit_that_is_exceeded_is_reached_today() -> None:
    t = np.arange(20.0)
    ahead = forecast(t, 2 * t + 0.1 * np.sin(7 * t), np.ones(20), 30.0)
    assert (ahead.days, ahead.low, ahead.reason) == (0.0, 0.0, "")


def test_few_checks_and_a_correction_that_ended_a_drift() -> None:
    assert trend(np.arange(5.0), np.arange(5.0), np.ones(5)).state == "too few checks"
    assert MIN_CHECKS > 5
    rng = np.random.default_rng(2)
    y = 10 + rng.normal(size=60) + np.where((np.arange(60) >= 25) & (np.arange(60) < 35), 4.0, 0.0)
    assert trend(np.arange(35.0), y[:35], np.ones(35)).state == "drifting"
    assert trend(np.arange(60.0), y, np.ones(60)).state == "in control"


@pytest.mark.parametrize(("t", "u"), [([0.0, 2.0, 1.0], [1.0, 1.0, 1.0]), ([0.0, 1.0, 2.0], [1.0, 0.0, 1.0]), ([0.0, 1.0], [1.0] * 3)])
def test_bad_series_are_refused(t: list[float], u: list[float]) -> None:
    with pytest.raises(ValueError, match=r"uncertainty|order of time"):
        trend(np.array(t), np.zeros(3), np.array(u))
