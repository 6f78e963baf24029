"""What follows from alarms, as jobs that people see and steer; and what is said of a push, which is what its journal says."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Steering, SteerJob
from abbe.service.compensation import push_approved
from abbe.service.compensation.approved import ApprovedProposal, PushOrder
from abbe.service.compensation.gate import PushContext
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.push_recovery import push_is_open
from abbe.service.devices.session import ENVIRONMENT
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobOutcome, JobState, ProgressSink
from abbe.service.domain.push_entry import PushState as Push
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind
from abbe.service.errors import StillActive, StoreError, TableRefused
from abbe.service.jobs.investigate import InvestigationContext as Investigation
from abbe.service.jobs.investigate import investigate
from abbe.service.push.journal import StoreBook
from abbe.service.scheduler.alarm_manager import AlarmChannels, AlarmManager, Duties
from abbe.service.scheduler.job import carry_out
from abbe.service.scheduler.loop import LoopTerms, Scheduler
from abbe.service.scheduler.ports import SlotState
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView, reconciled
from abbe.service.verification.alarm_states import NO_ALARM, Alarm, Note
from abbe.service.verification.alarms import alarms_of
from tests.patience import within
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, fake_checks, utc

NOON = utc(2026, 6, 1, 12)
YEARLY = Schedule("yearly", "0 0 1 1 *", "UTC", "quick-check", on_alarm="propose")
RAISED = AlarmFacts(recipe="quick-check", schedule="yearly", verification=1, text="too far off")
URL = "modbus+tcp://127.0.0.1:1"
BASE = {"table": 0, "crc": 7, "base_crc": 5, "base_bank": 0}
IN_FORCE = (
    Push.SNAPSHOT,
    Push.VALIDATED,
    Push.APPROVED,
    Push.LEASED,
    Push.STAGING,
    Push.STAGED,
    Push.ACTIVATING,
    Push.PROBATION,
    Push.PROBED,
)
KEPT = (*IN_FORCE, Push.VERIFIED, Push.KEEP)
Investigate = Callable[[Alarm, Note, ProgressSink, Control], Awaitable[None]]


@dataclass
class Bench:
    """A real scheduler, book of jobs, desk and database; what an follow_up does is told by each test."""

    store: Store
    url: str
    clock: FakeClock = field(default_factory=lambda: FakeClock(NOON))
    investigate: Investigate | None = None
    push: Callable[[PushOrder], Awaitable[JobOutcome]] | None = None

    def __post_init__(self) -> None:
        self.machine = self.store.machines.add("mill-7", {"name": "mill-7"})
        duties = Duties(0.0, "identification", self._investigate, self._push)
        self.desk = AlarmManager(
            self.store, self.clock, "mill-7", [YEARLY], duties, AlarmChannels(None, lambda: None, AuditBook(self.store, self.url))
        )
        self.book = JobRegistry(fake_checks(self._check), ("quick-check",), self._may, self.clock, lambda: None)
        terms = LoopTerms(follow_ups=self.desk, run_job=self.book.run)
        self.scheduler = Scheduler([YEARLY], FakeLedger(), self.book, FakeShelf(), self.clock, terms)

    async def _may(self, who: str, *_need: Permission) -> bool:
        return who == "user:bob"

    async def _check(self, schedule: Schedule, slot: datetime, control: Control) -> SlotState:
        return SlotState("done: pass", verification=1)

    async def _investigate(self, alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
        assert self.investigate is not None
        await self.investigate(alarm, note, progress, control)

    async def _push(self, order: PushOrder) -> JobOutcome:
        assert self.push is not None
        return await self.push(order)

    async def until(self, what: Callable[[], Any]) -> Any:
        """The store works in threads: turn after turn of the loop, and of the scheduler, until it is so."""
        async with asyncio.timeout(within(20)):
            while not (found := what()):
                await self.clock.pass_time(30.0)
                await asyncio.sleep(0.001)
        return found

    def jobs(self, state: str = "") -> list[JobState]:
        return [job for job in self.book.latest() if job.state.startswith(state)]

    async def steer(self, how: Steering, who: str = "user:bob") -> tuple[str, str]:
        running = self.book.running
        assert running is not None
        answer = await self.book.steer(SteerJob(request=1, job=running.id, how=how, who=who))
        return answer.outcome, answer.text

    def alarm(self) -> Alarm:
        return alarms_of(self.store, "mill-7")[0]

    def lines(self) -> list[AlarmEntryRecord]:
        return self.store.alarms.entries("mill-7")

    async def journal(self, *states: Push, push: int = 1, **more: Any) -> None:
        """What the push machine writes on its way, by its own book: the rules of the order and of the chain hold."""
        table = self.store.tables.add(self.machine, None, b"image", 7, {"proposal": 4})
        book = await StoreBook.new(self.store, "mill-7", self.clock)
        entries: tuple[Any, ...] = ()
        for state in states:
            doc = BASE | {"table": table} if state is Push.SNAPSHOT else {}
            entries = (*entries, await book.append(entries, state, doc | (more if state is states[-1] else {})))

    async def pushed(self, control: Control | None = None) -> tuple[str, str]:
        """Let the desk push proposal 4; the word and the sentence that the alarm's line says."""
        job = self.desk.push_job(ApprovedProposal(4, 9, NO_ALARM), YEARLY)
        state = await carry_out(job, NOON, control or Control())
        last = self.lines()[-1]
        assert (last.kind, state) == (AlarmKind.PUSHED, f"done: {last.facts.word}")
        return last.facts.word, last.facts.text


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        yield Bench(store, url)


@pytest.fixture
async def running(bench: Bench) -> AsyncIterator[Bench]:
    bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, RAISED, [])
    async with asyncio.TaskGroup() as tasks:
        timetable = tasks.create_task(bench.scheduler.run())
        yield bench
        timetable.cancel()


# ---- jobs -------------------------------------------------------------------------------------------------------------


async def test_what_is_asked_for_before_the_work_begins_is_seen_and_kept(running: Bench) -> None:
    begins = asyncio.Event()

    async def slow(alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
        await begins.wait()
        control.now(State.RUNNING)
        await control.gate()

    running.investigate = slow
    await running.until(lambda: running.jobs("running"))
    seen = []
    for how in ("pause", "resume", "pause"):
        assert (await running.steer(how))[0] == "done"
        seen.append(str(running.jobs()[0].state))
    assert seen == ["pausing", "running", "pausing"]
    begins.set()
    await running.until(lambda: running.jobs("paused"))
    assert (await running.steer("stop"))[0] == "done"
    await running.until(lambda: running.jobs("done: failed"))


async def test_an_investigation_is_a_job_that_can_be_paused_stopped_and_aborted(running: Bench) -> None:
    waits = asyncio.Event()

    async def gently(alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
        control.now(State.RUNNING)
        await control.unless_stopped(waits.wait())

    running.investigate = gently
    await running.until(lambda: running.jobs("running"))
    (job,) = running.jobs()
    assert (job.kind, job.recipe, job.schedule, job.who) == ("investigation", "identification", "investigation of alarm 1", "")
    assert await running.steer("stop", "user:eve") == ("forbidden", "user:eve may not stop here")
    assert (await running.steer("pause"))[0] == "done"
    assert running.jobs()[0].state == "pausing"
    assert (await running.steer("resume"))[0] == "done"
    assert (await running.steer("stop"))[0] == "done"
    await running.until(lambda: running.jobs("done: failed"))
    assert running.alarm().outcome.startswith("the investigation was ended by a person: stopped as asked")
    assert running.jobs()[0].text == running.alarm().outcome

    async def deaf(alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
        control.now(State.RUNNING)
        await note(AlarmKind.BEGUN, AlarmFacts(text="measuring", campaign="c"))
        try:
            await waits.wait()
        except asyncio.CancelledError as error:
            error.add_note("the axes stand")
            raise

    running.investigate = deaf
    running.store.alarms.append("mill-7", 1, running.alarm().last_seq + 1, AlarmKind.CONTINUED, RAISED, [])
    await running.until(lambda: running.alarm().work[-1].kind is AlarmKind.BEGUN)
    assert (await running.steer("abort"))[0] == "done"  # at once: nothing of the work looks at the control
    await running.until(lambda: len(running.jobs("done: failed")) == 2)
    assert "aborted as asked" in running.alarm().outcome


async def test_a_push_is_a_job_and_is_not_paused_while_a_table_is_not_verified(bench: Bench) -> None:
    """`no_pause_reason` is set by `Pushing.bring` (tests/push/test_pausing.py); here only that the book asks for it."""
    seen: list[tuple[str, str]] = []
    pausing: list[bool] = []

    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        order.control.now(State.RUNNING)
        for reason in ("a table that nobody has verified may be in force", ""):
            order.control.no_pause_reason = reason
            seen.append(await bench.steer("pause"))
            pausing.append(order.control.pausing)
        return JobOutcome("refused", "not today")

    bench.push = push
    assert await bench.book.run(bench.desk.push_job(ApprovedProposal(4, 9, NO_ALARM), YEARLY)) == "done: refused"
    assert seen == [("conflict", "the job cannot be paused now: a table that nobody has verified may be in force"), ("done", "")]
    (job,) = bench.jobs()
    assert (job.kind, job.state, job.text) == ("push", "done: refused", "not today")
    assert pausing == [False, True]


async def test_work_that_ends_by_itself_is_not_touched_by_an_abort() -> None:
    control = Control()

    async def work() -> int:
        control.abort()
        return 3

    assert await control.unless_aborted(work()) == 3
    outer = asyncio.create_task(Control().unless_aborted(asyncio.Event().wait()))
    await asyncio.sleep(0)
    outer.cancel()
    with pytest.raises(asyncio.CancelledError):
        await outer


# ---- a machine that another process has ---------------------------------------------------------------------------------

HOLDER = """
import sys
from abbe.service.devices.session import lock_machine
with lock_machine(sys.argv[1]):
    print("has it", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    """A real process that has the machine, until it is given a line."""
    (tmp_path / "locks").mkdir()
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "locks"))
    process = subprocess.Popen([sys.executable, "-c", HOLDER, URL], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == "has it\n"
        yield process
        process.kill()


async def test_a_machine_in_use_is_waited_for_and_no_try_is_counted(running: Bench, other: subprocess.Popen[str]) -> None:
    """The real investigation."""
    site = cast("Any", SimpleNamespace(urls=SimpleNamespace(cnc=URL), name="mill-7"))

    async def real(alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
        await investigate(Investigation(site, running.store, CampaignPlan("", ()), running.clock, progress, control), alarm, note)

    running.investigate = real
    await running.until(lambda: len(running.jobs("waits")) >= 3)
    assert f"in use by process {other.pid}" in running.jobs("waits")[0].text
    assert running.alarm().work == ()

    running.investigate = free
    other.communicate("\n", timeout=20)
    await running.until(lambda: running.jobs("done: ended"))
    assert [step.kind for step in running.alarm().work] == [AlarmKind.ENDED]


async def free(alarm: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
    await note(AlarmKind.ENDED, AlarmFacts(text="nothing to gain"))


# ---- the word for a push ------------------------------------------------------------------------------------------------


async def test_a_kept_table_is_kept_whatever_failed_afterwards(bench: Bench) -> None:
    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        await bench.journal(*KEPT, verify="better by 4 µm")
        raise StoreError("the disk is full")

    bench.push = push
    word, text = await bench.pushed()
    assert word == "kept"
    assert text.startswith("proposal 4 kept: push 1: the new table is kept and in force: ")
    assert text.endswith("; the disk is full")
    begun = bench.lines()[0]
    assert (begun.kind, begun.facts.approval, begun.facts.after) == (AlarmKind.PUSHING, 9, 0)


Heard = Exception | JobOutcome


@pytest.mark.parametrize(
    ("states", "heard", "word", "part"),
    [
        (KEPT, JobOutcome("failed", "no answer"), "kept", "in force"),
        (
            (*IN_FORCE, Push.ROLLBACK, Push.ROLLED_BACK),
            JobOutcome("failed", "no answer"),
            "rolled back",
            "the old table is in force again",
        ),
        ((*IN_FORCE, Push.ROLLBACK, Push.ROLLED_BACK), ArithmeticError("no number"), "rolled back", "no number"),
        (IN_FORCE, StillActive("the door is open"), "open", "is in state PROBED: an unverified table may be in force"),
        (IN_FORCE, JobOutcome("rolled back", "as somebody thought"), "open", "an unverified table may be in force"),
        ((Push.SNAPSHOT, Push.VALIDATED), JobOutcome("failed", "no answer"), "open", "the old table is in force"),
        ((Push.SNAPSHOT, Push.REJECTED), JobOutcome("failed", "no answer"), "refused", "nothing was written"),
        ((Push.SNAPSHOT, Push.ABORTED), JobOutcome("kept", "as somebody thought"), "failed", "the new one never came into force"),
        ((Push.SNAPSHOT, Push.ABORTED), JobOutcome("stopped", "by a person"), "stopped", "the new one never came into force"),
        ((), TableRefused("too old"), "failed", "too old"),
        ((), JobOutcome("refused", "too old"), "refused", "too old"),
        ((), JobOutcome("kept", "as somebody thought"), "failed", "thought"),
    ],
)
async def test_the_word_is_that_of_the_journal(bench: Bench, states: tuple[Push, ...], heard: Heard, word: str, part: str) -> None:
    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        if states:
            await bench.journal(*states)
        if isinstance(heard, Exception):
            raise heard
        return heard

    bench.push = push
    said, text = await bench.pushed()
    assert (said, part in text) == (word, True), text
    assert (JournalView.read(bench.store, "mill-7").open_push != "") == (word == "open")


async def test_a_push_before_this_one_says_nothing_of_it(bench: Bench) -> None:
    await bench.journal(*KEPT)

    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        return JobOutcome("failed", "no answer")

    bench.push = push
    assert (await bench.pushed())[0] == "failed"
    journal, heard = JournalView.read(bench.store, "mill-7"), JobOutcome("failed", "")
    assert reconciled(journal.of_proposal(4), heard).word == "kept"
    assert reconciled(journal.of_proposal(5), heard).word == "failed"


async def test_a_journal_that_cannot_be_read_leaves_the_line_to_the_next_look(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        await bench.journal(*KEPT)
        return JobOutcome("failed", "no answer")

    bench.push = push
    bench.clock.sleep = lambda s: asyncio.sleep(0)  # type: ignore[method-assign]
    with monkeypatch.context() as patch:
        patch.setattr(JournalView, "of_proposal", _unreadable)
        with pytest.raises(StoreError):
            await bench.pushed()
    assert [line.kind for line in bench.lines()] == [AlarmKind.PUSHING]
    await bench.desk.due()
    assert (bench.lines()[-1].kind, bench.lines()[-1].facts.word) == (AlarmKind.PUSHED, "kept")


def _unreadable(*_: object) -> JobOutcome:
    raise StoreError("the database is locked")


async def test_what_stays_open_is_told_and_told_again_when_it_is_closed(bench: Bench) -> None:
    """As after a stop of the service, and after a door that was open."""

    async def push(order: PushOrder) -> JobOutcome:
        await order.begun()
        await bench.journal(*IN_FORCE)
        await asyncio.Event().wait()
        raise AssertionError

    bench.push = push
    task = asyncio.create_task(bench.pushed())
    await bench.until(lambda: JournalView.read(bench.store, "mill-7").open_push.startswith("push 1 is in state PROBED"))
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert [line.facts.word for line in bench.lines()] == ["", "open"]
    assert bench.lines()[-1].facts.text.endswith("(stopped because the service stopped)")
    for _ in range(2):
        await bench.desk.due()
    assert len(bench.lines()) == 2  # once is enough

    book = await StoreBook.last(bench.store, "mill-7", bench.clock)
    assert book is not None
    for state in (Push.ROLLBACK, Push.ROLLED_BACK):
        await book.append(await book.entries(), state, {"why": "taken back at the start"})
    await bench.desk.due()
    assert [line.facts.word for line in bench.lines()] == ["", "open", "rolled back"]
    assert "the old table is in force again: taken back at the start" in bench.lines()[-1].facts.text
    await bench.desk.due()
    assert len(bench.lines()) == 3


async def test_a_stop_does_not_end_the_way_back_and_an_abort_leaves_it_to_the_service(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, safe, told = asyncio.Event(), asyncio.Event(), StillActive("the door is open")

    async def finish(*_: object, **__: object) -> str:
        begun.set()
        await safe.wait()
        return "the old table was made active again"

    async def back(ask: Callable[[Control], None]) -> JobOutcome:
        begun.clear()
        control, nothing = Control(), cast("Any", SimpleNamespace(controller=None))
        control.stop()  # before the way back begins
        order = PushOrder(4, cast("Any", None), lambda now: None, control)
        task = asyncio.create_task(
            push_approved._finish_when_safe(PushContext(nothing, bench.store, nothing, clock=bench.clock), order, told)
        )
        async with asyncio.timeout(within(20)):
            await begun.wait()
            ask(control)
            return await task

    monkeypatch.setattr(push_approved, "finish_when_safe", finish)
    aborted = await back(Control.abort)
    assert (aborted.word, aborted.text.endswith("the table will be rolled back as soon as possible")) == ("failed", True)
    assert await back(lambda control: safe.set()) == JobOutcome("rolled back", "the door is open; the old table was made active again")


async def test_what_is_open_by_the_journal(bench: Bench) -> None:
    async def then(*states: Push) -> bool:
        for state in states:
            book = await StoreBook.last(bench.store, "mill-7", bench.clock)
            assert book is not None
            await book.append(await book.entries(), state, {})
        return await push_is_open(bench.store, "mill-7")

    assert not await push_is_open(bench.store, "mill-7")
    await bench.journal(*IN_FORCE)
    assert await then()
    assert await then(Push.ROLLBACK, Push.ROLLBACK_PENDING)
    assert not await push_is_open(bench.store, "mill-8")
    assert not await then(Push.ROLLED_BACK)
    await bench.journal(*IN_FORCE, Push.OPERATOR)
    assert await then()
    assert not await then(Push.ACCEPTED)
    await bench.journal(*KEPT)
    assert not await then()


async def test_after_a_kill_the_next_start_says_it_by_the_journal(bench: Bench) -> None:
    facts = AlarmFacts(proposal=4, approval=9, text="proposal 4 is being pushed")
    bench.store.alarms.append("mill-7", NO_ALARM, 0, AlarmKind.PUSHING, facts)
    await bench.journal(*KEPT)
    await bench.desk.due()
    last = bench.lines()[-1].facts
    assert (last.word, last.text.endswith("(it was interrupted when the service stopped)")) == ("kept", True)
