"""Suspensions that end by themselves, and everything that keeps a campaign from going on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.service.campaigns.campaign_run import Resumed, decline
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.domain.progress import Progress
from abbe.service.errors import DoorOpen, EstopPressed, Interlock, PreconditionsChanged, Stopped, TemperatureOutside, UnsafeToMove
from abbe.service.sequences.control import State, Suspending, Watching
from abbe.service.sequences.journal import HAND
from abbe.service.sequences.steps import CampaignPlan, MoveTo, ReadLaser, RecordPath, Unmount
from abbe.service.storage.store import Store
from tests.faults.sequencer_world import AtStep, Bench, bench, small

SPEED = 100.0
SUSPENDING = Suspending(frozenset({"door", "beam", "temperature"}), longest_s=10.0, settle_s=0.05)


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path) as b:
        b.sim.pace(SPEED)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


def step_of(plan: CampaignPlan, kind: type, nth: int = 0) -> int:
    return [k + 1 for k, s in enumerate(plan.tests[0].steps) if isinstance(s, kind)][nth]


def statuses(store: Store) -> list[tuple[str, str]]:
    return [(r.label, r.status) for r in store.runs.all(store.campaigns.all()[-1].id)]


async def yes(_: str) -> bool:
    return True


async def suspended_and_on(
    b: Bench, store: Store, plan: CampaignPlan, step: int, make: Callable[[], None], clear: Callable[[], None]
) -> float:
    """Measure; when it is suspended, clear the condition a moment later. Gives the seconds that it was suspended."""
    site = replace(b.site, watching=Watching(None, SUSPENDING, unknown_s=5.0))
    control = AtStep(step, make)
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(measure(b.session, store, site, plan, options=MeasureOptions(control)))
    began = ended = 0.0
    async for now in control.watch():
        if now.state == State.SUSPENDED and not began:
            began = loop.time()
            loop.call_later(0.3, clear)
        elif began and not ended and now.state == State.RUNNING:
            ended = loop.time()
    await task
    return ended - began


async def test_a_door_suspends_a_laser_run_which_goes_on_after_its_last_point(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    door = b.sim.world.controller.set_door
    waited_s = await suspended_and_on(b, store, plan, step_of(plan, MoveTo, 6), lambda: door(is_open=True), lambda: door(is_open=False))
    assert waited_s > 0.3
    assert statuses(store) == [("test", "failed"), ("test-2", "complete")]
    first, second = store.runs.all(store.campaigns.all()[-1].id)
    points = [c.doc for c in store.checkpoints.of_campaign(first.campaign_id) if c.kind == "point"]
    kept = max(p["points"] for p in points if p["run"] == first.id)
    assert min(p["points"] for p in points if p["run"] == second.id) == kept + 1  # nothing was measured twice


async def test_a_door_suspends_a_helix_which_is_measured_again_in_the_same_mounting(place):
    b, store = place
    plan = CampaignPlan("c", (small("Helix"),))
    door = b.sim.world.controller.set_door
    await suspended_and_on(b, store, plan, step_of(plan, RecordPath), lambda: door(is_open=True), lambda: door(is_open=False))
    assert statuses(store) == [("test", "failed"), ("test-2", "complete")]
    setups = {r.start_doc["setup"]["setup_id"] for r in store.runs.all(store.campaigns.all()[-1].id)}
    assert setups == {"S"}
    asked = [
        c.doc["what"] for c in store.checkpoints.of_campaign(store.campaigns.all()[-1].id) if c.kind == "hand" and c.doc["phase"] == "asked"
    ]
    assert asked == ["MountBar", "Unmount"]  # nobody was asked twice


async def test_a_broken_beam_costs_the_zero(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    block = b.sim.world.laser.block
    await suspended_and_on(b, store, plan, step_of(plan, ReadLaser, 4), lambda: block(blocked=True), lambda: block(blocked=False))
    (_, failed), (_, complete) = statuses(store)
    assert (failed, complete) == ("failed", "complete")
    run = store.runs.all(store.campaigns.all()[-1].id)[-1]
    points = [c.doc["points"] for c in store.checkpoints.of_campaign(run.campaign_id) if c.kind == "point" and c.doc["run"] == run.id]
    assert min(points) == 1  # from the zero on


@pytest.mark.parametrize("suspending", [Suspending(), Suspending(frozenset({"door"}), longest_s=0.2, settle_s=0.05)])
async def test_what_is_not_configured_or_does_not_clear_ends_the_run(place, suspending):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    control = AtStep(step_of(plan, MoveTo, 5), lambda: b.sim.world.controller.set_door(is_open=True))
    with pytest.raises(DoorOpen):
        await measure(
            b.session, store, replace(b.site, watching=Watching(None, suspending, unknown_s=5.0)), plan, options=MeasureOptions(control)
        )
    assert statuses(store) == [("test", "failed")]
    assert store.runs.all()[-1].reason.startswith("ILK-003: the door is open")


async def test_an_e_stop_never_goes_on_by_itself(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    everything = Suspending(frozenset({"door", "beam", "temperature", "estop", "alarm"}), 10.0, 0.05)
    control = AtStep(step_of(plan, MoveTo, 5), lambda: b.sim.world.controller.set_estop(pressed=True))
    with pytest.raises(EstopPressed):
        await measure(b.session, store, replace(b.site, watching=Watching(None, everything)), plan, options=MeasureOptions(control))


async def test_air_outside_the_window_stops_a_run(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear"),))
    with pytest.raises(TemperatureOutside, match=r"the limits are 30\.\.31 C"):
        await measure(b.session, store, replace(b.site, watching=Watching((30.0, 31.0))), plan)


async def broken_off(b: Bench, store: Store, kind: str = "Linear", step: int = 9) -> CampaignPlan:
    plan = CampaignPlan("c", (small(kind),))
    control = AtStep(step, lambda: b.sim.world.controller.set_estop(pressed=True))
    with pytest.raises(Interlock):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control))
    b.sim.world.controller.set_estop(pressed=False)
    b.sim.world.controller.reset_alarm()
    return plan


async def going_on(b: Bench, store: Store, plan: CampaignPlan, confirm=decline) -> Resumed:
    found = await resume(b.session, store, b.site, plan, "c", confirm)
    await measure(b.session, store, b.site, plan, options=MeasureOptions(confirm=confirm, resumed=found))
    return found


async def test_after_an_e_stop_a_laser_run_goes_on_and_says_so(place):
    b, store = place
    found = await going_on(b, store, await broken_off(b, store))
    assert found.messages[-1].startswith("set-up S is still mounted: test resumes after point")
    assert statuses(store) == [("test", "failed"), ("test-2", "complete")]


async def test_where_nobody_is_asked_every_set_up_is_cleared_away_and_mounted_anew(place):
    b, store = place
    plan = await broken_off(b, store)
    found = await resume(b.session, store, b.site, plan, "c", None)
    assert found.messages[-1].endswith("for test: nobody was asked whether it is untouched")
    (item,) = found.start.values()
    assert [type(step) for step in item.left.steps[:1]] == [Unmount], "what still stands is cleared away before anything moves"
    await measure(b.session, store, b.site, plan, options=MeasureOptions(resumed=found))
    assert statuses(store) == [("test", "failed"), ("test-2", "complete")]
    setups = [run.start_doc["setup"]["setup_id"] for run in store.runs.all(store.campaigns.all()[-1].id)]
    assert setups == ["S", "S-2"]


async def test_a_mirror_that_was_knocked_is_mounted_anew(place):
    b, store = place
    plan = await broken_off(b, store)
    laser = b.sim.world.laser
    laser._mount = replace(laser._mount, zero_mm=laser._mount.zero_mm + 0.05)
    await going_on(b, store, plan)
    last = store.runs.all(store.campaigns.all()[-1].id)[-1]
    assert [s for _, s in statuses(store)] == ["failed", "failed", "complete"]
    assert last.start_doc["setup"]["setup_id"] == "S-2"


async def test_a_lost_count_begins_again_with_a_new_zero(place):
    b, store = place
    plan = await broken_off(b, store)
    b.sim.world.laser.block(blocked=True)
    b.sim.world.laser.block(blocked=False)
    found = await going_on(b, store, plan)
    assert found.messages[-1] == "set-up S is still mounted: test begins again"
    assert statuses(store)[-1] == ("test-2", "complete")


async def test_a_machine_that_was_moved_off_the_path_has_its_bar_mounted_anew(place):
    b, store = place
    plan = CampaignPlan("c", (small("Helix"),))
    control = AtStep(step_of(plan, RecordPath), lambda: asyncio.get_running_loop().call_later(0.02, stop))
    stop = lambda: b.sim.world.controller.set_estop(pressed=True)  # noqa: E731
    with pytest.raises(EstopPressed):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control))
    controller = b.sim.world.controller
    controller.set_estop(pressed=False)
    controller.reset_alarm()
    controller.position_mm = controller.position_mm + 3.0
    await going_on(b, store, plan)
    runs = store.runs.all(store.campaigns.all()[-1].id)
    assert [r.status for r in runs] == ["failed", "failed", "complete"]
    assert runs[1].reason.startswith("SEQ-008: the machine stands")
    assert runs[-1].start_doc["setup"]["setup_id"] == "S-2"


@pytest.mark.parametrize("answer", [True, False])
async def test_a_set_up_with_complete_runs_is_used_only_if_somebody_vouches_for_it(place, answer):
    b, store = place
    first, second = small("Helix", label="out", unmount=False), small("Helix", label="back", mount=False, direction=-1)
    plan = CampaignPlan("c", (first, second))
    control = AtStep(2, lambda: None)
    seen: list[str] = []

    def progress(p: Progress) -> None:
        if p.message == "out" and p.done > 0.99 * p.total / 2 and not seen:
            seen.append("out")
            control.stop()

    with pytest.raises(Stopped):
        await measure(b.session, store, b.site, plan, progress=progress, options=MeasureOptions(control))
    asked: list[str] = []

    async def confirm(text: str) -> bool:
        asked.append(text)
        return answer

    await going_on(b, store, plan, confirm)
    assert len(asked) == 1
    complete = [r for r in store.runs.all() if r.status == "complete"]
    setups = [r.start_doc["setup"]["setup_id"] for r in complete]
    assert setups == (["S", "S"] if answer else ["S", "S-2"])


async def test_a_changed_world_is_refused_in_one_line(place):
    b, store = place
    plan = await broken_off(b, store)
    other = CampaignPlan("c", (small("Linear", positions=6),))
    with pytest.raises(PreconditionsChanged, match="begun with another recipe"):
        await resume(b.session, store, b.site, other, "c", yes)
    moved = replace(b.site, doc=b.site.doc | {"tool_mm": [0.0, 0.0, -100.0]})
    with pytest.raises(PreconditionsChanged, match="another machine, or the machine file was changed"):
        await resume(b.session, store, moved, plan, "c", yes)
    comp, registers = b.sim.world.controller.comp, b.sim.registers
    crc = comp.crcs[comp.active]
    comp.crcs[comp.active] = crc ^ 1
    with pytest.raises(PreconditionsChanged, match="another compensation table is active"):
        await resume(b.session, store, b.site, plan, "c", yes)
    comp.crcs[comp.active] = crc
    b.sim.world.controller.set_door(is_open=True)
    with pytest.raises(DoorOpen):
        await resume(b.session, store, b.site, plan, "c", yes)
    b.sim.world.controller.set_door(is_open=False)
    registers._boot_id ^= 1
    await b.session.controller.identify()
    with pytest.raises(PreconditionsChanged, match="the controller was restarted since this campaign began"):
        await resume(b.session, store, b.site, plan, "c", yes)
    assert len(statuses(store)) == 1


async def test_a_mounting_without_a_time_in_the_journal_is_refused_in_one_line(place):
    b, store = place
    plan = await broken_off(b, store)
    campaign = store.campaigns.all()[-1].id
    done = next(one.doc for one in store.checkpoints.of_campaign(campaign) if one.kind == HAND and one.doc["what"] == "MountLaser")
    store.checkpoints.add(campaign, HAND, {**done, "phase": "done", "ctrl_us": None})
    with pytest.raises(PreconditionsChanged, match="states no time for the mounting of set-up"):
        await resume(b.session, store, b.site, plan, "c", yes)


async def test_a_campaign_that_somebody_measures_is_left_alone(place):
    b, store = place
    plan = await broken_off(b, store)
    store.runs.start(store.campaigns.all()[-1].id, "other", "laser_linear", "identify", {})
    with pytest.raises(UnsafeToMove, match="is being measured"):
        await resume(b.session, store, b.site, plan, "c", yes)


async def test_waiting_does_not_count_in_the_eta(place):
    b, store = place
    plan = CampaignPlan("c", (small("Linear", positions=9),))
    control = AtStep(step_of(plan, MoveTo, 8), lambda: control.pause())
    seen: list[tuple[Progress, float]] = []
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(
        measure(b.session, store, b.site, plan, progress=lambda p: seen.append((p, loop.time())), options=MeasureOptions(control))
    )
    async for now in control.watch():
        if now.state == State.PAUSED:
            paused_s = loop.time()
            loop.call_later(1.5, control.resume)
    await task
    before = [p for p, t in seen if t < paused_s][-1]
    after = next(p for p, t in seen if t > paused_s + 1.5)
    assert before.eta_s is not None
    assert after.eta_s is not None
    assert after.eta_s < before.eta_s + 0.75  # not by half of what it waited
    assert (after.message, after.state) == ("test", "running")
    assert after.points > 2
