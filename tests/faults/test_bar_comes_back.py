"""The ball-bar's cable is pulled in the middle of a campaign and plugged in again: the same process goes on, and nothing is joined."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.errors import DriverError, LinkDown, Rebooted, WrongDevice
from abbe.service.campaigns.campaign_run import MOST_BREAKS, BarBreaks
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.capture.recovery import ledger_of
from abbe.service.errors import RunInterrupted, Stopped
from abbe.service.runs.chunks import decode_bar
from abbe.service.sequences.control import Control, State, Suspending, Watching
from abbe.service.sequences.journal import HAND, INCIDENT, NoJournal
from abbe.service.sequences.runner import Runner
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.storage.store import Store
from abbe.simulators.ballbar.wire import WITH_SETTINGS_BCD
from tests.faults.sequencer_world import After, Bench, bench, small
from tests.faults.serial_rig import stage

SPEED = 30.0
GOES_ON = Suspending(frozenset({"ballbar"}), longest_s=20.0, settle_s=0.05)
PLAN = CampaignPlan("c", (small("Helix"),))
ZERO_MM = 0.25


class Hand:
    """Somebody who pulls the cable while a path runs, and plugs it in again; the box comes back with another zero."""

    def __init__(self, b: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
        self._b, self._tasks = b, set[asyncio.Task[Any]]()
        monkeypatch.setattr(b.sim.world.ballbar, "forget_settings", lambda: b.sim.world.ballbar.switch(zero_mm=ZERO_MM))
        self.boots = [b.sim.box._boot_id]

    def pull(self, plug_s: float | None) -> None:
        async def work() -> None:
            await self._b.sim.unplug()
            self.boots.append(self._b.sim.box._boot_id)
            self._b.sim.pace(SPEED)
            if plug_s is not None:
                await asyncio.sleep(plug_s)
                await self._b.sim.plug()

        self._tasks.add(asyncio.get_running_loop().create_task(work()))


@pytest.fixture
async def place(tmp_path: Path) -> AsyncIterator[tuple[Bench, Store]]:
    async with bench(tmp_path) as b:
        b.sim.box._firmware, b.sim.world.ballbar.tells_settings = WITH_SETTINGS_BCD, True
        await b.session.ballbar.identify()
        b.sim.pace(SPEED)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


async def yes(_: str) -> bool:
    return True


def pulled_on_the_path(b: Bench, hand: Hand, plug_s: float | None) -> After:
    """Pulls once the axes move on the path, which they do only when the bar has been read."""
    return After(PLAN, b, 3.0, lambda: hand.pull(plug_s))


def whole(store: Store, run_id: int) -> list[int]:
    """Sequence numbers of a run's stream, which begins at 0 and has none twice and none unaccounted."""
    chunks = store.chunks.of_run(run_id)
    ledger = ledger_of(chunks)
    assert (ledger.unaccounted(), ledger.duplicates()) == ([], 0)
    return [sample.seq for chunk in chunks if chunk.channel == "bar" for sample in decode_bar(chunk.payload)]


async def test_the_cable_is_pulled_and_put_back_and_the_test_begins_again(place, monkeypatch) -> None:
    b, store = place
    hand = Hand(b, monkeypatch)
    before = b.session.ballbar.settings
    site = replace(b.site, watching=Watching(None, GOES_ON, unknown_s=5.0))
    (run_id,) = await measure(b.session, store, site, PLAN, options=MeasureOptions(pulled_on_the_path(b, hand, 0.3), yes))
    broken, complete = store.runs.all()
    assert [(one.label, one.status) for one in (broken, complete)] == [("test", "failed"), ("test-2", "complete")]
    assert broken.reason.startswith("DRV-002")
    assert run_id == complete.id
    assert len(set(hand.boots)) == 2
    assert b.session.ballbar.settings.zero_nm == before.zero_nm == 0 != round(1e6 * ZERO_MM)
    first, second = whole(store, broken.id), whole(store, complete.id)
    assert first[0] == second[0] == 0
    assert second[-1] > first[-1]
    assert ledger_of(store.chunks.of_run(broken.id)).gaps[-1].last is None, "how many samples were cut off nobody knows, and that is said"
    journal = store.checkpoints.of_campaign(complete.campaign_id)
    asked = [one.doc["what"] for one in journal if one.kind == HAND and one.doc["phase"] == "asked"]
    assert asked.count("MountBar") == 1, "nothing was complete on this set-up: it stays as it is"
    found = [(one.doc["phase"], one.doc["code"], one.doc["run"]) for one in journal if one.kind == INCIDENT]
    assert found[0] == ("detected", "DRV-002", f"run {broken.id} test")
    assert [phase for phase, *_ in found] == ["detected", "outcome"] * (len(found) // 2)
    assert "DRV-008" in {code for _, code, _ in found}


async def test_without_the_option_it_ends_and_goes_on_in_the_same_session(place, monkeypatch) -> None:
    b, store = place
    hand = Hand(b, monkeypatch)
    with pytest.raises(LinkDown):
        await measure(b.session, store, b.site, PLAN, options=MeasureOptions(pulled_on_the_path(b, hand, None), yes))
    await b.sim.plug()
    found = await resume(b.session, store, b.site, PLAN, "c", yes)
    (run_id,) = await measure(b.session, store, b.site, PLAN, options=MeasureOptions(None, yes, None, found))
    assert [(one.label, one.status) for one in store.runs.all()] == [("test", "failed"), ("test-2", "complete")]
    assert whole(store, run_id)[0] == 0
    assert b.session.ballbar.settings.zero_nm == 0


async def test_whoever_waits_for_the_box_can_be_stopped(place, monkeypatch) -> None:
    b, store = place
    hand = Hand(b, monkeypatch)
    site = replace(b.site, watching=Watching(None, GOES_ON, unknown_s=5.0))
    control = pulled_on_the_path(b, hand, None)
    task = asyncio.create_task(measure(b.session, store, site, PLAN, options=MeasureOptions(control, yes)))
    async for now in control.watch():
        if now.state == State.SUSPENDED:
            assert "the device is gone" in now.why
            control.stop()
    with pytest.raises(Stopped):
        await task
    assert [one.status for one in store.runs.all()] == ["failed"]


class Back:
    """A box that is always back at once."""

    name = "bar"

    def __init__(self) -> None:
        self.asked = 0

    async def make_ready(self, *, within_s: float) -> None:
        self.asked += 1


@pytest.mark.parametrize(
    ("error", "conditions"),
    [
        (LinkDown("another device", "read", "gone"), {"ballbar"}),
        (WrongDevice("bar", "identify", "another box"), {"ballbar"}),
        (LinkDown("bar", "read", "gone"), {"door"}),
    ],
)
async def test_what_is_not_waited_for(error: DriverError, conditions: set[str]) -> None:
    bar = Back()
    session: Any = SimpleNamespace(ballbar=bar)
    breaks = BarBreaks(session, Control(), Suspending(frozenset(conditions)))
    await breaks.wait(error, Runner(session), NoJournal())
    assert bar.asked == 0


async def test_a_box_that_is_lost_again_and_again_is_left_to_a_person() -> None:
    bar = Back()
    session: Any = SimpleNamespace(ballbar=bar)
    breaks = BarBreaks(session, Control(), GOES_ON)
    for _ in range(MOST_BREAKS):
        runner = Runner(session)
        with pytest.raises(RunInterrupted, match="was lost and restored"):
            await breaks.wait(Rebooted("bar", "stream", "anew"), runner, NoJournal())
        assert runner.touched
    await breaks.wait(Rebooted("bar", "stream", "anew"), Runner(session), NoJournal())
    assert bar.asked == MOST_BREAKS


async def test_a_box_that_does_not_tell_its_settings_is_not_gone_on_with_after_a_restart(tmp_path: Path) -> None:
    async with stage(tmp_path, "S6", "firmware 1.0", firmware=0x0100) as on:
        bar: SerialBallBar = on.bar
        await bar.make_ready(within_s=1.0)
        await bar.make_ready(within_s=1.0)  # nothing happened to it: nothing to refuse
        on.box.reboot()
        for _ in range(2):  # and it stays refused until somebody identifies it
            with pytest.raises(Rebooted):
                await bar.make_ready(within_s=1.0)
        await bar.identify()
        await bar.make_ready(within_s=1.0)
