"""Plate and probe in the simulated world: where a touch trips, what goes wrong, and what a person knows of the plate."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from abbe.simulators.artefact.plate import placed
from abbe.simulators.cnc.device import ALARM_CRASH, Result
from abbe.simulators.scenario import ArtefactConfig, Magnitudes, ProbeConfig, Scenario
from abbe.simulators.world import World

STILL = Magnitudes(**{f.name: (0.0, 0.0) if isinstance(f.default, tuple) else 0.0 for f in dataclasses.fields(Magnitudes)} | {
    "drift_tau_min": (40.0, 90.0)
})  # fmt: skip
"""A machine without errors."""
EXACT = ProbeConfig(pretravel_um=0.0, lobing_um=0.0, noise_um=0.0)
ORIGIN = np.array([200.0, 150.0, 100.0])


def world(kind: str = "hole_plate", probe: ProbeConfig = EXACT, expansion_ppm: float = 0.0) -> World:
    plate = ArtefactConfig(kind=kind, drift_um_per_h=0.0, expansion_ppm=expansion_ppm)
    made = World(Scenario(magnitudes=STILL, artefact=plate, probe=probe))
    made.table.mount(ORIGIN, np.eye(3), 0.0)
    return made


def in_hole(w: World, name: str) -> np.ndarray:
    """Put the stylus into a hole from above, and return its centre."""
    x, y, z = centre(w, name)
    go(w, x, y, z + 20.0)
    assert go(w, x, y, z - 8.0, touch=True) is None, "the ball fits into the hole"
    return np.array([x, y, z])


def go(w: World, *target: float, touch: bool = False, feed: float = 600.0) -> np.ndarray | None:
    """Move or touch, and return where the probe tripped."""
    command = w.controller.touch if touch else w.controller.move
    assert command(np.array(target), feed) == Result.OK
    w.advance(w.time_s + 600.0)
    return w.controller.latch_mm


def centre(w: World, name: str) -> np.ndarray:
    """Axis position at which the tip is in the middle of a feature."""
    found = placed(w.table.body, w.table._mounting, w.time_s, w.table.temperature_c)[w.table.body.ids.index(name)]
    return np.asarray(found - w.machine.geometry.tool_mm)


def test_opposite_touches_of_a_hole_meet_in_its_centre() -> None:
    w = world()
    x, y, z = in_hole(w, "B2")
    right = go(w, x + 12.0, y, z - 8.0, touch=True)
    go(w, x, y, z - 8.0)
    left = go(w, x - 12.0, y, z - 8.0, touch=True)
    assert 0.5 * (right + left)[:2] == pytest.approx([x, y], abs=1e-3), "a tilted hole leans by tilt times depth"
    assert right[0] - left[0] == pytest.approx(2.0 * (10.0 - 3.0), abs=1e-6)


def test_a_ball_is_touched_from_above_and_beside() -> None:
    w = world("ball_plate")
    x, y, z = centre(w, "C3")
    go(w, x, y, z + 30.0)
    top = go(w, x, y, z, touch=True)
    assert top == pytest.approx([x, y, z + 13.0], abs=1e-5)


def test_pre_travel_makes_a_hole_wider_and_lobing_moves_it() -> None:
    w = world(probe=ProbeConfig(pretravel_um=10.0, lobing_um=2.0, noise_um=0.0))
    x, y, z = in_hole(w, "A1")
    right = go(w, x + 12.0, y, z - 8.0, touch=True)
    go(w, x, y, z - 8.0)
    left = go(w, x - 12.0, y, z - 8.0, touch=True)
    assert right[0] - left[0] == pytest.approx(14.0 + 0.020, abs=1e-4)
    assert 1e-5 < abs(0.5 * (right + left)[0] - x) < 2.1e-3


def test_the_axes_stop_just_beyond_the_trip_and_a_new_touch_forgets_the_latch() -> None:
    w = world()
    x, y, z = in_hole(w, "A1")
    right = go(w, x + 12.0, y, z - 8.0, touch=True)
    assert 0.0 < w.controller.position_mm[0] - right[0] < 0.03
    assert w.controller.deflected()
    assert w.controller.touch(np.array([x, y, z - 8.0]), 100.0) == Result.NO_PROBE, "only a move frees the stylus"
    go(w, x, y, z - 8.0)
    assert w.controller.latch_mm is None
    assert not w.controller.deflected()


def test_a_stylus_driven_into_the_plate_breaks() -> None:
    w = world()
    x, y, z = centre(w, "A1")
    go(w, x + 22.0, y, z + 20.0)
    assert w.controller.move(np.array([x + 22.0, y, z - 20.0]), 600.0) == Result.OK
    w.advance(w.time_s + 60.0)
    assert w.controller.alarm == ALARM_CRASH
    assert w.controller.position_mm[2] == pytest.approx(z + 3.0 - 1.0, abs=0.05)
    assert not w.table.fitted


def test_touches_go_wrong_on_request() -> None:
    w = world()
    x, y, z = in_hole(w, "A1")
    w.table.stylus.false_trips = 1
    assert go(w, x + 6.0, y, z - 8.0, touch=True)[0] < x + 5.0
    w.table.stylus.missed = 1
    go(w, x, y, z - 8.0)
    assert go(w, x + 7.5, y, z - 8.0, touch=True) is None


def test_without_a_plate_the_control_has_no_probe() -> None:
    w = World(Scenario())
    assert w.controller.touch(np.array([1.0, 1.0, 1.0]), 100.0) == Result.NO_PROBE


def test_the_plate_turns_slips_and_grows() -> None:
    w = world(expansion_ppm=11.5)
    before = centre(w, "D4")
    w.table.temperature_c += 2.0
    grown = centre(w, "D4") - before
    assert grown[:2] == pytest.approx([225.0 * 11.5e-6 * 2.0] * 2, rel=1e-3)
    w.table.move(np.array([0.05, 0.0, 0.0]))
    assert (centre(w, "D4") - before - grown)[0] == pytest.approx(0.05)
    w.table.quarters = 1
    w.table.mount(ORIGIN, np.eye(3), 0.0)
    assert centre(w, "A1") == pytest.approx(before - [0.0, 225.0, 0.0], abs=1.0)


def test_its_owner_knows_nominal_places_and_one_length() -> None:
    known = World(Scenario()).table.body.document(4e-4)
    body = World(Scenario()).table.body
    (length,) = known["calibrated_lengths"]
    assert (length["from"], length["to"]) == ("A1", "D1")
    assert abs(length["length_mm"] - 225.0) < 0.1
    assert length["length_mm"] == pytest.approx(
        float(np.linalg.norm((body.nominal_mm + body.form_mm)[3] - (body.nominal_mm + body.form_mm)[0])), abs=1e-5
    )
    assert "form" not in str(known)
