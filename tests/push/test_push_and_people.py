"""What happens around a push that is on its way, on a simulated controller's real socket.

Time runs out, another takes the lease, axes move, and what was refused happens later.
"""

from __future__ import annotations

import asyncio
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from abbe.service.clock import SystemClock
from abbe.service.compensation.pushing import RECHECK_S, Pushing, Questions, WantedTable
from abbe.service.compensation.recover import recover
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import PushNotBegun, StillActive, TableMismatch
from abbe.service.push.execute import BEAT_S, ControllerPort, no_actors
from abbe.service.push.operations import Done, Operation, OperationKind, VerificationResult
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from abbe.simulators.cnc.compensation import CompResult
from tests.faults.sequencer_world import Bench, bench
from tests.push.test_bad_tables_on_the_wire import kept, never, tables

OTHER = 0x00990001


class Jumping(SystemClock):
    """A clock that somebody sets forward, and whose naps between two renewals of a lease are short."""

    ahead_s = 0.0

    def monotonic_s(self) -> float:
        return super().monotonic_s() + self.ahead_s

    def utc(self) -> datetime:
        return super().utc() + timedelta(seconds=self.ahead_s)

    async def sleep(self, s: float) -> None:
        await super().sleep(0.02 if s == BEAT_S else s)


@pytest.fixture
async def machine(tmp_path: Path):
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


async def brought(b: Bench, store: Store, clock: Jumping, questions: Questions) -> Any:
    wanted = WantedTable(tables(), await read_base(b.session.controller), 100, None, {})
    return await Pushing(b.session.controller, store, b.site, clock).bring(wanted, questions)


@pytest.mark.parametrize(("late_s", "activated"), [(3500.0, True), (3601.0, False)])
async def test_who_orders_a_push_approves_it_for_an_hour_and_not_for_longer(machine, late_s: float, activated: bool) -> None:
    b, store = machine
    clock, honest = Jumping(), b.sim.registers.write

    def write(address: int, values: list[int]) -> bool:
        clock.ahead_s = late_s  # the first request that writes comes right after the approval
        return bool(honest(address, values))

    b.sim.registers.write = write
    if activated:
        assert (await brought(b, store, clock, Questions(list, "a test", kept, kept))).kept
        return
    with pytest.raises(PushNotBegun, match="the approval has expired"):
        await brought(b, store, clock, Questions(list, "a test", never, never))
    assert PushState.ACTIVATING not in {entry.state for entry in store.pushes.entries(b.site.name)}


async def test_a_measurement_ends_when_another_takes_the_lease_and_its_table_is_not_kept(machine) -> None:
    b, store = machine
    comp, ended = b.sim.world.controller.comp, []

    async def taken() -> VerificationResult:
        comp._owner = OTHER
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            ended.append("in time")
            raise
        return VerificationResult(True, "measured to its end under another's lease")

    with pytest.raises(StillActive, match="another owner has the lease"):
        await brought(b, store, Jumping(), Questions(list, "a test", kept, taken))
    entries = store.pushes.entries(b.site.name)
    assert ended == ["in time"]
    assert entries[-1].state is PushState.ROLLBACK_PENDING
    assert next(e for e in entries if e.state is PushState.ROLLBACK).doc["why"] == "verify: another owner took the lease meanwhile"


@pytest.mark.parametrize("does_it", [True, False])
async def test_a_control_that_refuses_an_activation_and_does_it_later_is_found(machine, does_it: bool) -> None:
    b, store = machine
    comp, refused = b.sim.world.controller.comp, []

    def refuse(number: int, owner: int, expected: tuple[int, int], **_: Any) -> CompResult:
        refused.append(number)
        return CompResult.INTERLOCK

    class Waiting(Jumping):
        async def sleep(self, s: float) -> None:
            if s == RECHECK_S and does_it:  # the push has been given up; what was refused happens now
                comp.active, comp.generation = refused[0], comp.generation + 1
            await super().sleep(0.0 if s == RECHECK_S else s)

    comp.activate = refuse
    questions = Questions(list, "a test", never, never)
    if not does_it:
        with pytest.raises(PushNotBegun, match="interlock"):
            await brought(b, store, Waiting(), questions)
        assert await recover(b.session.controller, store, b.site) is None
        assert b.site.name in store.machines.names()  # as it is described now, also where nothing was pushed
        return
    with pytest.raises(TableMismatch, match=r"made the table of this push active.*STILL ACTIVE"):
        await brought(b, store, Waiting(), questions)
    with pytest.raises(TableMismatch, match="never verified"):  # and every later command refuses it
        await recover(b.session.controller, store, b.site)


async def test_moving_axes_and_an_open_door_reach_the_push_as_not_safe(machine) -> None:
    b, _ = machine
    port = ControllerPort(b.session.controller, no_actors(), SystemClock())

    async def unsafe() -> str:
        looked = await port.execute(Operation(OperationKind.LOOK), ())
        assert isinstance(looked, Done), looked
        return str(looked.value.unsafe)

    assert await unsafe() == ""
    b.sim.world.controller.set_door(is_open=True)
    assert await unsafe() == "the door is open"
    b.sim.make_ready()
    b.sim.pace(0.001)  # a move that takes its time
    moving = asyncio.create_task(b.session.controller.move((300.0, 250.0, 100.0), feed_mm_min=1000.0, timeout_s=60.0))
    said = ""
    for _ in range(200):  # looks, until the command has reached the control
        said = said or await unsafe()
    assert said == "the axes move"
    b.sim.pace(1000.0)
    await moving
    assert await unsafe() == ""
