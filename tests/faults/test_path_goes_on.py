"""A path with the ball-bar that is broken off goes on where it was, if nothing speaks against it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.errors import Rebooted
from abbe.service.campaign_data.campaign_checks import time_issues
from abbe.service.campaigns.campaign_run import decline
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.domain.measured import RunRecord
from abbe.service.domain.run import Run
from abbe.service.errors import Interlock
from abbe.service.runs.columns import load_run
from abbe.service.runs.exchange import export_folder, import_folder
from abbe.service.sequences.control import State, Suspending, Watching
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.storage.store import Store
from tests.faults.sequencer_world import MACHINE, After, Bench, bench

SPEED = 100.0
FEED = 4500.0
LONG_S = 2.0 * np.pi * 60.0 * 3.0 / (FEED / 60.0)


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(SPEED)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


def helix() -> CampaignPlan:
    """About 15 s of path."""
    one = Helix("test", "S", "identify", (300.0, 250.0, 100.0), 60.0, turns=3.0, chord_mm=3.0, feed_mm_min=FEED, rate_hz=200)
    return CampaignPlan("c", (one.plan(MACHINE),))


async def yes(_: str) -> bool:
    return True


def estop(b: Bench) -> Callable[[], None]:
    return lambda: b.sim.world.controller.set_estop(pressed=True)


def freed(b: Bench) -> None:
    b.sim.world.controller.set_estop(pressed=False)
    b.sim.world.controller.reset_alarm()


async def broken(b: Bench, store: Store, plan: CampaignPlan, after_s: float) -> None:
    with pytest.raises(Interlock):
        await measure(b.session, store, b.site, plan, options=MeasureOptions(After(plan, b, after_s, estop(b))))
    b.sim.pace(SPEED)
    freed(b)


async def resumed_item(b: Bench, store: Store, plan: CampaignPlan, confirm=yes, *, again_s: float | None = None) -> str:
    """Resume; broken off once more after some seconds, if said. Gives what was said last."""
    found = await resume(b.session, store, b.site, plan, plan.name, confirm)
    control = None if again_s is None else After(plan, b, again_s, estop(b), step=1)
    try:
        await measure(b.session, store, b.site, plan, options=MeasureOptions(control, confirm, None, found))
    except Interlock:
        assert again_s is not None
        freed(b)
    b.sim.pace(SPEED)
    return found.messages[-1]


def runs(store: Store) -> list[RunRecord]:
    return store.runs.all(store.campaigns.all()[-1].id)


def about_centre(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Arc-ordered positions, and readings without cup and length: what is left is the machine."""
    at, deviation = run.columns.q_mm, run.columns.readings_mm
    out = at - run.bar.centre_mm
    known = np.column_stack([out / np.linalg.norm(out, axis=1)[:, None], np.ones(len(out))])
    return at, deviation - known @ np.linalg.lstsq(known, deviation, rcond=None)[0]


async def test_broken_twice_it_reads_what_it_reads_in_one_go(place):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 6.0)
    said = await resumed_item(b, store, plan, again_s=4.0)
    assert "test resumes at" in said
    await resumed_item(b, store, plan)
    assert [r.status for r in runs(store)] == ["failed", "failed", "complete"]
    assert {r.start_doc["setup"]["setup_id"] for r in runs(store)} == {"S"}
    pieces = load_run(store, runs(store)[-1].id)
    assert [p.run for p in pieces.timing.pieces] == ["test", "test-2"]
    assert np.array_equal(load_run(store, runs(store)[-1].id, full=False).columns.t_s, pieces.columns.t_s)
    whole_plan = replace(plan, name="whole")
    (whole_id,) = await measure(b.session, store, b.site, whole_plan)
    whole = load_run(store, whole_id)
    at, machine = about_centre(pieces)
    at_whole, machine_whole = about_centre(whole)
    assert abs(len(at) - len(at_whole)) <= 4  # one reading may fall out at each seam
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))))
    arc_whole = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(at_whole, axis=0), axis=1))))
    assert np.diff(arc).max() < 3.0 * FEED / 60.0 / 200.0  # no hole, nothing twice
    assert arc[-1] == pytest.approx(arc_whole[-1], abs=0.6)
    off = machine - np.interp(arc, arc_whole, machine_whole)
    tenths = [chunk.mean() for chunk in np.array_split(off, 10)]
    noise = np.std(np.diff(machine_whole)) / np.sqrt(2.0)
    assert np.abs(machine_whole).max() > 5e-3  # there is something to be read
    assert np.abs(tenths).max() < 5.0 * noise * np.sqrt(2.0 / (len(off) / 10))
    assert (np.diff(pieces.columns.t_s) > 0.0).all()


async def test_a_bar_that_was_out_of_range_goes_on_before_that(place):
    b, store = place
    plan = helix()
    with pytest.raises(Interlock):
        await measure(
            b.session, store, b.site, plan, options=MeasureOptions(After(plan, b, 6.0, lambda: b.sim.world.ballbar.push(out=True)))
        )
    b.sim.pace(SPEED)
    b.sim.world.ballbar.push(out=False)
    assert "test resumes at" in await resumed_item(b, store, plan)
    assert load_run(store, runs(store)[-1].id).columns.valid.all()


async def test_going_on_costs_a_stretch_and_not_the_path(place):
    b, store = place
    plan = helix()
    b.sim.pace(SPEED / 5.0)  # what the computer is late by counts as path: at full speed a tenth of a second is ten
    await broken(b, store, plan, 10.0)
    await resumed_item(b, store, plan)
    last = runs(store)[-1]
    driven_s = (last.end_doc["path_end_us"] - last.end_doc["path_start_us"]) * 1e-6
    assert driven_s < LONG_S - 10.0 + 3.0


async def test_nobody_vouches_and_it_begins_again(place):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 6.0)
    said = await resumed_item(b, store, plan, decline)
    assert said.endswith("test begins again")
    assert "pieces" not in runs(store)[-1].start_doc["path"]
    assert [r.status for r in runs(store)] == ["failed", "complete"]


async def test_a_knocked_cup_is_seen_on_the_stretch_and_nothing_is_joined(place):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 6.0)
    bar = b.sim.world.ballbar
    outwards = b.sim.world.controller.position_mm - np.array([300.0, 250.0, 100.0])
    bar._cup_mm = bar._cup_mm + 0.004 * outwards / np.linalg.norm(outwards)
    assert "test resumes at" in await resumed_item(b, store, plan)
    assert [r.status for r in runs(store)] == ["failed", "failed", "complete"]
    assert "off its value before the interruption" in runs(store)[1].reason
    assert {r.start_doc["setup"]["setup_id"] for r in runs(store)} == {"S"}  # nothing is kept that the cup could contradict
    assert "pieces" not in runs(store)[-1].start_doc["path"]


async def test_a_box_restarted_in_a_pause_is_joined_to_nothing(place):
    b, store = place
    plan = helix()
    control = After(plan, b, 6.0, lambda: control.pause())
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control, yes)))
    async for now in control.watch():
        if now.state == State.PAUSED:
            b.sim.box.restart(0xBA12)
            b.sim.pace(SPEED)
            control.resume()
            break
    with pytest.raises(Rebooted):
        await task
    assert "pieces" not in runs(store)[-1].start_doc["path"] or runs(store)[-1].status != "complete"
    await b.session.need_ballbar().identify()
    assert (await resumed_item(b, store, plan)).endswith("test begins again")


async def test_a_pause_on_the_path_costs_a_stretch(place):
    b, store = place
    plan = helix()
    control = After(plan, b, 6.0, lambda: control.pause())
    task = asyncio.create_task(measure(b.session, store, b.site, plan, options=MeasureOptions(control)))
    async for now in control.watch():
        if now.state == State.PAUSED:
            b.sim.pace(SPEED)
            control.resume()
    await task
    assert [r.status for r in runs(store)] == ["aborted", "complete"]
    assert len(runs(store)[-1].start_doc["path"]["pieces"]) == 1
    assert abs(runs(store)[-1].end_doc["stretch_off_nm"]) < 1000


async def test_what_was_read_in_pieces_is_exported_once_and_solved(place, tmp_path):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 6.0)
    await resumed_item(b, store, plan)
    folder = export_folder(store, plan.name, tmp_path / "out")
    with Store.open(f"sqlite:///{tmp_path / 'other.sqlite3'}") as other:
        again = import_folder(other, folder)
        (record,) = other.runs.all(again)
        ours, theirs = load_run(store, runs(store)[-1].id), load_run(other, record.id)
    assert theirs.columns.equals(ours.columns)
    assert theirs.timing == ours.timing
    assert not time_issues([theirs])  # a pause of any length is not a wrong clock
    later = ours.columns.t_s + 3600.0 * (np.arange(len(ours.columns)) >= ours.timing.pieces[0].readings)
    assert not time_issues([replace(ours, columns=replace(ours.columns, t_s=later))])


async def test_a_box_that_was_restarted_begins_again(place):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 6.0)
    b.sim.box.restart(0xBA11)
    await b.session.need_ballbar().identify()  # as the next process does
    said = await resumed_item(b, store, plan)
    assert said.endswith("test begins again")
    assert runs(store)[-1].status == "complete"


async def test_what_has_hardly_begun_begins_again(place):
    b, store = place
    plan = helix()
    await broken(b, store, plan, 0.3)
    assert (await resumed_item(b, store, plan)).endswith("test begins again")


async def test_a_door_that_somebody_vouches_for_suspends_and_the_path_goes_on(place):
    b, store = place
    plan = helix()
    site = replace(b.site, watching=Watching(None, Suspending(frozenset({"door"}), longest_s=20.0, settle_s=0.05), unknown_s=5.0))
    door = b.sim.world.controller.set_door
    control = After(plan, b, 6.0, lambda: door(is_open=True))
    control.clear = lambda: door(is_open=False)
    await measure(b.session, store, site, plan, options=MeasureOptions(control, yes))
    assert [r.status for r in runs(store)] == ["failed", "complete"]
    assert len(runs(store)[-1].start_doc["path"]["pieces"]) == 1
