"""Rounds of findings in the variance: what an earlier round found is not found again, and hides nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.localization import Localization
from abbe.models.discovery.variance.rounds import calmed, scattered
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, extra_variance
from abbe.models.discovery.whitened_problem import WhitenedProblem, whiten
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import campaign, case_of_paths, noise

PATHS = campaign()
SIGMA = tuple(4e-4 if p.kind == "bar" else 3e-4 for p in PATHS)
SHAKES = VarianceFinding("vibration", "Y", 3.0, 0.1, {"frequency_hz": 37.3}, 4000.0, Localization())
STICKS = VarianceFinding("stick_slip", "X", 3.0, 0.1, {"v_c": 2.0}, 400.0, Localization())


def shaken(path: Path) -> F1:
    """A vibration of Y of 3 um that swells and fades by a third every 17 s, with another phase in every run."""
    t = path.at.t_s - path.at.t_s[0]
    swell = 1.0 + 0.35 * np.sin(2.0 * np.pi * t / 17.0 + path.at.t_s[0])
    return np.asarray(3e-3 * swell * np.sin(2.0 * np.pi * 37.3 * t + 2.0 * path.at.t_s[0]) * path.look[:, 1] * (path.kind == "bar"))


def toothed(path: Path, seed: int) -> F1:
    """Teeth of X of 3 um below 2 mm/s, each as long as a reading."""
    tooth = 2.0 * np.random.default_rng([seed, int(path.at.t_s[0])]).uniform(size=path.n) - 1.0
    gate = np.exp(-np.square(path.at.v_mm_s[:, 0] / 2.0)) * float(np.ptp(path.at.q_mm[:, 0]) > 0 and path.kind == "bar")
    return np.asarray(3e-3 * tooth * gate * path.look[:, 0])


def white(*add: tuple[F1, ...], seed: int = 3) -> tuple[F1, ...]:
    return tuple(e + sum(a[k] for a in add) / SIGMA[k] for k, e in enumerate(noise(PATHS, seed)))


def problem_of(*add: tuple[F1, ...]) -> WhitenedProblem:
    """Readings of noise and ``add``, mm."""
    case = case_of_paths(PATHS)
    values = white(*add)
    runs = tuple(replace(r, deviation_mm=v * s) for r, v, s in zip(case.runs, values, SIGMA, strict=True))
    case = replace(case, runs=runs)
    return whiten(case, baseline_of(case))


def test_noise_keeps_its_variance() -> None:
    rest = calmed(PATHS, noise(PATHS, 4), SIGMA, (SHAKES,))
    squares = [np.mean(r**2) for r, p in zip(rest, PATHS, strict=True) if p.kind == "bar"]
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)


def test_readings_left_out_and_the_laser_stay_as_they_are() -> None:
    rest = [r.copy() for r in noise(PATHS, 4)]
    for r in rest:
        r[5:9] = 0.0
    left = calmed(PATHS, rest, SIGMA, (SHAKES, STICKS))
    assert all((r[5:9] == 0.0).all() for r in left)
    assert all((a == b).all() for a, b, p in zip(left, rest, PATHS, strict=True) if p.kind == "laser")


def test_a_known_vibration_that_swells_and_fades_leaves_nothing() -> None:
    rest = calmed(PATHS, white(tuple(map(shaken, PATHS))), SIGMA, (SHAKES,))
    assert np.mean([np.mean(r**2) for r in rest]) == pytest.approx(1.0, abs=0.05)
    assert not extra_variance(PATHS, rest, SIGMA, known=(SHAKES,))


def test_a_known_stick_slip_leaves_nothing() -> None:
    rest = calmed(PATHS, white(tuple(toothed(p, 2) for p in PATHS)), SIGMA, (STICKS,))
    assert not extra_variance(PATHS, rest, SIGMA, known=(STICKS,))


def test_a_stick_slip_of_another_axis_is_found_beside_a_known_vibration() -> None:
    values = white(tuple(map(shaken, PATHS)), tuple(toothed(p, 2) for p in PATHS))
    found = extra_variance(PATHS, calmed(PATHS, values, SIGMA, (SHAKES,)), SIGMA)
    assert [f.label for f in found] == ["stick_slip:X"]
    assert found[0].strength == pytest.approx(3.0, rel=0.25)


def test_a_weak_stick_slip_is_found_in_the_round_after_a_strong_vibration() -> None:
    """A vibration may leave traces along other axes, so a weaker finding of the same round has no name; the next round is free of them."""
    problem = problem_of(tuple(map(shaken, PATHS)), tuple(toothed(p, 2) for p in PATHS))
    first = scattered(problem, (), ())
    assert [f.label for f in first] == ["vibration:Y"]
    assert [f.label for f in scattered(problem, (), first)] == ["stick_slip:X"]


@pytest.mark.parametrize("strange", ["stick_slip", "vibration"])
def test_a_known_finding_overshadows_another_name_of_its_axis(strange: str) -> None:
    """The residuals still contain a stick-slip of X; whatever drive of X is known, X gets no second name."""
    known = replace(STICKS, name=strange, parameters=dict(STICKS.parameters) | {"frequency_hz": 11.0})
    values = white(tuple(toothed(p, 2) for p in PATHS))
    assert [f.label for f in extra_variance(PATHS, values, SIGMA)] == ["stick_slip:X"]
    assert not extra_variance(PATHS, values, SIGMA, known=(known,))


def test_a_strong_vibration_has_one_name_in_all_rounds() -> None:
    problem = problem_of(tuple(map(shaken, PATHS)))
    first = scattered(problem, (), ())
    assert [f.label for f in first] == ["vibration:Y"]
    assert not scattered(problem, (), first)


def test_wrong_readings_beside_a_vibration_have_a_name() -> None:
    rng = np.random.default_rng(6)
    wrong = tuple(12e-3 * (rng.uniform(size=p.n) < 0.03) * rng.choice([-1.0, 1.0], p.n) * (p.kind == "bar") for p in PATHS)
    found = scattered(problem_of(tuple(0.3 * shaken(p) for p in PATHS), wrong), (), ())
    assert sorted(f.label for f in found) == ["bar_outliers", "vibration:Y"]


def test_readings_that_a_vibration_alone_throws_far_off_are_no_outliers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A finding beside a vibration has to be found again without the vibration."""
    problem = problem_of(tuple(map(shaken, PATHS)))
    outliers = VarianceFinding("bar_outliers", "", 5.0, 1.0, {"rate": 0.01}, 30.0, Localization())
    plain = extra_variance

    def hasty(*args: object, known: tuple[VarianceFinding, ...] = (), **more: object) -> tuple[VarianceFinding, ...]:
        found = plain(*args, known=known, **more)  # type: ignore[arg-type]
        return found if known else (*found, outliers)

    monkeypatch.setattr("abbe.models.discovery.variance.rounds.extra_variance", hasty)
    assert [f.label for f in scattered(problem, (), ())] == ["vibration:Y"]
