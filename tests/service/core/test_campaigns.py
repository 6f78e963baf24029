"""The full campaign as a job: who may start it, what it asks of people and whose word counts, how it ends. The measurement is pretended.

Mutations that were seen to be caught: an answer without comparison of the number, one that counts twice, no question of rights, the
proposer's name left out.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, ConfirmPrompt, StartJob, Steering, SteerJob
from abbe.service.core.board import Board, SnapshotSource
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import CampaignOrder, OrderContext, full_campaigns
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobOutcome, JobState
from abbe.service.errors import StoreError, TableMismatch
from abbe.service.scheduler.loop import Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.sequences.control import Control, Prompts
from abbe.service.storage.store import Store
from tests.patience import within
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, fake_checks, settle, utc

LED = JobOutcome("proposed", "proposal 4 waits for approval", 7, 4)
BAR, LASER = "hang in the bar", "set up the laser"


@dataclass
class Bench:
    """A real store, book, scheduler, board and audit; the campaign asks for a bar and a laser and ends as it is told to."""

    store: Store
    audit: AuditBook
    clock: FakeClock = field(default_factory=lambda: FakeClock(utc(2026, 6, 1, 12)))
    orders: list[CampaignOrder] = field(default_factory=list)
    end: JobOutcome | BaseException = LED
    notes: tuple[str, ...] = ()
    allowed: set[str] = field(default_factory=lambda: {"token:bob/ci", "user:oscar"})
    proposers: set[str] = field(default_factory=lambda: {"token:bob/ci", "user:pia"})

    news: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        async def may(who: str, *_need: Permission) -> bool:
            return who in self.allowed

        async def may_propose(who: str) -> bool:
            return who in self.proposers

        self.board = Board({}, self.clock)
        self.book = JobRegistry(fake_checks(self.check), ("quick-check",), may, self.clock, self.news.set, [self.board])
        context = OrderContext("mill-7", may, self.audit)
        self.book.full = full_campaigns(context, ("identification", "own.toml"), self.measure, may_propose)
        self.scheduler = Scheduler([], FakeLedger(), self.book, FakeShelf(), self.clock)
        self.snapshots = SnapshotSource(self.board, self.book, list, self.clock)

    async def check(self, schedule: object, slot: datetime, control: Control) -> SlotState:
        raise AssertionError

    async def measure(self, order: CampaignOrder) -> JobOutcome:
        self.orders.append(order)
        self.news.set()
        try:
            for text in (BAR, LASER):
                await order.control.unless_stopped(order.control.prompts.ask(text))
        except BaseException as error:
            for note in self.notes:
                error.add_note(note)
            raise
        if isinstance(self.end, BaseException):
            raise self.end
        return self.end

    async def start(self, recipe: str = "identification", key: str = "", who: str = "token:bob/ci", resume: str = "") -> Answer:
        answer = await self.book.start(StartJob(request=1, recipe=recipe, key=key, who=who, alarm=0, resume=resume))
        if answer.outcome == "done":
            await self.until(lambda: self.book.latest()[0].prompt or self.book.latest()[0].ended_utc is not None)
        return answer

    async def until(self, what: Any) -> None:
        """Look again whenever a job begins, asks or ends."""
        async with asyncio.timeout(within(10)):
            while not what():
                self.news.clear()
                await self.news.wait()
                await settle()

    async def done(self, job: str, prompt: int, who: str = "token:bob/ci") -> str:
        answer = await self.book.done_by_hand(ConfirmPrompt(request=1, job=job, prompt=prompt, who=who))
        await settle()
        return answer.outcome

    async def steer(self, job: str, how: Steering) -> str:
        return (await self.book.steer(SteerJob(request=1, job=job, how=how, who="token:bob/ci"))).outcome

    async def ended(self) -> JobState:
        await self.until(lambda: self.book.latest()[0].ended_utc is not None)
        return self.book.latest()[0]

    async def led(self) -> JobState:
        job = (await self.start()).job
        assert [await self.done(job, 1), await self.done(job, 2)] == ["done", "done"]
        return await self.ended()

    def recorded(self) -> list[tuple[str, str, str]]:
        return [(r.who, r.target, r.outcome) for r in self.store.audit.events() if r.action == "campaign"]


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        made = Bench(store, AuditBook(store, url))
        async with asyncio.TaskGroup() as tasks:
            made.book.open(made.scheduler, tasks)
            yield made
            await made.book.close()


async def test_it_asks_goes_on_by_the_right_word_and_ends_with_a_proposal(bench: Bench) -> None:
    answer = await bench.start("identification at 500 Hz")
    assert bench.scheduler.take("a check") == "by hand: identification at 500 Hz"
    job = bench.book.latest()[0]
    assert (job.kind, job.state, job.prompt, job.ask, job.who) == ("campaign", "asking", 1, BAR, "token:bob/ci")
    told = bench.snapshots.now(0).check
    assert told is not None
    assert (told.id, told.state, told.prompt, told.ask) == (job.id, "asking", 1, BAR)
    for prompt, who, outcome in ((1, "user:eve", "forbidden"), (0, "token:bob/ci", "conflict"), (2, "token:bob/ci", "conflict")):
        assert await bench.done(answer.job, prompt, who) == outcome
    assert bench.book.latest()[0].prompt == 1
    assert await bench.done(answer.job, 1) == "done"
    assert (bench.book.latest()[0].prompt, bench.book.latest()[0].ask) == (2, LASER)
    assert await bench.done(answer.job, 1) == "conflict", "the word for the bar is none for the laser"
    assert await bench.done(answer.job, 2) == "done"
    done = await bench.ended()
    assert (done.state, done.text, done.solution, done.proposal, done.prompt, done.ask) == ("done: proposed", LED.text, 7, 4, 0, "")
    assert await bench.done(answer.job, 2) == "conflict"
    assert (bench.orders[0].recipe, bench.orders[0].by) == ("identification at 500 Hz", "bob")
    target = "mill-7, identification at 500 Hz"
    assert bench.recorded() == [("token:bob/ci", target, "begun"), ("token:bob/ci", target, "proposed")]
    assert (bench.audit.verify(), bench.board.job) == ([], None)


async def test_who_may_measure_but_not_propose_starts_checks_only_and_says_done(bench: Bench) -> None:
    for who, told in (("user:oscar", "may not propose tables here"), ("user:pia", "may not measure here")):
        for recipe in ("identification", "identification at 500 Hz", "own.toml"):
            refused = await bench.start(recipe, who=who)
            assert (refused.outcome, told in refused.text, refused.job) == ("forbidden", True, "")
    assert (bench.orders, bench.book.latest(), bench.recorded()) == ([], (), [])
    job = (await bench.start()).job
    assert (await bench.start(who="user:oscar")).outcome == "forbidden", "before he is told what runs"
    assert (await bench.start("quick-check", who="user:oscar")).outcome == "busy"
    assert await bench.done(job, 1, "user:oscar") == "done"


@pytest.mark.parametrize("how", ["stop", "abort"])
async def test_who_ends_it_ends_the_wait(bench: Bench, how: Steering) -> None:
    bench.notes = ("abbe measure --resume goes on",)
    job = (await bench.start()).job
    assert await bench.steer(job, "pause") == "done"
    assert (bench.book.latest()[0].state, bench.book.latest()[0].prompt) == ("pausing", 1)
    assert await bench.steer(job, how) == "done"
    done = await bench.ended()
    assert (done.state, done.prompt, done.proposal) == ("done: stopped", 0, None)
    assert done.text.endswith("; abbe measure --resume goes on")
    assert [outcome for _, _, outcome in bench.recorded()] == ["begun", "stopped"]


async def test_one_key_is_one_campaign_and_only_declared_ones_are_started(bench: Bench) -> None:
    first = await bench.start(key="k")
    assert (await bench.start(key="k")).job == first.job
    assert (await bench.start("quick-check", key="k")).outcome == "conflict"
    assert (await bench.start(who="user:eve")).outcome == "forbidden"
    assert (await bench.start("quick-check")).text == "the machine is in use: by hand: identification"
    for recipe in ("identification at 300 Hz", "own.toml at 500 Hz", "other.toml"):
        refused = await bench.start(recipe)
        assert (refused.outcome, refused.text.endswith("quick-check, identification, own.toml")) == ("unknown", True)
    assert len(bench.orders) == 1
    assert await bench.steer(first.job, "stop") == "done"
    await bench.ended()
    assert (await bench.start("own.toml")).outcome == "done"


async def test_only_a_full_campaign_is_resumed_and_the_audit_names_it(bench: Bench) -> None:
    refused = await bench.start("quick-check", resume="check of noon")
    assert (refused.outcome, refused.text) == ("conflict", "'quick-check' cannot be resumed: only a full campaign can")
    first = await bench.start(key="k", resume="campaign of noon")
    assert (await bench.start(key="k")).outcome == "conflict", "the same key for another work"
    assert [order.resume for order in bench.orders] == ["campaign of noon"]
    assert await bench.steer(first.job, "stop") == "done"
    await bench.ended()
    assert {target for _, target, _ in bench.recorded()} == {"mill-7, identification, resumes campaign of noon"}


@pytest.mark.parametrize(
    ("end", "state", "text"),
    [
        (JobOutcome("ended", "no proposal: not enough to write"), "done: ended", "no proposal: not enough to write"),
        (LinkDown("modbus+tcp://127.0.0.1:502", "read", "refused", "is it on?"), "done: failed", "read: refused; is it on?"),
        (ExceptionGroup("two", [TableMismatch("another table", "measure again")]), "done: failed", "another table; measure again"),
    ],
)
async def test_how_it_ended_is_its_text(bench: Bench, end: Any, state: str, text: str) -> None:
    bench.end = end
    done = await bench.led()
    assert (done.state, done.text, done.proposal) == (state, text, None)
    assert [outcome for _, _, outcome in bench.recorded()] == ["begun", state.removeprefix("done: ")]


async def test_an_end_of_the_service_is_told(bench: Bench) -> None:
    await bench.start()
    await bench.book.close()
    assert bench.book.latest()[0].state == "interrupted"
    assert [outcome for _, _, outcome in bench.recorded()] == ["begun", "stopped"]


async def test_what_cannot_be_recorded_is_not_begun(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.audit, "write", lambda _: (_ for _ in ()).throw(StoreError("the audit is full")))
    await bench.start()
    done = await bench.ended()
    assert (done.state, done.text, bench.orders) == ("done: failed", "the audit is full", [])


async def test_a_prompt_is_answered_once_and_never_by_an_old_word() -> None:
    prompts = Prompts()
    assert (prompts.now, prompts.answer(0), prompts.answer(1)) == (None, False, False)
    for number in (1, 2):
        asking = asyncio.create_task(prompts.ask(f"text {number}"))
        await settle()
        assert prompts.now is not None
        assert (prompts.now.number, prompts.now.text) == (number, f"text {number}")
        assert [prompts.answer(k) for k in (number - 1, number + 1, number, number)] == [False, False, True, False]
        await asking
    given_up = asyncio.create_task(prompts.ask("text 3"))
    await settle()
    given_up.cancel()
    await asyncio.wait({given_up})
    assert (prompts.now, prompts.answer(3)) == (None, False)
    asking = asyncio.create_task(prompts.ask("text 4"))
    await settle()
    assert (prompts.answer(3), prompts.answer(4)) == (False, True)
    await asking
