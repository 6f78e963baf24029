"""An artefact probed on the simulated machine: what goes wrong is named, breaks nothing and loses nothing."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.drivers.cnc.driver import ModbusController
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.campaign_run import decline
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.domain.run import FEATURE
from abbe.service.errors import (
    Aborted,
    ConfigError,
    DoorOpen,
    FalseTrips,
    MissedContact,
    Obstructed,
    ProbeNotReady,
    ProbeUncalibrated,
    Stopped,
)
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Control
from abbe.service.sequences.steps import CampaignPlan, TouchFeature
from abbe.service.storage.store import Store
from abbe.simulators.scenario import ArtefactConfig
from tests.faults.sequencer_world import MACHINE, PLATE, AtStep, Bench, bench, small
from tests.patience import within

SPEED = 100.0
ROW = PLATE.model_copy(update={"features": PLATE.features[:3]})
ALL = ["A1", "B1", "C1", "A1"]


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path) as b:
        b.sim.pace(SPEED)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store
        assert not b.sim.world.table.stylus.broken
        assert b.sim.world.controller.alarm in (0, 1)


def plan(**more: Any) -> CampaignPlan:
    return CampaignPlan("plate", (small("ArtefactTest", **({"plate": ROW, "turned_every": 0} | more)),))


def feature_step(made: CampaignPlan, nth: int) -> int:
    return [k + 1 for k, s in enumerate(made.tests[0].steps) if isinstance(s, TouchFeature)][nth]


async def run(place: tuple[Bench, Store], made: CampaignPlan, control: Control | None = None) -> None:
    b, store = place
    await measure(b.session, store, b.site, made, options=MeasureOptions(control))


def at(made: CampaignPlan, nth: int, do: Callable[[], None], delay_s: float = 0.0) -> AtStep:
    """Do something when the n-th feature is reached."""
    return AtStep(feature_step(made, nth), do, delay_s)


def found(store: Store) -> list[str]:
    (complete,) = from_store(store, "plate").runs
    return list(complete.columns.further[FEATURE])


async def on(place: tuple[Bench, Store], made: CampaignPlan) -> None:
    """Resume the campaign after its fault was cleared."""
    b, store = place
    b.sim.world.controller.set_door(is_open=False)
    await measure(
        b.session, store, b.site, made, options=MeasureOptions(resumed=await resume(b.session, store, b.site, made, "plate", decline))
    )


async def test_every_feature_is_found_to_a_micrometre_and_the_first_one_again(place):
    b, store = place
    await run(place, plan())
    assert found(store) == ALL
    (run_,) = from_store(store, "plate").runs
    alone = load_run(store, store.runs.all()[0].id)
    assert alone.setup.features == run_.setup.features == ROW, "a run read alone, as a push reads it, knows its artefact"
    body = b.sim.world.table.body
    form = body.form_mm[[body.ids.index(name) for name in ALL]][:, :2]
    deviation = np.column_stack([run_.columns.further[f"deviation_{a}_mm"] for a in "xy"])
    nominal = body.nominal_mm[[body.ids.index(name) for name in ALL]][:, :2]
    turn = np.stack([-nominal[:, 1], nominal[:, 0]], axis=1)
    columns = np.zeros((2 * len(ALL), 3))
    columns[0::2, 0] = columns[1::2, 1] = 1.0
    columns[:, 2] = turn.reshape(-1)
    off = (deviation - form).reshape(-1)
    left = off - columns @ np.linalg.lstsq(columns, off, rcond=None)[0]
    assert np.abs(left).max() < 0.008, "form and pose; the rest are the machine's errors over 150 mm"
    assert (run_.columns.further["u_mm"] < 5e-4).all()
    assert np.isfinite(run_.columns.further["temperature_C"]).all()


async def test_a_false_trip_is_refused_and_the_feature_found_all_the_same(place):
    b, store = place
    made = plan()
    await run(place, made, at(made, 1, lambda: setattr(b.sim.world.table.stylus, "false_trips", 1)))
    assert found(store) == ALL


async def test_a_probe_that_trips_anywhere_is_named(place):
    b, _ = place
    made = plan()
    with pytest.raises((FalseTrips, Obstructed), match="feature C1"):
        await run(place, made, at(made, 2, lambda: setattr(b.sim.world.table.stylus, "false_trips", 10_000)))
    b.sim.world.table.stylus.false_trips = 0


async def test_a_missed_contact_stops_at_its_feature_which_is_where_it_goes_on(place):
    b, store = place
    made = plan()
    with pytest.raises(MissedContact, match=r"feature C1: no contact within 0\.8 mm"):
        await run(place, made, at(made, 2, lambda: setattr(b.sim.world.table.stylus, "missed", 1)))
    assert b.sim.world.controller.position_mm[2] == pytest.approx(200.0 + 20.0), "the stylus was taken out"
    (failed,) = store.runs.all()
    assert failed.reason.startswith("PRB-002")
    await on(place, made)
    assert found(store) == ALL
    points = [c.doc["points"] for c in store.checkpoints.of_campaign(failed.campaign_id) if c.kind == "point" and c.doc["run"] != failed.id]
    assert min(points) == 3, "two features were kept"


async def test_a_plate_that_slips_is_named_and_clamped_and_measured_anew(place):
    b, store = place
    made = plan()
    await run(place, made, at(made, 2, lambda: b.sim.world.table.move(np.array([0.05, 0.0, 0.0]))))
    first, second = store.runs.all()
    assert first.reason.startswith("SEQ-008: feature A1 moved by 50 um (features touched meanwhile: 3): the artefact is loose")
    assert (first.status, second.status) == ("failed", "complete")
    assert second.start_doc["setup"]["setup_id"] == "S-2"
    assert found(store) == ALL


async def test_a_plate_that_slipped_while_nobody_measured_is_seen_before_the_next_feature(place):
    b, store = place
    made = plan()
    with pytest.raises(Stopped):
        await run(place, made, StopAt(feature_step(made, 2)))
    b.sim.world.table.move(np.array([0.0, 0.03, 0.0]))
    await on(place, made)
    assert [r.start_doc["setup"]["setup_id"] for r in store.runs.all()] == ["S", "S", "S-2"]
    assert found(store) == ALL


class StopAt(AtStep):
    """Stops the measurement at a step."""

    def __init__(self, step: int) -> None:
        super().__init__(step, self.stop)


async def test_stopped_and_resumed_it_goes_on_at_the_feature(place):
    b, store = place
    made = plan()
    with pytest.raises(Stopped):
        await run(place, made, StopAt(feature_step(made, 2)))
    before = len(b.sim.motions())
    await on(place, made)
    assert found(store) == ALL
    touched = [c for c in b.sim.motions()[before:] if c.kind == "touch"]
    assert len(touched) < 3.5 * 16, "the first feature, the third and the first one again"


async def test_resumed_in_vain_it_loses_no_feature(place):
    """The first resumption misses its first contact and ends without a record of its own."""
    b, store = place
    made = plan()
    with pytest.raises(Stopped):
        await run(place, made, StopAt(feature_step(made, 2)))
    b.sim.world.table.stylus.missed = 1
    with pytest.raises(MissedContact, match="feature A1"):
        await on(place, made)
    await on(place, made)
    assert found(store) == ALL
    last = store.runs.all()[-1]
    points = [c.doc["points"] for c in store.checkpoints.of_campaign(last.campaign_id) if c.kind == "point" and c.doc["run"] == last.id]
    assert min(points) == 3, "two features were kept"


async def at_the_twelfth_touch(place: tuple[Bench, Store], made: CampaignPlan, control: Control, do: Callable[[], None]) -> int:
    """Do something during the fourth touch of the second hole; return the touches afterwards, until the measurement ended."""
    b, starts = place[0], list[float]()
    feel, loop = b.sim.world.controller.feel, asyncio.get_running_loop()

    def touched(start, target, feed):
        if feed == 300.0:
            starts.append(feed)
            if len(starts) == 12:
                loop.call_soon(do)
        return feel(start, target, feed)

    b.sim.world.controller.feel = touched
    with suppress(Stopped):
        await run(place, made, control)
    b.sim.world.controller.feel = feel
    return len(starts) - 12


async def test_a_stop_waits_for_the_next_side_only_and_takes_the_stylus_out(place):
    b, store = place
    made, control = plan(), Control()
    assert await at_the_twelfth_touch(place, made, control, control.stop) <= 1
    assert b.sim.world.controller.position_mm[2] == pytest.approx(220.0)
    await on(place, made)
    assert found(store) == ALL


async def test_a_pause_in_a_feature_begins_it_anew(place):
    b, store = place
    heights: list[float] = []

    class Pausing(Control):
        async def resumed(self) -> None:
            heights.append(float(b.sim.world.controller.position_mm[2]))
            self.resume()
            await super().resumed()

    control = Pausing()
    assert await at_the_twelfth_touch(place, plan(), control, control.pause) >= 3 * 8
    assert heights == [pytest.approx(220.0)]
    assert found(store) == ALL


async def aborted_in_the_second_hole(place: tuple[Bench, Store], made: CampaignPlan) -> None:
    """Abort during a touch; then free the stylus by hand, which leaves it in the hole."""
    b, _ = place
    control, starts = Control(), list[np.ndarray]()
    feel, loop = b.sim.world.controller.feel, asyncio.get_running_loop()

    def abort_in_the_second_hole(start, target, feed):
        if feed == 300.0:
            starts.append(start.copy())
            if len(starts) == 12:
                loop.call_soon(control.abort)
        return feel(start, target, feed)

    b.sim.world.controller.feel = abort_in_the_second_hole
    with pytest.raises(Aborted):
        await run(place, made, control)
    assert b.sim.world.controller.position_mm[2] < 200.0, "in the second hole"
    b.sim.world.controller.run_program([(starts[11], 1.0)])
    async with asyncio.timeout(within(10.0)):
        while b.sim.world.controller.moving:  # noqa: ASYNC110 - the simulated axes tell nobody
            await asyncio.sleep(0.01)


async def test_aborted_in_a_hole_it_leaves_the_hole_first(place):
    made = plan()
    await aborted_in_the_second_hole(place, made)
    await on(place, made)
    assert found(place[1]) == ALL


async def test_begun_anew_with_the_stylus_in_a_hole_it_stops_at_the_wall(place):
    b, store = place
    await aborted_in_the_second_hole(place, plan())
    begin = b.sim.world.controller.position_mm.copy()
    with pytest.raises(Obstructed, match="on its way to the artefact"):
        await measure(b.session, store, b.site, CampaignPlan("another", plan().tests), options=MeasureOptions(None))
    assert np.abs(b.sim.world.controller.position_mm - begin).max() < 0.01, "it backed off"


async def test_a_stylus_that_stays_deflected_is_taken_out_and_named(place, monkeypatch):
    b, _ = place
    world, state = b.sim.world, ModbusController.probe_state

    async def stuck(self):
        now = await state(self)
        inside = world.controller.position_mm[2] < 210.0
        return replace(now, deflected=True) if inside else now

    made = plan()
    monkeypatch.setattr(ModbusController, "probe_state", stuck)
    with pytest.raises(ProbeNotReady, match="stays deflected"):
        await run(place, made)
    assert world.controller.position_mm[2] > 210.0, "above the plate"


async def test_an_open_door_stops_it_as_everything_else(place):
    b, store = place
    made = plan()
    with pytest.raises(DoorOpen):
        await run(place, made, at(made, 2, lambda: b.sim.world.controller.set_door(is_open=True)))
    await on(place, made)
    assert found(store) == ALL


async def test_a_pause_waits_above_a_feature(place):
    b, store = place
    made = plan()
    heights: list[float] = []

    class Pause(AtStep):
        def __init__(self) -> None:
            super().__init__(feature_step(made, 2), self.pause)

        async def resumed(self) -> None:
            heights.append(float(b.sim.world.controller.position_mm[2]))
            self.resume()
            await super().resumed()

    await run(place, made, Pause())
    assert heights == [pytest.approx(220.0)]
    assert found(store) == ALL


async def test_another_stylus_than_stated_is_named(place):
    with pytest.raises(ProbeUncalibrated, match=r"feature A1: its radius comes out 0\.\d+ mm too small"):
        await run(place, plan(stylus_radius_mm=2.7))


def worn(b: Bench, by_mm: float) -> Callable[[], None]:
    """Let the ball of the stylus become smaller, or move on its stem, by so much."""
    stylus = b.sim.world.table.stylus
    return lambda: setattr(stylus, "radius_mm", stylus.radius_mm - by_mm)


async def test_a_stylus_that_changes_while_it_measures_is_named_when_the_first_feature_is_touched_again(place):
    b, store = place
    made = plan()
    await run(place, made, at(made, 2, worn(b, 0.02)))
    first, second = store.runs.all()
    assert re.match(r"SEQ-008: feature A1: its radius changed by \+(19|20)\.\d ± \d\.\d um \(features touched meanwhile: 3\)", first.reason)
    assert (first.status, second.status) == ("failed", "complete")
    assert second.start_doc["setup"]["setup_id"] == "S-2", "no point of the changed stylus is carried over"
    assert found(store) == ALL


async def test_a_stylus_that_stays_within_its_qualification_is_not_doubted(place):
    b, store = place
    made = plan()
    await run(place, made, at(made, 2, worn(b, 0.001)))
    assert found(store) == ALL


async def test_after_a_pause_the_first_feature_is_touched_before_the_next_one(place):
    b, store = place
    made = plan()

    class Changing(AtStep):
        def __init__(self) -> None:
            super().__init__(feature_step(made, 2), self.pause)

        async def resumed(self) -> None:
            worn(b, 0.02)()
            self.resume()
            await super().resumed()

    await run(place, made, Changing())
    first, second = store.runs.all()
    assert re.match(r"SEQ-008: feature A1: its radius changed by .* um \(features touched meanwhile: 2\)", first.reason)
    assert second.start_doc["setup"]["setup_id"] == "S-2"


async def test_a_plate_that_lies_elsewhere_is_named_before_anything_breaks(place):
    b, _ = place
    made = plan()
    with pytest.raises(Obstructed, match=r"feature A1: the probe touched something at X .* on its way"):
        await run(place, made, at(made, 0, lambda: b.sim.world.table.move(np.array([15.0, 3.0, 0.0]))))


async def test_a_plate_turned_by_a_quarter_is_named_where_its_holes_show_it(tmp_path):
    async with bench(tmp_path, artefact=ArtefactConfig(columns=3, rows=2)) as b:
        b.sim.pace(SPEED)
        b.sim.world.table.quarters = 1
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store, pytest.raises(Obstructed, match="turned by 90 degrees"):
            await measure(b.session, store, b.site, plan())
        assert not b.sim.world.table.stylus.broken


async def test_without_probe_or_with_a_bent_stylus_nothing_moves_down(place):
    b, _ = place
    made = plan()
    with pytest.raises(ProbeNotReady, match="feature A1: no touch probe is fitted"):
        await run(place, made, at(made, 0, b.sim.world.table.unmount))


async def test_a_control_that_cannot_touch_is_refused_before_anything_moves(place, monkeypatch):
    b, _ = place
    monkeypatch.delattr(ModbusController, "touch")
    with pytest.raises(ConfigError, match="cannot touch"):
        await run(place, plan())
    assert not b.sim.motions()


def test_the_whole_way_lies_within_the_strokes():
    made = plan()
    touches = [s for s in made.tests[0].steps if isinstance(s, TouchFeature)]
    places = np.array([p for s in touches for p in s.places_mm()])
    assert (places >= MACHINE.stroke_mm[:, 0]).all()
    assert (places <= MACHINE.stroke_mm[:, 1]).all()
