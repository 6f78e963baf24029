"""Hidden effects in the world of the devices: a scenario names one, the instruments read it, the sealed truth tells it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.simulators.hidden.suite import packaged, picked, winner
from abbe.simulators.scenario import Scenario, ScenarioError, from_dict, load
from abbe.simulators.sealed import truth
from abbe.simulators.world import World
from tests.simulators.conftest import QUIET


def world(name: str = "", key: str = "", **parameters: float) -> World:
    hidden: dict[str, Any] = {"hidden": {"name": name, "key": key, "parameters": parameters}} if name else {}
    return World(from_dict({"seed": 4, "magnitudes": QUIET, **hidden}))


def go(w: World, target: tuple[float, float, float], feed: float = 6000.0) -> np.ndarray:
    """Drive there, and where the tool then is, minus where it was sent, mm."""
    w.controller.move(np.array(target, dtype=float), feed)
    w.advance(w.time_s + 30.0)
    return np.asarray(w.tool_position() - np.array(target) - np.array([0.0, 0.0, -120.0]))


def both_ways(w: World, at: tuple[float, float, float], axis: int) -> np.ndarray:
    """Deviation when a place is reached in + minus in - direction of an axis, mm."""
    ends = []
    for side in (-40.0, 40.0):
        start = list(at)
        start[axis] += side
        go(w, tuple(start))  # type: ignore[arg-type]
        ends.append(go(w, at))
    return np.asarray(ends[0] - ends[1])


def test_without_a_table_nothing_changes() -> None:
    plain = World(Scenario(seed=3))
    assert plain.hidden is None
    assert "hidden" not in truth(Scenario(seed=3), None, 2)
    assert np.abs(go(world(), (200, 100, 300))).max() < 1e-12


def test_position_dependent_lost_motion_is_wider_at_one_end() -> None:
    w = world("backlash_position_dependent", "X", strength=6.0, k=0.5)
    for x in (60.0, 300.0, 540.0):
        expected = -6e-3 * (1.0 + 0.5 * (x - 300.0) / 300.0)
        assert both_ways(w, (x, 250.0, 225.0), 0) == pytest.approx([expected, 0.0, 0.0], abs=1e-9)


def test_lateral_play_steps_across() -> None:
    assert both_ways(world("lateral_play", "EYX", strength=4.0), (300.0, 250.0, 225.0), 0) == pytest.approx([0.0, 4e-3, 0.0], abs=1e-9)


def test_an_axis_grows_with_the_world_clock() -> None:
    w = world("axis_thermal_growth", "X", strength=3.0, tau_s=1800.0, x_fixed=0.0)
    for hour in (0.25, 2.0):
        w.advance(3600.0 * hour)
        found = go(w, (500.0, 250.0, 225.0))
        rise = 3.0 * -np.expm1(-w.time_s / 1800.0)
        assert found == pytest.approx([11.5e-6 * rise * 500.0, 0.0, 0.0], abs=1e-9)


def test_a_spike_fades_with_the_travel_since_the_turn() -> None:
    w = world("reversal_spike", "Y", strength=5.0, d0_mm=0.5, p=0.0)
    go(w, (300.0, 300.0, 225.0))
    shortly = go(w, (300.0, 299.9, 225.0))
    later = go(w, (300.0, 290.0, 225.0))
    assert shortly[1] == pytest.approx(5e-3 * -np.expm1(-2.0) * np.exp(-(0.2**1.2)), rel=1e-6)  # held back while it goes to -
    assert abs(later[1]) < 1e-9


def test_a_bump_is_where_it_is() -> None:
    w = world("local_bump", "Z", strength=8.0, cx=300.0, cy=250.0, cz=225.0, w_mm=20.0)
    assert go(w, (300.0, 250.0, 225.0)) == pytest.approx([0.0, 0.0, 8e-3], abs=1e-12)
    assert np.abs(go(w, (300.0, 400.0, 225.0))).max() < 1e-12


def reading(w: World, travel_mm: float, wait_s: float) -> float:
    """Displacement that the laser shows after a way along X and a rest, minus the way, mm."""
    go(w, (100.0, 250.0, 225.0))
    w.laser.mount(np.array([1.0, 0.0, 0.0]), w.tool_position())
    w.laser.compensate(1)
    w.laser.zero(w.tool_position())
    go(w, (100.0 + travel_mm, 250.0, 225.0))
    w.advance(w.time_s + wait_s)
    return float(w.laser.output().displacement_mm - travel_mm)


def test_what_the_laser_alone_has() -> None:
    assert reading(world(), 400.0, 60.0) == pytest.approx(0.0, abs=1e-9)
    cosine = reading(world("laser_cosine", strength=4.0), 400.0, 60.0)
    assert cosine == pytest.approx(400.0 * 0.5 * 4e-3**2, rel=0.08)
    dead = reading(world("dead_path", strength=5.0), 400.0, 570.0)
    assert dead == pytest.approx(-0.93e-6 * 900.0 * 5.0 * 600.0 / 3600.0, rel=0.02)
    w = world("air_refraction", strength=3.0, period_s=6000.0, phase=1.0)
    thin = reading(w, 400.0, 60.0)
    assert thin == pytest.approx(-0.93e-6 * 400.0 * 3.0 * np.sin(2.0 * np.pi * w.time_s / 6000.0 + 1.0), rel=0.02)


def bar_um(w: World, seconds: float = 0.1) -> float:
    """What the bar reads now, um, by many samples."""
    w.ballbar.start(100, w.time_s)
    w.advance(w.time_s + seconds)
    w.ballbar.stop()
    return float(w.ballbar.take().reading_nm.mean()) / 1000.0


def hung_in(w: World, radius_mm: float = 100.0) -> float:
    """Mount cup and bar at the middle, go out to where it reads; when that was, s."""
    go(w, (300.0, 250.0, 225.0))
    w.ballbar.mount(radius_mm, w.tool_position(), w.time_s)
    at = w.time_s
    go(w, (300.0 + radius_mm, 250.0, 225.0))
    return at


def test_a_bar_warm_from_the_hand_reads_too_little_until_it_has_cooled() -> None:
    w = world("bar_thermal", strength=5.0, tau_s=600.0)
    w.advance(4000.0)  # how long the machine has been on does not matter
    began = hung_in(w)
    for wait_s in (0.0, 300.0, 1200.0):
        w.advance(w.time_s + wait_s)
        since = w.time_s + 0.05 - began
        assert bar_um(w) == pytest.approx(-11.5e-6 * 1e5 * 5.0 * np.exp(-since / 600.0), abs=2e-3)


def test_every_bar_that_is_hung_in_comes_from_the_hand_and_one_left_in_goes_on_cooling() -> None:
    w = world("bar_thermal", strength=5.0, tau_s=600.0)
    hung_in(w)
    w.advance(w.time_s + 3000.0)
    cool = bar_um(w)
    assert abs(cool) < 0.05
    assert w.ballbar.take_out()
    go(w, (400.0, 250.0, 225.0))
    assert w.ballbar.change(100.0, w.time_s)
    assert bar_um(w) == pytest.approx(-5.75, abs=0.01)
    hung_in(w)
    assert bar_um(w) == pytest.approx(-5.75 * np.exp(-30.0 / 600.0), abs=0.01)


def test_a_bent_hand_is_not_alike_every_time_and_nothing_else_warms_a_bar() -> None:
    secret = {"name": "bar_thermal", "wild": 7, "parameters": {"strength": 5.0, "tau_s": 600.0}}
    w = World(from_dict({"seed": 4, "magnitudes": QUIET, "hidden": secret}))
    shown = []
    for _ in range(3):
        hung_in(w)
        shown.append(bar_um(w))
    assert max(shown) - min(shown) > 0.1
    assert all(-7.5 < one < -4.0 for one in shown)
    for other in (world(), world("laser_cosine", strength=4.0)):
        hung_in(other)
        assert bar_um(other) == pytest.approx(0.0, abs=1e-3)


def test_the_truth_opens() -> None:
    told = truth(from_dict({"hidden": {"name": "lateral_play", "key": "EYX", "parameters": {"strength": 4.0}}}), None, 2)
    assert told["hidden"] == {"name": "lateral_play", "key": "EYX", "parameters": {"strength": 4.0}, "wild": 0}


PACKAGED = [p for p in packaged() if p.stem != "hidden-none"]


@pytest.mark.parametrize("path", PACKAGED, ids=lambda p: p.stem)
def test_packaged_scenarios_hide_something_that_shows(path: Path) -> None:
    scenario = load(path)
    assert scenario.hidden.name
    told = truth(scenario, None, 2)["hidden"]
    assert isinstance(told, dict)
    assert told["name"] == scenario.hidden.name
    quiet = {"seed": 4, "magnitudes": QUIET}
    w = World(replace(from_dict(quiet), hidden=scenario.hidden))
    plain = World(from_dict(quiet))
    shown = []
    for one in (w, plain):
        one.advance(3600.0)
        ends = [go(one, place) for place in ((300.0, 250.0, 225.0), (560.0, 300.0, 300.0), (559.9, 299.9, 299.9))]
        hung_in(one)
        shown.append([*np.concatenate(ends).tolist(), 1e-3 * bar_um(one), reading(one, 400.0, 60.0)])
    assert np.abs(np.subtract(*shown)).max() > 5e-4


def test_a_seed_stands_for_a_scenario_and_in_some_nothing_is_hidden() -> None:
    found = [picked(seed) for seed in range(200)]
    assert {s.hidden.name for s in found} == {load(p).hidden.name for p in packaged()}
    assert sum(not s.hidden.name for s in found) >= 10
    assert [s.seed for s in found] == list(range(200))
    assert picked(7) == picked(7)


def test_there_is_a_scenario_of_every_family() -> None:
    assert [p.stem.removeprefix("hidden-") for p in PACKAGED] == ["cosine", "drive", "instrument", "structure", "thermal", "unlisted"]


def test_one_more_scenario_changes_only_the_seeds_that_it_wins() -> None:
    fewer = [winner(seed, packaged()[1:]) for seed in range(200)]
    more = [winner(seed, packaged()) for seed in range(200)]
    new = [b for a, b in zip(fewer, more, strict=True) if a != b]
    assert set(new) == {packaged()[0]}
    assert 10 < len(new) < 60


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"name": "gremlins"}, "hidden.name: 'gremlins': unknown effect"),
        ({"name": "clamp_slip", "parameters": {"strength": 3.0}}, "simulated devices do not support"),
        ({"name": "lateral_play", "key": "EYX"}, "needs strength"),
        ({"name": "lateral_play", "key": "Q", "parameters": {"strength": 3.0}}, "'Q' is not a key of lateral_play"),
        ({"name": "lateral_play", "parameters": {"strength": "much"}}, "hidden.parameters"),
        ({"name": "bar_thermal", "parameters": {"strength": 3.0}}, "needs tau_s"),
        ({"nome": "backlash"}, "unknown key: hidden.nome"),
    ],
)
def test_a_wrong_table_is_refused(table: dict[str, object], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        World(from_dict({"hidden": table}))
