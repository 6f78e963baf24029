"""Jobs that people start, beside the timetable: one check at a time, rights by the users' table; and what an earlier end left open."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.channel.messages import MOST_JOBS, Answer, StartJob, Steering, SteerJob
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import may
from abbe.service.core.push_recovery import AGAIN_S, LOOK_S, NAME, PushRecovery
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import MachineInUse, StillActive, StoreError
from abbe.service.scheduler.loop import Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.sequences.control import Control, State
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, fake_checks, settle, utc

NOON = utc(2026, 6, 1, 12)
HOURLY = Schedule("hourly", "0 * * * *", "UTC", "verify", grace_s=600.0)


@dataclass
class Bench:
    """A real scheduler and a real book; only the check is a stand-in that lasts as long as it is told."""

    clock: FakeClock = field(default_factory=lambda: FakeClock(NOON))
    ledger: FakeLedger = field(default_factory=FakeLedger)
    shelf: FakeShelf = field(default_factory=FakeShelf)
    allowed: set[str] = field(default_factory=lambda: {"user:bob"})
    ran: list[str] = field(default_factory=list)
    may_end: asyncio.Event = field(default_factory=asyncio.Event)
    changes: int = 0
    numbers: int = 0

    def __post_init__(self) -> None:
        self.book = JobRegistry(fake_checks(self.run), ("quick-check", "verify"), self.may, self.clock, self.changed)
        self.scheduler = Scheduler([HOURLY], self.ledger, self.book, self.shelf, self.clock)

    def changed(self) -> None:
        self.changes += 1

    async def may(self, who: str, need: Permission) -> bool:
        return who in self.allowed or (who, need) == ("user:anna", Permission.STOP)

    async def run(self, schedule: Schedule, slot: datetime, control: Control) -> SlotState:
        control.now(State.RUNNING)
        self.ran.append(schedule.name)
        await control.unless_stopped(self.may_end.wait())
        control.now(State.ENDED)
        return SlotState("done: pass", verification=len(self.ran))

    async def start(self, recipe: str = "quick-check", key: str = "", who: str = "user:bob") -> Answer:
        self.numbers += 1
        answer = await self.book.start(StartJob(request=self.numbers, recipe=recipe, key=key, who=who, alarm=0, resume=""))
        assert answer.request == self.numbers
        await settle()
        return answer

    async def steer(self, job: str, how: Steering, who: str = "user:bob") -> str:
        answer = await self.book.steer(SteerJob(request=1, job=job, how=how, who=who))
        await settle()
        return answer.outcome


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    made = Bench()
    async with asyncio.TaskGroup() as tasks:
        made.book.open(made.scheduler, tasks)
        timetable = tasks.create_task(made.scheduler.run())
        await settle()
        yield made
        timetable.cancel()
        await made.book.close()


async def test_a_slot_waits_for_a_job_by_hand(bench: Bench) -> None:
    await bench.clock.pass_time(3599)
    answer = await bench.start()
    assert (answer.outcome, bench.ran) == ("done", ["by hand"])
    await bench.clock.pass_time(60)
    assert bench.ran == ["by hand"]
    bench.may_end.set()
    await bench.clock.pass_time(60)
    assert bench.ran == ["by hand", "hourly"]
    assert bench.ledger.of("done: pass") == [utc(2026, 6, 1, 13)]
    by_timetable, by_hand = bench.book.latest()
    assert (by_hand.id, by_hand.who, by_hand.schedule, by_hand.state, by_hand.verification) == (answer.job, "user:bob", "", "done: pass", 1)
    assert (by_timetable.who, by_timetable.schedule, by_timetable.verification) == ("", "hourly", 2)


async def test_a_job_by_hand_does_not_come_between(bench: Bench) -> None:
    await bench.clock.pass_time(3601)
    assert bench.ran == ["hourly"]
    refused = await bench.start()
    assert (refused.outcome, refused.text) == ("busy", "the machine is in use: hourly")
    running = bench.book.running
    assert running is not None
    assert await bench.steer(running.id, "pause") == "done"  # that of the timetable can be steered too
    assert bench.book.latest()[0].state == "pausing"
    assert await bench.steer(running.id, "resume") == "done"
    bench.may_end.set()
    await settle()
    assert await bench.steer(running.id, "stop") == "conflict"
    assert (await bench.start()).outcome == "done"


async def test_the_same_key_starts_one_job(bench: Bench) -> None:
    bench.allowed.add("user:ann")
    bench.may_end.set()
    first = await bench.start(key="k")
    assert (await bench.start(key="k")).job == first.job
    assert (await bench.start("verify", key="k")).outcome == "conflict"
    anothers = await bench.start(key="k", who="user:ann")
    assert anothers.job not in {first.job, ""}
    assert bench.ran == ["by hand"] * 2
    assert (await bench.start()).job != (await bench.start()).job  # without a key each request is a new one


async def test_the_core_decides_who_and_what(bench: Bench) -> None:
    assert (await bench.start(who="user:eve")).outcome == "forbidden"
    for recipe in ("rm -rf", "rm -rf at 500 Hz", "quick-check at 300 Hz", "quick-check at 500 Hz at 500 Hz"):
        assert (await bench.start(recipe)).outcome == "unknown"
    job = (await bench.start("quick-check at 500 Hz")).job
    assert bench.book.running is not None
    assert bench.book.running.recipe == "quick-check at 500 Hz"
    assert await bench.steer(job, "stop", "user:eve") == "forbidden"
    assert await bench.steer("0" * 12, "stop") == "unknown"
    assert await bench.steer(job, "pause", "user:anna") == "forbidden"
    assert await bench.steer("0" * 12, "stop", "user:anna") == "unknown", "an approver may stop, not pause"
    bench.allowed.clear()  # meanwhile his role was changed
    assert await bench.steer(job, "stop") == "forbidden"
    await settle()


async def test_old_jobs_are_forgotten_and_after_the_end_none_is_started(bench: Bench) -> None:
    bench.may_end.set()
    first = (await bench.start()).job
    for _ in range(MOST_JOBS):
        await bench.start()
    assert len(bench.book.latest()) == MOST_JOBS
    assert await bench.steer(first, "stop") == "unknown"
    await bench.book.close()
    assert (await bench.start()).outcome == "busy"


async def test_the_end_stops_a_job_by_hand(bench: Bench) -> None:
    job = (await bench.start()).job
    await bench.book.close()
    assert [(seen.id, seen.state) for seen in bench.book.latest()] == [(job, "interrupted")]
    assert bench.scheduler.take("next") == ""
    bench.scheduler.give_back()


def test_rights_are_those_of_the_role_today(tmp_path: Path) -> None:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        people = UserAccounts(store, FakeClock(NOON), Passwords(memory_kib=64, passes=1))
        for role in Role:
            people.add(f"a-{role}", role, "correct horse battery staple")
            for who in (f"user:a-{role}", f"token:a-{role}/ci"):
                assert {need for need in Permission if may(store, who, need)} == ALLOWED[role], who
        strange = store.people.find("a-metrologist")
        assert strange is not None
        store.people.change(strange.id, role="king")
        people.disable("a-operator")
        for who in ("user:a-operator", "user:nobody", "anonymous", "", "a-metrologist", "system:a-metrologist"):
            assert not any(may(store, who, need) for need in Permission), who


class Tries:
    """Recovery that ends as it is told to, one try after the other."""

    def __init__(self, bench: Bench, *ends: Exception | str | None) -> None:
        self.ends, self.attention, self.changes, self.bench = list(ends), ["something else"], 0, bench
        self.open: bool | StoreError = False
        open_ends = PushRecovery(self.one, self.is_open, bench.scheduler, bench.shelf, self.attention, bench.clock, self.changed)
        self.task = asyncio.create_task(open_ends.run())

    async def is_open(self) -> bool:
        if isinstance(self.open, StoreError):
            raise self.open
        return self.open

    async def one(self) -> str | None:
        assert self.bench.scheduler.take("x") == NAME  # the machine is ours meanwhile
        end = self.ends.pop(0)
        self.open = isinstance(end, Exception)
        if isinstance(end, Exception):
            raise end
        return end

    def changed(self) -> None:
        self.changes += 1


async def test_what_is_open_is_told_once_and_until_it_is_closed(bench: Bench) -> None:
    down = LinkDown("modbus+tcp://127.0.0.1:502", "connect", "refused", "is the controller on?")
    active = StillActive("the unverified table of push 3 is still active: door open", "close the door")
    tries = Tries(bench, down, down, MachineInUse("in use"), active, "push 3 was not verified; the old table was made active again")
    await settle()
    for alarms in (1, 1, 1, 2):  # the same reason again is no news, and another process at work is none either
        assert len(bench.shelf.alarms) == alarms
        assert len(tries.attention) == 2
        await bench.clock.pass_time(AGAIN_S)
    tries.task.cancel()
    assert (tries.ends, tries.attention) == ([], ["something else"])
    assert [alarm["code"] for alarm in bench.shelf.alarms] == [down.code, active.code]
    assert "is the controller on?" in bench.shelf.alarms[0]["remedy"]
    assert "door open" in bench.shelf.alarms[1]["what"]


async def test_recovery_waits_while_a_check_runs(bench: Bench) -> None:
    await bench.start()
    tries = Tries(bench, None)
    await bench.clock.pass_time(10)
    assert tries.ends == [None]
    bench.may_end.set()
    await bench.clock.pass_time(10)
    tries.task.cancel()
    assert tries.ends == []


async def test_what_is_left_open_later_is_gone_back_to_as_at_the_start(bench: Bench) -> None:
    """A push of the running service that could not be taken back, and one of another process that was killed."""
    closed = "push 4 was not verified; the old table was made active again"
    active = StillActive("the unverified table of push 4 is still active: door open", "close the door")
    tries = Tries(bench, None, active, active, closed, closed)
    await bench.clock.pass_time(10 * AGAIN_S)
    assert (len(tries.ends), tries.attention) == (4, ["something else"]), "nothing is open: nobody asks the controller"

    await bench.start()  # the push: as long as it has the machine it is open by right
    tries.open = True
    await bench.clock.pass_time(10)
    assert (len(tries.ends), len(tries.attention)) == (4, 1)
    bench.may_end.set()
    await bench.clock.pass_time(LOOK_S)
    assert (len(tries.ends), len(tries.attention)) == (3, 2)
    assert "push 4 is still active: door open - close the door" in tries.attention[1]
    await bench.clock.pass_time(AGAIN_S)
    assert (len(tries.ends), len(tries.attention), len(bench.shelf.alarms)) == (2, 2, 1)
    await bench.clock.pass_time(AGAIN_S)
    assert (len(tries.ends), tries.attention) == (1, ["something else"])

    tries.open = StoreError("the database is locked")  # nobody knows: neither an alarm nor an end of the service
    await bench.clock.pass_time(10 * LOOK_S)
    assert (len(tries.ends), tries.attention) == (1, ["something else"])
    tries.open = True
    await bench.clock.pass_time(LOOK_S)
    assert (tries.ends, len(bench.shelf.alarms)) == ([], 1)
    assert not tries.task.done()
    tries.task.cancel()
