"""A rollback that a person orders: who may, when it is refused, once for each key, and how it ended by the push journal, not by hearsay.

Mutations that were seen to be caught: no question of rights, no comparison with the table that was seen, the word of what was heard in
place of the journal's.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.tables import crc32
from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, RollBack, StartJob
from abbe.service.compensation.rollback import RollbackOrder
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import OrderActions, OrderContext, Orders, may
from abbe.service.domain.people import Permission, Role
from abbe.service.domain.progress import JobOutcome, JobState
from abbe.service.domain.push_entry import PushState, S
from abbe.service.errors import StoreError
from abbe.service.scheduler.loop import Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import KIND, JournalView
from abbe.service.users.people import Passwords, UserAccounts
from tests.patience import within
from tests.pretended_push import KEPT, TAKEN_BACK, UP_TO_ACTIVE, as_if_pushed
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, fake_checks, settle, utc

MACHINE, OLD, NEW, OTHER = "mill-7", b"the old one", b"the new one", b"another one"


@dataclass
class Bench:
    """A real store, book, scheduler and audit; what brings a table back writes into the journal what it is told to."""

    store: Store
    audit: AuditBook
    clock: FakeClock = field(default_factory=lambda: FakeClock(utc(2026, 6, 1, 12)))
    orders_seen: list[RollbackOrder] = field(default_factory=list)
    states: tuple[PushState, ...] = KEPT
    said: JobOutcome | Exception = field(default_factory=lambda: JobOutcome("kept", "push 2"))
    may_end: asyncio.Event = field(default_factory=asyncio.Event)
    written: asyncio.Event = field(default_factory=asyncio.Event)
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        async def allowed(who: str) -> bool:
            return who == "user:ann"

        async def anybody(_: str, *_need: Permission) -> bool:
            return True

        self.book = JobRegistry(fake_checks(self.check), ("quick-check",), anybody, self.clock, self.news.set)
        self.scheduler = Scheduler([], FakeLedger(), self.book, FakeShelf(), self.clock)
        self.context = OrderContext(MACHINE, allowed, self.audit)
        self.orders = Orders(self.store, self.clock, self.book, self.context, OrderActions(self.ordered_rollback))

    async def check(self, schedule: object, slot: datetime, control: Control) -> SlotState:
        await self.may_end.wait()
        return SlotState("done: pass", verification=1)

    async def push(self, doc: dict[str, Any], base: bytes, image: bytes, states: tuple[PushState, ...]) -> None:
        """A push in the journal, as far as ``states`` go."""
        await as_if_pushed(self.store, self.clock, MACHINE, doc, (base, image), states)

    async def ordered_rollback(self, order: RollbackOrder) -> JobOutcome:
        self.orders_seen.append(order)
        if self.states:
            await self.push({"kind": KIND, "order": order.request.number, "reason": order.request.reason}, NEW, OLD, self.states)
        self.written.set()
        await order.request.control.unless_stopped(self.may_end.wait())
        if isinstance(self.said, Exception):
            raise self.said
        return self.said

    async def ask(self, who: str = "user:ann", push: int = 1, image: bytes = NEW, reason: str = "worse", key: str = "") -> Answer:
        answer = await self.orders.rollback(RollBack(request=7, push=push, crc=crc32(image), reason=reason, key=key, who=who))
        assert answer.request == 7
        return answer

    async def ended(self) -> JobState:
        """The newest job, once it has ended."""
        self.may_end.set()
        async with asyncio.timeout(within(10)):
            while self.book.latest()[0].ended_utc is None:
                self.news.clear()
                await self.news.wait()
        return self.book.latest()[0]

    def recorded(self) -> list[tuple[str, str, str, str]]:
        return [(r.who, r.action, r.outcome, r.doc["reason"]) for r in self.store.audit.events()]


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        made = Bench(store, AuditBook(store, url))
        async with asyncio.TaskGroup() as tasks:
            made.book.open(made.scheduler, tasks)
            yield made
            await made.book.close()


async def test_it_is_a_job_with_who_and_why_in_the_audit(bench: Bench) -> None:
    await bench.push({"proposal": 4}, OLD, NEW, KEPT)
    answer = await bench.ask()
    assert answer.outcome == "done"
    assert bench.scheduler.take("a check") == "by hand: rollback of push 1"
    done = await bench.ended()
    assert (done.id, done.kind, done.who, done.state) == (answer.job, "rollback", "user:ann", "done: kept")
    (order,) = bench.orders_seen
    assert (order.push, order.crc, order.request.who, order.request.reason) == (1, crc32(NEW), "user:ann", "worse")
    assert bench.recorded() == [("user:ann", "rollback", "begun", "worse"), ("user:ann", "rollback", "kept", "worse")]
    assert bench.audit.verify() == []
    told = JournalView.read(bench.store, MACHINE).history()
    assert (told.now.crc, told.now.how, told.now.push) == (crc32(OLD), "ordered", 2)
    assert (told.pushes[0].why, told.pushes[1].proposal) == ("worse", 4)
    assert (told.pushes[1].word, told.pushes[1].text) == ("kept", "better")  # and not that it is in force: it is not any more
    assert (await bench.ask(push=2, image=OLD)).text.startswith("the last kept push (2) was itself a rollback")


@pytest.mark.parametrize(
    ("states", "said", "state", "text"),
    [
        (KEPT, StoreError("the disk is full"), "done: kept", "the table ordered back is kept and in force"),
        (TAKEN_BACK, JobOutcome("kept", "all is well"), "done: rolled back", "the table from before the order is in force again"),
        (UP_TO_ACTIVE, JobOutcome("kept", "all is well"), "done: open", "an unverified table may be in force"),
        ((*UP_TO_ACTIVE[:4], S.ABORTED), OSError("the cable"), "done: failed", "the cable"),
        ((), JobOutcome("kept", "all is well"), "done: failed", "all is well"),
        ((), JobOutcome("refused", "door open"), "done: refused", "door open"),
        ((), ExceptionGroup("watched side by side", [OSError("the cable"), OSError("the other")]), "done: failed", "the cable"),
    ],
)
async def test_the_word_is_the_journal_s(
    bench: Bench, states: tuple[PushState, ...], said: JobOutcome | Exception, state: str, text: str
) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    bench.states, bench.said = states, said
    assert (await bench.ask()).outcome == "done"
    done = await bench.ended()
    assert (done.state, text in done.text) == (state, True), done.text
    assert bench.recorded()[-1][2] == state.removeprefix("done: ")
    assert bench.scheduler.take("next") == ""
    bench.scheduler.give_back()


async def test_what_is_refused_is_one_line_and_nothing_is_begun(bench: Bench) -> None:
    assert "nothing to roll back" in (await bench.ask()).text
    await bench.push({}, OLD, OTHER, TAKEN_BACK)
    assert "no push of this machine was kept" in (await bench.ask()).text
    await bench.push({}, OLD, NEW, KEPT)
    assert (await bench.ask("user:eve", push=2)).outcome == "forbidden"
    for push, image in ((1, NEW), (2, OLD)):  # not what is in force
        answer = await bench.ask(push=push, image=image)
        assert (answer.outcome, "another table has come into force meanwhile" in answer.text) == ("conflict", True)
    await bench.push({}, NEW, OTHER, UP_TO_ACTIVE)
    answer = await bench.ask(push=2)
    assert (answer.outcome, answer.text.split(":")[0]) == ("conflict", "the table in force is not known")
    assert JournalView.read(bench.store, MACHINE).history().now.crc is None
    assert (bench.orders_seen, bench.book.latest(), bench.recorded()) == ([], (), [])


async def test_nothing_comes_between_two_jobs(bench: Bench) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    assert (await bench.book.start(StartJob(request=1, recipe="quick-check", key="", who="user:bob", alarm=0, resume=""))).outcome == "done"
    await settle()
    answer = await bench.ask()
    assert (answer.outcome, answer.text) == ("busy", "the machine is in use: quick-check")
    await bench.ended()
    await settle()
    bench.scheduler.take("recovery of an interrupted run or push")
    assert (await bench.ask()).outcome == "busy"
    bench.scheduler.give_back()
    assert (await bench.ask()).outcome == "done"
    await bench.ended()


async def test_the_same_key_is_one_order(bench: Bench) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    first = await bench.ask(key="k")
    again = await bench.ask(key="k")
    assert (again.outcome, again.job, bool(first.text), bool(again.text)) == ("done", first.job, False, True)
    await bench.ended()
    assert (await bench.ask(key="k")).job == first.job
    assert (await bench.ask(key="k", reason="another")).outcome == "conflict"
    assert len(bench.orders_seen) == 1


async def test_an_end_of_the_service_says_where_it_stands(bench: Bench) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    bench.states = UP_TO_ACTIVE
    assert (await bench.ask()).outcome == "done"
    async with asyncio.timeout(within(10)):
        await bench.written.wait()
    await bench.book.close()
    assert bench.book.latest()[0].state == "interrupted"
    assert [outcome for _, _, outcome, _ in bench.recorded()] == ["begun", "open"]


async def test_what_cannot_be_recorded_is_not_begun(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    monkeypatch.setattr(bench.audit, "write", lambda _: (_ for _ in ()).throw(StoreError("the audit is full")))
    assert (await bench.ask()).outcome == "done"
    done = await bench.ended()
    assert (done.state, bench.orders_seen) == ("done: failed", [])
    assert "the audit is full" in done.text


async def test_a_service_without_a_controller_takes_no_order(bench: Bench) -> None:
    await bench.push({}, OLD, NEW, KEPT)
    bench.orders = Orders(bench.store, bench.clock, bench.book, bench.context, OrderActions())
    assert (await bench.ask()).outcome == "conflict"


def test_who_may_is_who_may_approve_today(tmp_path: Path) -> None:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        people = UserAccounts(store, FakeClock(utc(2026, 6, 1, 12)), Passwords(memory_kib=64, passes=1))
        for role in Role:
            people.add(f"a-{role}", role, "correct horse battery staple")
            assert may(store, f"user:a-{role}", Permission.APPROVE) == (role == Role.APPROVER)
        people.disable("a-approver")
        assert not may(store, "user:a-approver", Permission.APPROVE)
