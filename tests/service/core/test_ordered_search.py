"""A person looks for the cause of an alarm: who may, what the alarm and the audit say of it, and what refuses it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, StartJob
from abbe.service.core.orders import CampaignOrder, OrderContext, full_campaigns
from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.errors import MachineInUse
from abbe.service.storage.store import Store
from tests.service.core.test_alarm_manager import RAISED, Bench


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        yield Bench(store, url)


@dataclass
class Searching:
    """The jobs of a person who looks for the cause of an alarm; ``does`` is what the full campaign does."""

    bench: Bench
    does: Callable[[CampaignOrder], Awaitable[None]]

    async def measure(self, order: CampaignOrder) -> JobOutcome:
        await self.does(order)
        return JobOutcome("done", "")

    async def ordered(self, tasks: asyncio.TaskGroup, alarm: int, recipe: str = "identification") -> Answer:
        bench = self.bench
        context = OrderContext("mill-7", bench._may, AuditBook(bench.store, bench.url))
        bench.book.full = full_campaigns(context, ("identification",), self.measure, bench._may, bench.desk)
        bench.book.open(bench.scheduler, tasks)
        return await bench.book.start(StartJob(request=1, recipe=recipe, key="", who="user:bob", alarm=alarm, resume=""))


async def test_a_person_starts_the_search_for_the_cause_and_its_lines_name_her(bench: Bench) -> None:
    bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, RAISED, [])

    async def finds(order: CampaignOrder) -> None:
        assert order.cause is not None
        alarm, note = order.cause
        assert (order.by, alarm.number, alarm.work[-1].kind) == ("bob", 1, AlarmKind.ORDERED)
        await note(AlarmKind.DISCOVERED, AlarmFacts(text="scale of X", discovery=5))
        await note(AlarmKind.PROPOSED, AlarmFacts(text="proposal 4 waits", proposal=4))

    async with asyncio.TaskGroup() as tasks:
        assert (await Searching(bench, finds).ordered(tasks, 1)).outcome == "done"
        (job,) = await bench.until(lambda: bench.jobs("done"))
    assert (job.state, job.text, job.proposal, job.who) == ("done: proposed", "proposal 4 waits", 4, "user:bob")
    assert job.alarm == 1, "its screen leads to its own alarm"
    ordered = bench.alarm().last(AlarmKind.ORDERED)
    assert ordered is not None
    assert ordered.facts.name == "bob"
    told = [(r.who, r.target, r.outcome) for r in bench.store.audit.events() if r.action == "campaign"]
    target = "mill-7, identification, alarm 1"
    assert told == [("user:bob", target, "begun"), ("user:bob", target, "proposed")]


@pytest.mark.parametrize(
    ("error", "last"), [(LinkDown("x", "connect", "gone", "look"), AlarmKind.FAILED), (MachineInUse("x"), AlarmKind.ORDERED)]
)
async def test_a_search_that_fails_is_told_by_its_alarm_but_one_that_found_the_machine_in_use_has_not_begun(
    bench: Bench, error: Exception, last: AlarmKind
) -> None:
    bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, RAISED, [])

    async def fails(order: CampaignOrder) -> None:
        raise error

    async with asyncio.TaskGroup() as tasks:
        assert (await Searching(bench, fails).ordered(tasks, 1)).outcome == "done"
        await bench.until(lambda: bench.jobs("done: failed"))
    assert bench.lines()[-1].kind is last


async def test_after_an_order_that_found_the_machine_in_use_the_service_does_not_measure_alone(bench: Bench) -> None:
    for kind, facts in ((AlarmKind.RAISED, RAISED), (AlarmKind.BEGUN, AlarmFacts()), (AlarmKind.ENDED, AlarmFacts(text="no proposal"))):
        lines = bench.lines()
        bench.store.alarms.append("mill-7", lines[0].alarm if lines else None, len(lines), kind, facts, [])
    assert await bench.desk.due() is None

    async def fails(order: CampaignOrder) -> None:
        raise MachineInUse("x")

    async with asyncio.TaskGroup() as tasks:
        assert (await Searching(bench, fails).ordered(tasks, 1)).outcome == "done"
        await bench.until(lambda: bench.jobs("done: failed"))
    assert bench.lines()[-1].kind is AlarmKind.ORDERED
    assert await bench.desk.due() is None


async def test_only_an_alarm_that_is_there_is_searched_and_only_by_a_full_campaign(bench: Bench) -> None:
    bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, RAISED, [])
    bench.store.alarms.append("mill-7", 1, 1, AlarmKind.CLEARED, RAISED, [])

    async def never(order: CampaignOrder) -> None:
        raise AssertionError

    async with asyncio.TaskGroup() as tasks:
        told = [
            await Searching(bench, never).ordered(tasks, alarm, recipe)
            for alarm, recipe in ((1, "identification"), (7, "identification"), (1, "quick-check"))
        ]
    assert [one.outcome for one in told] == ["conflict"] * 3
    for one, word in zip(told, ("is over", "no alarm 7", "start a full campaign"), strict=True):
        assert word in one.text
    assert (bench.jobs(), len(bench.lines())) == ([], 2)
