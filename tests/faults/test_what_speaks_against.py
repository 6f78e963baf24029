"""Going on only if nothing speaks against it: other people's hands, a changed table, lost ends, a locked database."""

from __future__ import annotations

import asyncio
import os
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.api import LaserReading
from abbe.drivers.errors import DeviceFault
from abbe.service.campaigns import campaign_run
from abbe.service.campaigns.campaign_run import decline
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import begun_source
from abbe.service.domain.progress import Progress
from abbe.service.errors import (
    ConfigError,
    DoorOpen,
    EstopPressed,
    PreconditionsChanged,
    StatusUnknown,
    Stopped,
)
from abbe.service.sequences.control import Control, State, Suspending, Watching
from abbe.service.sequences.journal import StoreJournal
from abbe.service.sequences.steps import CampaignPlan, MoveTo, ReadBar, RecordPath
from abbe.service.storage import engine
from abbe.service.storage.store import Store
from tests.faults.sequencer_world import AtStep, Bench, InTest, bench, number, small
from tests.faults.test_going_on import SUSPENDING, broken_off, going_on, statuses, step_of
from tests.patience import within

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
CUP = (300.0, 250.0, 100.0)


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


# ---- an end that was asked for ----------------------------------------------------------------------------------------


async def test_an_end_from_outside_is_heard_while_an_interlock_stops_the_axes(place):
    """SIGTERM comes while the feed hold of an opened door is under way: the measurement ends, although the door would only suspend it."""
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    motion = b.session.controller.noted_controller
    hold, loop, came = motion.request_hold, asyncio.get_running_loop(), []

    async def slow(level: int) -> None:
        if level == 1 and not came:
            came.append(level)
            task.cancel()
            await asyncio.sleep(0.05)
        await hold(level)

    motion.request_hold = slow
    door = b.sim.world.controller.set_door
    control = AtStep(step_of(plan, MoveTo, 6), lambda: (b.sim.pace(2.0), loop.call_later(0.02, lambda: door(is_open=True))))
    site = replace(b.site, watching=Watching(None, SUSPENDING, unknown_s=5.0))
    task = asyncio.create_task(measure(b.session, store, site, plan, options=MeasureOptions(control)))
    await asyncio.wait({task}, timeout=20)
    assert came
    assert task.cancelled()
    assert statuses(store) == [("test", "aborted")]


async def test_ctrl_c_ends_a_question():
    control = Control()

    async def question() -> bool:
        await asyncio.Event().wait()
        return True

    asyncio.get_running_loop().call_soon(control.stop)
    async with asyncio.timeout(within(5)):
        with pytest.raises(Stopped):
            await control.unless_stopped(question())


async def test_a_pause_that_is_taken_back_at_once_is_not_told_for_ever(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    states: list[str] = []
    control = AtStep(8, lambda: (control.pause(), control.resume()))
    sink = lambda p: states.append(p.state)  # noqa: E731
    await measure(b.session, store, b.site, plan, progress=sink, options=MeasureOptions(control))
    assert control.done
    assert set(states[8:]) == {"running"}


# ---- what was touched ---------------------------------------------------------------------------------------------------


async def door_in_the_pause(b: Bench, control: Control, knock: Callable[[], None]) -> None:
    door = b.sim.world.controller.set_door
    async for now in control.watch():
        if now.state == State.PAUSED and now.why == "paused as asked":
            door(is_open=True)
            await asyncio.sleep(0.3)  # three looks
            knock()
            door(is_open=False)
            control.resume()


async def test_a_mirror_knocked_in_a_pause_is_found_by_reading_the_last_point_again(place):
    b, store = place
    laser, plan = b.sim.world.laser, CampaignPlan("c", (small("Linear"),))

    def knock() -> None:
        laser._mount = replace(laser._mount, zero_mm=laser._mount.zero_mm + 0.05)

    control = AtStep(9, lambda: control.pause())
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    await door_in_the_pause(b, control, knock)
    await task
    assert statuses(store) == [("test", "aborted"), ("test-2", "failed"), ("test-3", "complete")]
    assert store.runs.all()[-1].start_doc["setup"]["setup_id"] == "S-2"


async def test_a_bar_point_by_point_begins_again_after_the_door_was_open_in_a_pause(place):
    b, store = place
    plan = CampaignPlan("c", (small("HelixPoints"),))
    control = AtStep(step_of(plan, ReadBar, 2) - 1, lambda: control.pause())
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    await door_in_the_pause(b, control, lambda: None)
    await task
    assert statuses(store) == [("test", "aborted"), ("test-2", "complete")]


async def test_a_used_set_up_is_asked_for_after_the_door_was_open_in_a_pause_on_the_path(place):
    b, store = place
    first, second = small("Helix", label="out", unmount=False), small("Helix", label="back", mount=False, direction=-1)
    plan, asked = CampaignPlan("c", (first, second)), list[str]()

    async def confirm(text: str) -> bool:
        asked.append(text)
        return False

    control = InTest(store, 1, number(plan, 1, RecordPath), lambda: asyncio.get_running_loop().call_later(0.02, control.pause))
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control, confirm)))
    await door_in_the_pause(b, control, lambda: None)
    await task
    assert len(asked) == 1
    assert [r.start_doc["setup"]["setup_id"] for r in store.runs.all()] == ["S", "S", "S-2"]


async def test_a_pause_with_the_door_shut_goes_on_where_it_was(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    control = AtStep(9, lambda: control.pause())
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    async for now in control.watch():
        if now.state == State.PAUSED:
            await asyncio.sleep(0.3)
            control.resume()
    await task
    assert statuses(store) == [("test", "complete")]


async def test_a_mirror_whose_count_was_lost_and_whose_axes_were_moved_is_mounted_anew(place):
    b, store = place
    plan = await broken_off(b, store)
    b.sim.world.laser.block(blocked=True)
    b.sim.world.laser.block(blocked=False)
    controller = b.sim.world.controller
    controller.position_mm = controller.position_mm + np.array([3.0, 40.0, 40.0])
    at = len(b.sim.registers.log)
    await resume_all(b, store, plan)
    assert [s for _, s in statuses(store)] == ["failed", "failed", "complete"]
    assert store.runs.all()[1].reason.startswith("SEQ-008: the machine stands")
    assert store.runs.all()[-1].start_doc["setup"]["setup_id"] == "S-2"
    assert [c.kind for c in b.sim.registers.log[at:]][:4] == ["abort", "run", "abort", "run"]  # nothing moved before somebody was asked


async def resume_all(b: Bench, store: Store, plan: CampaignPlan) -> None:
    await going_on(b, store, plan, decline)


# ---- what changed meanwhile ---------------------------------------------------------------------------------------------


async def test_a_table_that_changes_while_a_question_stands_is_found(place):
    b, store = place
    plan = CampaignPlan("c", (small("Helix", label="out", unmount=False), small("Helix", label="back", mount=False, direction=-1)))
    control = InTest(store, 1, 1, lambda: control.stop())
    with pytest.raises(Stopped):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control))
    comp, runs = b.sim.world.controller.comp, len(store.runs.all())

    async def confirm(_: str) -> bool:
        comp.crcs[comp.active] ^= 1
        return True

    with pytest.raises(PreconditionsChanged, match="another compensation table is active"):
        await going_on(b, store, plan, confirm)
    assert len(store.runs.all()) == runs


async def test_a_window_for_the_air_needs_somebody_who_reads_it(place):
    b, store = place
    site, plan = replace(b.site, watching=Watching((10.0, 30.0), air_unknown_s=0.4)), CampaignPlan("c", (small("Helix"),))
    with pytest.raises(ConfigError, match="needs a laser for run_temperature_c"):
        await measure(replace(b.session, laser=None), store, site, plan)

    class Mute:
        name = "laser"

        async def peek(self) -> LaserReading:
            if not b.sim.motions():
                return await b.session.need_laser().peek()  # it answers when it is asked before anything moves
            raise DeviceFault("laser", "read", "no answer", "look at its cable")

    b.sim.pace(5.0)
    with pytest.raises(StatusUnknown, match=r"the laser has not answered for 0\.4 s"):
        await measure(replace(b.session, laser=Mute()), store, site, plan)


def test_a_campaign_whose_journal_names_no_recipe_is_one_line(tmp_path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        campaign = store.campaigns.add(store.machines.add("m", {}), "c", {})
        store.checkpoints.add(campaign, "begun", {"plan": "", "source": {}, "boot_id": 1, "table_crc": 2})
        with pytest.raises(PreconditionsChanged, match="the journal of campaign 'c' does not name its recipe"):
            begun_source(store, "c")


async def test_a_locked_database_delays_the_journal_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "BUSY_TIMEOUT_MS", 500)
    path = tmp_path / "abbe.sqlite3"
    with Store.open(f"sqlite:///{path}") as store:
        campaign = store.campaigns.add(store.machines.add("m", {}), "c", {})
        locked, free = threading.Event(), threading.Event()

        def lock() -> None:
            other = sqlite3.connect(path)
            other.execute("BEGIN IMMEDIATE")
            locked.set()
            free.wait(within(30))
            other.rollback()
            other.close()

        thread = threading.Thread(target=lock)
        thread.start()
        locked.wait(within(10))
        asyncio.get_running_loop().call_later(1.0, free.set)  # longer than the database itself waits
        await StoreJournal(store, campaign).add("point", n=1)
        thread.join()
        assert [c.doc for c in store.checkpoints.of_campaign(campaign)] == [{"n": 1}]


# ---- suspended again and again --------------------------------------------------------------------------------------------


async def test_what_was_done_stays_done_in_the_progress_after_a_suspension(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear", positions=9),))
    door, seen = b.sim.world.controller.set_door, list[Progress]()
    control = AtStep(step_of(plan, MoveTo, 14), lambda: door(is_open=True))
    control.clear = lambda: door(is_open=False)
    site = replace(b.site, watching=Watching(None, SUSPENDING, unknown_s=5.0))
    await measure(b.session, store, site, plan, progress=seen.append, options=MeasureOptions(control))
    assert statuses(store)[-1] == ("test-2", "complete")
    done = [p.done for p in seen]
    assert min(b - a for a, b in pairwise(done)) > -1.0  # back to the last point, not to the beginning
    assert done[-1] == pytest.approx(seen[-1].total, rel=0.02)


async def test_a_test_that_is_suspended_again_and_again_ends(place, monkeypatch):
    b, store = place
    monkeypatch.setattr(campaign_run, "MOST_TRIES", 2)
    plan, door = CampaignPlan("c", (small("Helix"),)), b.sim.world.controller.set_door

    class Always(AtStep):
        def place(self, step: int, steps: int, points: int) -> None:
            self._step, self.done = steps - 1, False  # the path, in what is left of the test, too
            super().place(step, steps, points)

    control = Always(0, lambda: door(is_open=True))
    control.clear = lambda: door(is_open=False)
    site = replace(b.site, watching=Watching(None, Suspending(frozenset({"door"}), 10.0, 0.05), unknown_s=5.0))
    with pytest.raises(DoorOpen, match="3 times in a row without a new point"):
        async with asyncio.timeout(within(30)):
            await measure(b.session, store, site, plan, options=MeasureOptions(control))
    assert len(store.runs.all()) == 3


async def test_an_e_stop_is_told_although_the_journal_cannot_be_ended(place, monkeypatch):
    b, store = place
    monkeypatch.setattr("abbe.service.campaigns.measure.LAST_LINE_S", 0.0)
    add = store.checkpoints.add

    def refuses(campaign: int, kind: str, doc: dict) -> int:
        if kind == "ended":
            raise store_error()
        return add(campaign, kind, doc)

    def store_error() -> Exception:
        from abbe.service.errors import StoreError

        return StoreError("database is locked")

    monkeypatch.setattr(store.checkpoints, "add", refuses)
    control = AtStep(9, lambda: b.sim.world.controller.set_estop(pressed=True))
    with pytest.raises(EstopPressed) as told:
        await measure(b.session, store, b.site, CampaignPlan("c", (small("Linear"),)), options=MeasureOptions(control))
    assert any("last line could not be written" in note for note in told.value.__notes__)
