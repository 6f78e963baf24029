"""What is only tried beside another effect: a second pitch, a lost motion that begins; and noise that does not hold what is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import Pick, taken
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import discover
from abbe.models.discovery.instrument_noise import fine
from abbe.models.discovery.lack import floors
from abbe.models.discovery.selection import Contest, merged
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.path import Path
from tests.models.discovery.test_discovery_search import campaign

TURNS = tuple(e for e in CATALOGUE if e.name.startswith("backlash") or e.name == "reversal_spike")
WAVES = tuple(e for e in CATALOGUE if e.name.startswith("cyclic_error") or e.name == "backlash")
BEGIN_S = 640.0


def moved(along_x_um: Callable[[Path], F1]) -> Case:
    """The small campaign, its X axis off by so many micrometres."""
    case = campaign()
    runs = [
        r if r.deviation_mm is None else replace(r, deviation_mm=r.deviation_mm + 1e-3 * r.path.look[:, 0] * along_x_um(r.path))
        for r in case.runs
    ]
    return replace(case, runs=tuple(runs))


def waves(path: Path) -> F1:
    x = path.at.q_mm[:, 0]
    return np.asarray(2.0 * np.sin(2.0 * np.pi * x / 20.0) + 1.5 * np.cos(2.0 * np.pi * x / 27.0))


def test_two_pitches_of_one_axis_are_two_effects_with_their_sizes() -> None:
    found = discover(moved(waves), WAVES)
    sizes = {e.label: (abs(e.strength), e.parameters["pitch_mm"][0]) for e in found.effects}
    assert set(sizes) == {"cyclic_error:X", "cyclic_error_second:X"}
    assert sorted(sizes.values()) == [pytest.approx((1.5, 27.0), rel=0.05), pytest.approx((2.0, 20.0), rel=0.05)]


def test_a_wave_and_its_double_pitch_are_one_wave_with_harmonics() -> None:
    def bent(path: Path) -> F1:
        x = path.at.q_mm[:, 0]
        return np.asarray(2.0 * np.sin(2.0 * np.pi * x / 20.0) + 1.5 * np.cos(2.0 * np.pi * x / 10.0))

    case = moved(bent)
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, WAVES)
    by = {e.name: e for e in WAVES}
    short, long = Pick(by["cyclic_error"], "X", {"pitch_mm": 10.0}), Pick(by["cyclic_error_second"], "X", {"pitch_mm": 20.0})
    (wave,) = merged(contest, [short, long])
    assert (wave.label, [f.name for f in wave.forms]) == ("cyclic_error:X", ["second harmonic"])
    assert wave.values["pitch_mm"] == pytest.approx(20.0, rel=1e-3)
    only_second = Contest.of(problem, [e for e in WAVES if e.name != "cyclic_error"])
    only_second.look_for_more([short], taken(problem, [short]))
    assert merged(only_second, [short, long]) == [short, long]  # a second wave needs a first one


def test_a_wave_whose_pitch_changes_along_the_axis_gets_no_pitch() -> None:
    def chirp(path: Path) -> F1:
        share = path.at.q_mm[:, 0] / 400.0
        return np.asarray(3.0 * np.sin(2.0 * np.pi * 400.0 * (share / 24.0 + share**2 / 100.0)))

    found = discover(moved(chirp), WAVES)
    assert (found.verdict, found.effects) == ("unknown", ())
    assert (found.location.axes, found.location.shape) == (("X",), "its period is not constant")


def test_a_wave_with_a_faint_one_close_by_is_one_wave_whose_amplitude_changes() -> None:
    def swelling(path: Path) -> F1:
        x = path.at.q_mm[:, 0]
        return np.asarray(3.0 * np.sin(2.0 * np.pi * x / 20.0) + 0.4 * np.cos(2.0 * np.pi * x / 21.5))

    (effect,) = discover(moved(swelling), WAVES).effects
    assert effect.label == "cyclic_error:X"
    assert effect.parameters["pitch_mm"][0] == pytest.approx(20.0, rel=0.002)
    assert abs(effect.strength) == pytest.approx(3.0, rel=0.05)


def test_a_lost_motion_from_some_moment_on_is_named_with_that_moment() -> None:
    found = discover(moved(lambda path: -2.5 * path.at.sign[:, 0] * (path.at.t_s >= BEGIN_S)), TURNS)
    (effect,) = found.effects
    assert effect.label == "backlash_begun:X"
    assert effect.strength == pytest.approx(5.0, rel=0.1)
    begin, u = effect.parameters["t0_s"]
    assert abs(begin - BEGIN_S) < 2.0 * u + 1.0
    assert u < 30.0


def test_the_noise_holds_no_wave_that_the_fit_misses() -> None:
    """The fit's residuals hold all of it, neighbours 5.8 mm apart a little of it, runs in the plane of Y and Z nothing."""
    problem = whiten(moved(waves), baseline_of(campaign()))
    assert problem.colours["bar"].sd_mm > 3e-4
    assert floors(problem)["bar"].sd_mm == pytest.approx(2e-4, rel=0.25)


@pytest.mark.parametrize("readings", [60, 500])
def test_the_noise_of_short_and_long_runs_comes_out_right(readings: int) -> None:
    noise = np.random.default_rng(3).normal(size=20 * readings)
    slow = 5.0 * np.sin(np.arange(noise.size) / 4.0)
    found = fine(noise + slow, [readings] * 20, ["bar"] * 20, np.ones(noise.size), np.zeros(noise.size))
    assert found["bar"].sd_mm == pytest.approx(1.0, rel=0.1)
