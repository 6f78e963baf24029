"""Another bar on the cup that stands, another process and another program at the machine: going on drives nothing off its sphere."""

from __future__ import annotations

import asyncio
import math
import os
from pathlib import Path

import pytest

from abbe.service.campaigns.campaign_run import items, mounted_anew, resumed_item
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.devices.session import lock_machine
from abbe.service.errors import (
    ProgramRuns,
    SpindleTurns,
    Stopped,
    UnsafeToMove,
)
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.resume_plan import end_of, way_back
from abbe.service.sequences.steps import CampaignPlan, ChangeBar, FollowPath, MountBar, RecordPath, TakeBarOut
from abbe.service.storage.store import Store
from abbe.simulators.cnc.device import Hold
from tests.faults.sequencer_world import AtStep, InTest, bench, number, on_one_cup, small
from tests.faults.test_going_on import broken_off, going_on, statuses, step_of, yes

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
CUP = (300.0, 250.0, 100.0)


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


# ---- another bar on the cup -------------------------------------------------------------------------------------------


def test_before_a_bar_change_nothing_moves_and_the_place_is_looked_at():
    item = resumed_item(items(on_one_cup(100.0, 60.0))[1], None, ())
    end = end_of(on_one_cup(100.0, 60.0).tests[0])
    assert end is not None
    assert item.resume_trail.trail == (end,)
    assert way_back(item.resume_trail, end) == ()
    assert isinstance(item.left.steps[0], TakeBarOut)


def test_a_set_up_that_is_mounted_anew_takes_the_bar_of_its_test():
    test = items(on_one_cup(100.0, 60.0, 60.0))[2]
    steps = mounted_anew(test, 2).whole.steps
    assert [s.radius_mm for s in steps if isinstance(s, MountBar)] == [60.0]
    path = next(s for s in steps if isinstance(s, RecordPath))
    assert math.dist(path.points_mm[0], CUP) == pytest.approx(60.0, abs=1e-4)


@pytest.mark.parametrize(
    ("kind", "how"),
    [(k, h) for k in (TakeBarOut, FollowPath, ChangeBar, RecordPath) for h in (Control.stop, Control.pause)]
    if LONG
    else [(TakeBarOut, Control.stop), (FollowPath, Control.pause), (ChangeBar, Control.stop), (RecordPath, Control.stop)],
)
async def test_a_campaign_with_two_bars_on_a_cup_is_gone_on_with_on_their_spheres(place, kind, how):
    """The oracle of the bench looks at every motion with a bar hung in."""
    b, store = place
    plan = on_one_cup(100.0, 60.0)
    inside = kind in (FollowPath, RecordPath)
    control = InTest(store, 1, number(plan, 1, kind), lambda: asyncio.get_running_loop().call_later(0.02 * inside, how, control))
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    async for now in control.watch():
        if now.state == State.PAUSED:
            control.resume()
    if how == Control.stop:
        with pytest.raises(Stopped):
            await task
        await going_on(b, store, plan, yes)
    else:
        await task
    assert [s for _, s in statuses(store)].count("complete") == 2
    assert b.sphere.looked > 4


async def test_a_machine_that_was_moved_before_a_bar_change_has_its_bar_mounted_anew(place):
    b, store = place
    plan = on_one_cup(100.0, 60.0)
    control = InTest(store, 1, number(plan, 1, TakeBarOut), lambda: control.stop())
    with pytest.raises(Stopped):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control))
    b.sim.world.controller.position_mm = b.sim.world.controller.position_mm + 2.0
    await going_on(b, store, plan, yes)
    last = store.runs.all()[-1]
    assert (last.status, last.start_doc["setup"]["setup_id"]) == ("complete", "B1-2")
    assert b.sim.world.ballbar._radius_mm == 60.0


# ---- two at one machine -----------------------------------------------------------------------------------------------


async def test_a_campaign_whose_process_lives_is_not_gone_on_with(place):
    """Also between two runs, while it is paused, when no run is open."""
    b, store = place
    plan = CampaignPlan("c", (small("Helix"),))
    control = InTest(store, 0, step_of(plan, RecordPath), lambda: asyncio.get_running_loop().call_later(0.02, control.pause))
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    async for now in control.watch():
        if now.state == State.PAUSED:
            with pytest.raises(UnsafeToMove, match=r"campaign 'c' is being measured \(process \d+"):
                await resume(b.session, store, b.site, plan, "c", yes)
            control.resume()
    await task
    assert statuses(store)[-1] == ("test-2", "complete")


def test_a_machine_is_one_process_s(tmp_path, monkeypatch):
    monkeypatch.setenv("ABBE_LOCK_FOLDER", str(tmp_path))
    with lock_machine("modbus+tcp://127.0.0.1:1?unit=1"):
        second = lock_machine("modbus+tcp://127.0.0.1:1")
        with pytest.raises(UnsafeToMove, match=r"the machine at modbus\+tcp://127\.0\.0\.1:1 is in use by process \d+"):
            second.__enter__()
        with lock_machine("modbus+tcp://127.0.0.1:2"):
            pass
    with lock_machine("modbus+tcp://127.0.0.1:1"):
        pass


@pytest.mark.parametrize("when", ["measure", "resume", "pause"])
async def test_somebody_else_s_program_runs_on(place, when):
    b, store = place
    controller, plan = b.sim.world.controller, CampaignPlan("c", (small("Linear"),))

    def program() -> None:
        assert controller.run_program([(controller.position_mm - 5.0, 3000.0)]) == 0

    if when == "pause":
        control = AtStep(7, lambda: control.pause())
        task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
        async for now in control.watch():
            if now.state == State.PAUSED:
                at = len(b.sim.registers.log)
                program()
                control.abort()
        with pytest.raises(Exception, match="aborted as asked"):
            await task
    else:
        if when == "resume":
            await broken_off(b, store)
        at = len(b.sim.registers.log)
        program()
        with pytest.raises(ProgramRuns):
            await (resume(b.session, store, b.site, plan, "c", yes) if when == "resume" else measure(b.session, store, b.site, plan))
    assert [c.kind for c in b.sim.registers.log[at:]] == []
    assert controller.switches.program_running


@pytest.mark.parametrize("level", [Hold.HOLD, Hold.ABORT])
async def test_a_hold_that_a_killed_process_left_is_taken_back(place, level):
    b, store = place
    b.sim.world.controller.request_hold(level)
    await measure(b.session, store, b.site, CampaignPlan("c", (small("Linear"),)))
    assert statuses(store) == [("test", "complete")]


async def test_a_turning_spindle_forbids_motion(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    control = AtStep(7, lambda: setattr(b.sim.world.controller.switches, "spindle_turning", True))
    with pytest.raises(SpindleTurns):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control))
