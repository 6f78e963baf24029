"""A push of an approved proposal that a person orders: only of what is approved, and how it ended by the push journal."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, PushNow
from abbe.service.clock import SystemClock
from abbe.service.compensation.approved import PushOrder
from abbe.service.compensation.proposal_decisions import approve
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import OrderActions, OrderContext, Orders
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobOutcome, JobState
from abbe.service.scheduler.loop import Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.storage.store import Store
from tests.pages_world import Filled, Served
from tests.patience import within
from tests.pretended_push import TAKEN_BACK, as_if_pushed
from tests.service.core.fakes import FakeLedger, FakeShelf, fake_checks


@dataclass
class Bench:
    """A copy of the filled store, and orders over it; the push writes into the journal that it was taken back, and says otherwise."""

    store: Store
    audit: AuditBook
    filled: Filled
    clock: SystemClock = field(default_factory=SystemClock)
    pushed: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.news = asyncio.Event()
        self.book = JobRegistry(fake_checks(self.never), (), self.anybody, self.clock, self.news.set)
        self.scheduler = Scheduler([], FakeLedger(), self.book, FakeShelf(), self.clock)
        self.orders = self.with_actions(OrderActions(push=self.push))

    def with_actions(self, actions: OrderActions) -> Orders:
        return Orders(self.store, self.clock, self.book, OrderContext(self.filled.machine, self.anna, self.audit), actions)

    async def never(self, *_: object) -> SlotState:
        raise AssertionError

    async def anybody(self, _: str, *_need: Permission) -> bool:
        return True

    async def anna(self, who: str) -> bool:
        return who == "user:anna"

    async def push(self, order: PushOrder) -> JobOutcome:
        self.pushed.append(order.proposal)
        await as_if_pushed(self.store, self.clock, self.filled.machine, {"proposal": order.proposal}, (b"June", b"July"), TAKEN_BACK)
        return JobOutcome("kept", "all is well")

    async def ask(self, number: int, who: str = "user:anna", key: str = "") -> Answer:
        return await self.orders.push(PushNow(request=1, proposal=number, key=key, who=who))

    async def ended(self) -> JobState:
        async with asyncio.timeout(within(10)):
            while self.book.latest()[0].ended_utc is None:
                self.news.clear()
                await self.news.wait()
        return self.book.latest()[0]


@pytest.fixture
async def bench(running: Served, tmp_path: Path) -> AsyncIterator[Bench]:
    copy = tmp_path / "abbe.sqlite3"
    with closing(sqlite3.connect(running.filled.url.removeprefix("sqlite:///"))) as there, closing(sqlite3.connect(copy)) as here:
        there.backup(here)
    url = f"sqlite:///{copy}"
    with Store.open(url) as store:
        made = Bench(store, AuditBook(store, url), running.filled)
        async with asyncio.TaskGroup() as tasks:
            made.book.open(made.scheduler, tasks)
            yield made
            await made.book.close()


async def test_only_what_is_approved_is_pushed_and_the_journal_has_the_word(bench: Bench) -> None:
    refused, _, number = bench.filled.proposals
    assert (await bench.ask(number, "user:eve")).outcome == "forbidden"
    assert (await bench.ask(999)).outcome == "unknown"
    answer = await bench.ask(refused)
    assert (answer.outcome, answer.text.startswith(f"proposal {refused} is refused")) == ("conflict", True)
    approve(bench.store, number, "anna", 1.0, SystemClock(), "user:anna")
    first = await bench.ask(number, key="k")
    assert first.outcome == "done", first.text
    done = await bench.ended()
    assert (done.kind, done.who, done.state, bench.pushed) == ("push", "user:anna", "done: rolled back", [number])
    assert (await bench.ask(number, key="k")).job == first.job
    assert (await bench.ask(number)).text.startswith(f"proposal {number} is rolled back")
    told = [(r.who, r.action, r.outcome, r.doc["proposal"]) for r in bench.store.audit.events(2)]
    assert told == [("user:anna", "push", "begun", number), ("user:anna", "push", "rolled back", number)]


async def test_a_service_that_pushes_by_itself_takes_no_order(bench: Bench) -> None:
    bench.orders = bench.with_actions(OrderActions())
    answer = await bench.ask(bench.filled.proposals[2])
    assert (answer.outcome, "by itself" in answer.text) == ("conflict", True)
