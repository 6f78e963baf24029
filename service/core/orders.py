"""What a person orders of tables: that the one in force gives way to the one before, or that an approved one is pushed now. A job as a
check is, with the machine to itself.

Rights are decided here. How it ended is the word of the push journal, whatever somebody heard; who ordered it and why stands in the audit
before anything is written, and how it ended after it.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Final, Literal

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.audit.chain import Event
from abbe.service.channel.messages import Answer, PushNow, RollBack
from abbe.service.channel.messages import Outcome as Word
from abbe.service.clock import Clock
from abbe.service.compensation.ordered_rollback import BackOrder
from abbe.service.compensation.proposal_doc import load
from abbe.service.compensation.proposal_states import standing
from abbe.service.compensation.push_approved import PushOrder
from abbe.service.compensation.rollback import Ordered
from abbe.service.core.jobs import BY_HAND, JobRegistry, JobRequest
from abbe.service.domain.job_state import JobKind
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, Aborted, NotStored, Stopped, TableRefused
from abbe.service.events import Progress
from abbe.service.scheduler import record
from abbe.service.scheduler.job import FAILURES
from abbe.service.scheduler.ports import Doc, JobWatcher, SlotState
from abbe.service.scheduler.retrying_store import RetryingStore
from abbe.service.scheduler.store import ServiceStore
from abbe.service.sequences.control import Control, State
from abbe.service.tables.push_outcome import STOPPED, PushOutcome, in_force, last_push, ordered, put_right
from abbe.service.tables.table_history import offered

log = structlog.get_logger("abbe.orders")

ROLLBACK: Final = "rollback"
PUSH: Final = "push"
LAST_WORDS_S = 1.0
"""A service that ends has five seconds for everything."""
NO_PAUSE = "a table is being changed: stop it, or let it end"

BringBack = Callable[[BackOrder], Awaitable[PushOutcome]]
"""``await bring_back(order)``: does it, and says what was heard of it."""
Push = Callable[[PushOrder], Awaitable[PushOutcome]]
"""``await push(order)``: pushes what is approved, and says what was heard of it."""
BY_ITSELF = "this service pushes what is approved by itself ([alarm] push), or has no controller"


@dataclass(frozen=True, slots=True)
class Hands:
    """What can be ordered: a rollback, a push of what is approved. None: that is not ordered here."""

    bring_back: BringBack | None = None
    push: Push | None = None


@dataclass(frozen=True, slots=True)
class _OrderTask:
    """An order on its way: what it is, who gave it, of what, and what of it is recorded; what is done, and what the journal says of it."""

    kind: JobKind
    who: str
    target: str
    doc: Doc
    do: Callable[[Control], Awaitable[PushOutcome]]
    look: Callable[[], PushOutcome | None]


@dataclass(frozen=True, slots=True)
class Ground:
    """Where orders are carried out: the machine's name, who may (``await may(who)``), the audit, who watches jobs, and the identity
    of the machine's control.
    """

    machine: str
    may: Callable[[str], Awaitable[bool]]
    audit: AuditBook
    watchers: Sequence[JobWatcher] = ()
    control: str = ""


class Orders(RetryingStore):
    """Takes orders and carries them out as jobs of the book.

    Parameters
    ----------
    store : ServiceStore
        Holds the push journal.
    clock : Clock
        Now.
    book : JobRegistry
        Of the jobs.
    ground : Ground
        Where.
    hands : Hands
        What can be ordered.
    """

    def __init__(self, store: ServiceStore, clock: Clock, book: JobRegistry, ground: Ground, hands: Hands) -> None:
        super().__init__(store, clock)
        self._book, self._ground, self._hands = book, ground, hands

    async def rollback(self, asked: RollBack) -> Answer:
        """Begin to take the table in force back, once for each key; not if another is in force than was seen, or none was before it."""
        wish = JobRequest(asked.request, asked.who, asked.key, f"{ROLLBACK} of push {asked.push}, {asked.crc:08X}: {asked.reason}")
        refused = await self._refused(wish, "order a table back", self._hands.bring_back is None and "this service has no controller")
        if refused is not None:
            return refused
        try:
            now = await asyncio.to_thread(offered, self._store, self._ground.machine, self._ground.control)
        except TableRefused as no:
            return _answer(asked.request, "conflict", str(no))
        if (now.push, now.crc) != (asked.push, asked.crc):
            what = f"meanwhile another table is in force: {now.crc:08X} of push {now.push}; look at it first"
            return _answer(asked.request, "conflict", what)
        return self._begun(wish, f"{ROLLBACK} of push {asked.push}", self._back(asked))

    def _back(self, asked: RollBack) -> _OrderTask:
        number, bring_back = secrets.token_hex(6), self._hands.bring_back
        assert bring_back is not None

        async def do(control: Control) -> PushOutcome:
            return await bring_back(BackOrder(asked.push, asked.crc, Ordered(asked.who, asked.reason, number, control)))

        doc = {"reason": asked.reason, "order": number, "push": asked.push, "crc": f"{asked.crc:08X}"}
        target = f"{self._ground.machine}, table of push {asked.push} ({asked.crc:08X})"
        return _OrderTask(ROLLBACK, asked.who, target, doc, do, lambda: ordered(self._store, self._ground.machine, number))

    async def push(self, asked: PushNow) -> Answer:
        """Begin to push a proposal whose approval holds, once for each key; its verification before is measured first."""
        wish = JobRequest(asked.request, asked.who, asked.key, f"{PUSH} of proposal {asked.proposal}")
        refused = await self._refused(wish, "order a push", self._hands.push is None and BY_ITSELF)
        if refused is not None:
            return refused
        try:
            against, after = await asyncio.to_thread(self._not_approved, asked.proposal)
        except NotStored as error:
            return _answer(asked.request, "unknown", error.detail)
        if against:
            return _answer(asked.request, "conflict", against)
        return self._begun(wish, f"{PUSH} of proposal {asked.proposal}", self._approved(asked, after))

    def _not_approved(self, proposal: int) -> tuple[str, int]:
        """Why a proposal cannot be pushed as it stands, and the number of the last push."""
        machine, found = self._ground.machine, load(self._store, proposal)
        now = standing(self._store, proposal, found, self._clock.utc().timestamp())
        after = last_push(self._store, machine)
        if found.candidate.machine != machine:
            return f"proposal {proposal} is for {found.candidate.machine}, not for {machine}", after
        return "" if now.word == "approved" else f"proposal {proposal} is {now.word}: {now.text}", after

    def _approved(self, asked: PushNow, after: int) -> _OrderTask:
        push, machine = self._hands.push, self._ground.machine
        assert push is not None

        async def begun() -> None:
            """The audit has it already."""

        async def do(control: Control) -> PushOutcome:
            return await push(PushOrder(asked.proposal, begun, self._progress, control))

        doc = {"proposal": asked.proposal, "after": after}
        target = f"{machine}, proposal {asked.proposal}"
        return _OrderTask(PUSH, asked.who, target, doc, do, lambda: in_force(self._store, machine, asked.proposal, after))

    async def _refused(self, wish: JobRequest, words: str, missing: str | Literal[False]) -> Answer | None:
        """The answer to who may not, to what was asked for before, and while something runs; None: go on."""
        if not await self._ground.may(wish.who):
            return _answer(wish.request, "forbidden", f"{wish.who} may not {words} here")
        again = self._book.again(wish)
        if again is not None:
            return again
        if missing:
            return _answer(wish.request, "conflict", missing)
        running = self._book.running
        if running is not None:  # before the journal is asked: what pushes now would look like what was left open
            return _answer(wish.request, "busy", f"the machine measures: {running.schedule or running.recipe}")
        return None

    def _begun(self, wish: JobRequest, name: str, task: _OrderTask) -> Answer:
        terms = Schedule(BY_HAND, "", "UTC", name)
        return self._book.begin(wish, terms, partial(self._carried_out, task, terms), task.kind)

    async def _carried_out(self, task: _OrderTask, terms: Schedule, begun: datetime, control: Control) -> tuple[str, int | None]:
        self._begin(task, terms, begun, control)
        try:
            await self._record(task, "begun", "")
            said = await control.unless_aborted(_heard(task, control))
        except asyncio.CancelledError:
            await self._stopped_with_the_service(task)
            raise
        except FAILURES as error:
            ended = isinstance(error, Stopped | Aborted)
            said = PushOutcome(
                STOPPED if ended else "failed", "; ".join([record.cause_of(error)["what"], *getattr(error, "__notes__", [])])
            )
        finally:
            control.now(State.ENDED)
            for watcher in self._ground.watchers:
                watcher.job_ended(None)
        done = put_right(await self._read(task.look), said)
        log.warning("an order of a table has ended", kind=task.kind, who=task.who, word=done.word, text=done.text)
        try:
            await self._record(task, done.word, done.text)
        except AbbeError as error:  # what was done is in the journal; a service that ends here would do nothing more
            log.error("not in the audit", cause=error.detail)
        return SlotState(f"done: {done.word}", done.text), None

    def _begin(self, task: _OrderTask, terms: Schedule, begun: datetime, control: Control) -> None:
        control.now(State.RUNNING)
        control.hurry = NO_PAUSE if task.kind == ROLLBACK else ""  # a push measures first, and that can be held
        for watcher in self._ground.watchers:
            watcher.job_started(terms, begun)

    def _progress(self, progress: Progress) -> None:
        for watcher in self._ground.watchers:
            watcher.job_progress(progress)

    async def _record(self, task: _OrderTask, outcome: str, text: str) -> None:
        event = Event(task.who, task.kind, task.target, outcome, task.doc | ({"text": text} if text else {}))
        await asyncio.to_thread(self._ground.audit.write, event)

    async def _stopped_with_the_service(self, task: _OrderTask) -> None:
        """Say by the journal where it stands, now, if the database takes it at once; what is open the next start takes back."""
        try:
            async with asyncio.timeout(LAST_WORDS_S):
                done = await asyncio.to_thread(task.look) or PushOutcome("failed", "the service ended before anything was written")
                log.warning("an order was stopped with the service", kind=task.kind, word=done.word, text=done.text)
                await self._record(task, done.word, f"{done.text} (stopped with the service)")
        except (AbbeError, TimeoutError) as trouble:
            log.warning("an order was stopped with the service; the push journal says where it stands", cause=str(trouble))


async def _heard(task: _OrderTask, control: Control) -> PushOutcome:
    return await task.do(control)


def _answer(request: int, outcome: Word, text: str) -> Answer:
    return Answer("answer", request, outcome, text[:4000], "")
