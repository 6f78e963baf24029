"""No pause holds a push whose table nobody has verified: one of before is heard before anything is written, and none afterwards."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.domain.push_entry import PushState as Push
from abbe.service.errors import Stopped
from abbe.service.push.operations import VerificationResult
from abbe.service.sequences.control import Control, State
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.faults.sequencer_world import Bench, bench
from tests.patience import within
from tests.push.test_bad_tables_on_the_wire import counted, tables


@dataclass
class Told(Pushing):
    """A person asks for a pause while the axes come to rest, and again while the table is proved."""

    paused: list[bool] = field(default_factory=list)

    async def _wait_for_standstill(self) -> None:
        self.ask()
        await super()._wait_for_standstill()

    def ask(self) -> None:
        self.control.pause()
        self.paused.append(self.control.pausing)

    async def question(self) -> VerificationResult:
        self.ask()
        return VerificationResult(True, "a stand-in")


@asynccontextmanager
async def machine(folder: Path) -> AsyncIterator[tuple[Bench, Store, list[int]]]:
    async with bench(folder, seed=3) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
            yield b, store, counted(b.sim.registers)


async def brought(b: Bench, store: Store, control: Control) -> tuple[PushResult, list[bool]]:
    pushing = Told(b.session.controller, store, b.site, control=control)
    wanted = WantedTable(tables(), await read_base(b.session.controller), 100, None, {})
    return await pushing.bring(wanted, Questions(list, "a test", pushing.question, pushing.question)), pushing.paused


async def held(control: Control) -> None:
    async with asyncio.timeout(within(20)):
        async for now in control.watch():
            if now.state == State.PAUSED:
                return


@pytest.mark.timeout(120)
async def test_a_pause_holds_it_before_anything_is_written_or_not_at_all(tmp_path: Path) -> None:
    async with machine(tmp_path) as (b, store, written):
        control = Control()
        control.now(State.RUNNING)
        control.pause()
        task = asyncio.create_task(brought(b, store, control))
        await held(control)
        assert (written, store.pushes.entries(b.site.name)) == ([], [])
        control.resume()
        pushed, paused = await task
        assert (pushed.kept, paused) == (True, [False, False, False])
        assert control.no_pause_reason == ""
        control.pause()
        assert control.pausing, "what comes after it can be paused again"


@pytest.mark.timeout(120)
async def test_a_push_that_is_stopped_in_its_pause_has_written_nothing(tmp_path: Path) -> None:
    async with machine(tmp_path) as (b, store, written):
        control = Control()
        control.now(State.RUNNING)
        control.pause()
        task = asyncio.create_task(brought(b, store, control))
        await held(control)
        control.stop()
        with pytest.raises(Stopped):
            await task
        assert (written, store.pushes.entries(b.site.name), control.no_pause_reason) == ([], [], "")
        assert (await brought(b, store, Control()))[0].kept, "nothing of it is left over"
        assert store.pushes.entries(b.site.name)[-1].state is Push.KEEP
