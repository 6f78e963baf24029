"""What a person orders: a full campaign, that the table in force gives way to the one before, or that an approved one is pushed now.
Each is a job as a check is, with the machine to itself.

Rights are decided here. Who ordered it and why stands in the audit before anything is done, and how it ended after it. How a push ended is
the word of the push journal, whatever somebody heard.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Literal

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, PushNow, RollBack
from abbe.service.channel.messages import Outcome as Word
from abbe.service.clock import Clock
from abbe.service.compensation.ordered_rollback import BackOrder
from abbe.service.compensation.proposal_doc import load
from abbe.service.compensation.proposal_states import proposal_status
from abbe.service.compensation.push_approved import PushOrder
from abbe.service.compensation.rollback import Ordered
from abbe.service.core.jobs import BY_HAND, ByHand, FullCampaigns, JobRegistry, JobRequest
from abbe.service.core.rights import person
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.domain.job_state import JobKind, JobOutcome
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, NotStored, TableRefused
from abbe.service.events import ProgressSink
from abbe.service.jobs.guided_campaign import is_full
from abbe.service.scheduler.job import Job, carry_out, failure
from abbe.service.scheduler.ports import Doc, JobWatcher, SlotState
from abbe.service.scheduler.retrying_store import RetryingStore
from abbe.service.scheduler.store import ServiceStore
from abbe.service.sequences.control import Control, State
from abbe.service.tables.push_outcome import STOPPED, in_force, last_push, ordered, put_right
from abbe.service.tables.table_history import offered

log = structlog.get_logger("abbe.orders")

CAMPAIGN: Final = "campaign"
ROLLBACK: Final = "rollback"
PUSH: Final = "push"
NO_PAUSE = "a table is being changed: stop it, or let it end"

OrderedRollback = Callable[[BackOrder], Awaitable[JobOutcome]]
"""``await bring_back(order)``: does it, and says what was heard of it."""
Push = Callable[[PushOrder], Awaitable[JobOutcome]]
"""``await push(order)``: pushes what is approved, and says what was heard of it."""
BY_ITSELF = "this service pushes what is approved by itself ([alarm] push), or has no controller"


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """What is wanted: the recipe, who proposes, who hears how far it is, and who may pause and stop it."""

    recipe: str
    by: str
    progress: ProgressSink
    control: Control


MeasureCampaign = Callable[[CampaignOrder], Awaitable[JobOutcome]]
"""``await measure(order)``: measures, solves, proposes."""


@dataclass(frozen=True, slots=True)
class Hands:
    """What can be ordered: a rollback, a push of what is approved. None: that is not ordered here."""

    ordered_rollback: OrderedRollback | None = None
    push: Push | None = None


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


@dataclass(frozen=True, slots=True)
class _Order:
    """An order: what it is, who gave it, of what, what of it is recorded, and what is done."""

    kind: JobKind
    who: str
    target: str
    doc: Doc
    do: Callable[[ProgressSink, Control], Awaitable[JobOutcome]]


class _OrderJob(Job[JobOutcome]):
    """An order on its way, with its records in the audit."""

    def __init__(self, order: _Order, audit: AuditBook) -> None:
        self._order, self._audit, self.name = order, audit, order.kind

    async def begin(self) -> None:
        await self.record("begun", "")

    async def do(self, progress: ProgressSink, control: Control) -> JobOutcome:
        control.now(State.RUNNING)
        control.hurry = NO_PAUSE if self.name == ROLLBACK else ""  # a push measures first, and that can be held
        return await self._order.do(progress, control)

    async def failed(self, error: Exception) -> JobOutcome:
        return failure(error)

    async def end(self, outcome: JobOutcome) -> SlotState:
        log.warning("an order has ended", kind=self.name, who=self._order.who, word=outcome.word, text=outcome.text)
        try:
            await self.record(outcome.word, outcome.text)
        except AbbeError as error:  # what was done is in the store; a service that ends here would do nothing more
            log.error("not in the audit", cause=error.detail)
        return SlotState.of(outcome)

    async def last_words(self) -> None:
        await self.record(STOPPED, "stopped with the service; what is complete stays")

    async def record(self, outcome: str, text: str) -> None:
        """Write a line of the audit."""
        order = self._order
        event = AuditEvent(
            who=order.who, action=order.kind, target=order.target, outcome=outcome, doc=order.doc | ({"text": text} if text else {})
        )
        await asyncio.to_thread(self._audit.write, event)


class _TableOrderJob(_OrderJob, RetryingStore):
    """An order of a table: its end is what the push journal says. ``look``: how its push stands; None: nothing was written."""

    def __init__(self, order: _Order, audit: AuditBook, store: ServiceStore, clock: Clock, look: Callable[[], JobOutcome | None]) -> None:
        _OrderJob.__init__(self, order, audit)
        RetryingStore.__init__(self, store, clock)
        self._look = look

    async def end(self, outcome: JobOutcome) -> SlotState:
        return await super().end(put_right(await self._read(self._look), outcome))

    async def last_words(self) -> None:
        """Say by the journal where it stands; what is open the next start takes back."""
        done = await asyncio.to_thread(self._look) or JobOutcome("failed", "the service ended before anything was written")
        log.warning("an order was stopped with the service", kind=self.name, word=done.word, text=done.text)
        await self.record(done.word, f"{done.text} (stopped with the service)")


def full_campaigns(
    ground: Ground, names: tuple[str, ...], measure: MeasureCampaign, may: Callable[[str], Awaitable[bool]]
) -> FullCampaigns:
    """What the registry of jobs needs to start full campaigns.

    Parameters
    ----------
    ground : Ground
        Where; its ``may`` is not asked.
    names : tuple of str
        What can be started.
    measure : callable
        Does it.
    may : callable
        ``await may(who)``: whether somebody may propose tables.
    """

    def of(recipe: str, who: str) -> ByHand | None:
        if not is_full(recipe, names):
            return None

        async def do(progress: ProgressSink, control: Control) -> JobOutcome:
            return await measure(CampaignOrder(recipe, person(who), progress, control))

        async def work(begun: datetime, control: Control) -> SlotState:
            job = _OrderJob(_Order(CAMPAIGN, who, f"{ground.machine}, {recipe}", {}, do), ground.audit)
            return await carry_out(job, Schedule(BY_HAND, "", "UTC", recipe), begun, control, ground.watchers)

        return work

    return FullCampaigns(names, of, may)


class Orders(RetryingStore):
    """Takes orders of tables and carries them out as jobs.

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
        requested = JobRequest(asked.request, asked.who, asked.key, f"{ROLLBACK} of push {asked.push}, {asked.crc:08X}: {asked.reason}")
        refused = await self._refused(
            requested, "order a table back", self._hands.ordered_rollback is None and "this service has no controller"
        )
        if refused is not None:
            return refused
        try:
            now = await asyncio.to_thread(offered, self._store, self._ground.machine, self._ground.control)
        except TableRefused as no:
            return _answer(asked.request, "conflict", str(no))
        if (now.push, now.crc) != (asked.push, asked.crc):
            what = f"meanwhile another table is in force: {now.crc:08X} of push {now.push}; look at it first"
            return _answer(asked.request, "conflict", what)
        return self._begun(requested, f"{ROLLBACK} of push {asked.push}", self._back(asked), ROLLBACK)

    def _back(self, asked: RollBack) -> _TableOrderJob:
        number, ordered_rollback = secrets.token_hex(6), self._hands.ordered_rollback
        assert ordered_rollback is not None

        async def do(progress: ProgressSink, control: Control) -> JobOutcome:
            return await ordered_rollback(BackOrder(asked.push, asked.crc, Ordered(asked.who, asked.reason, number, control)))

        doc = {"reason": asked.reason, "order": number, "push": asked.push, "crc": f"{asked.crc:08X}"}
        target = f"{self._ground.machine}, table of push {asked.push} ({asked.crc:08X})"
        return self._job(_Order(ROLLBACK, asked.who, target, doc, do), lambda: ordered(self._store, self._ground.machine, number))

    async def push(self, asked: PushNow) -> Answer:
        """Begin to push a proposal whose approval holds, once for each key; its verification before is measured first."""
        requested = JobRequest(asked.request, asked.who, asked.key, f"{PUSH} of proposal {asked.proposal}")
        refused = await self._refused(requested, "order a push", self._hands.push is None and BY_ITSELF)
        if refused is not None:
            return refused
        try:
            against, after = await asyncio.to_thread(self._not_approved, asked.proposal)
        except NotStored as error:
            return _answer(asked.request, "unknown", error.detail)
        if against:
            return _answer(asked.request, "conflict", against)
        return self._begun(requested, f"{PUSH} of proposal {asked.proposal}", self._approved(asked, after), PUSH)

    def _not_approved(self, proposal: int) -> tuple[str, int]:
        """Why a proposal cannot be pushed as it stands, and the number of the last push."""
        machine, found = self._ground.machine, load(self._store, proposal)
        now = proposal_status(self._store, proposal, found, self._clock.utc().timestamp())
        after = last_push(self._store, machine)
        if found.candidate.machine != machine:
            return f"proposal {proposal} is for {found.candidate.machine}, not for {machine}", after
        return "" if now.word == "approved" else f"proposal {proposal} is {now.word}: {now.text}", after

    def _approved(self, asked: PushNow, after: int) -> _TableOrderJob:
        push, machine = self._hands.push, self._ground.machine
        assert push is not None

        async def begun() -> None:
            """The audit has it already."""

        async def do(progress: ProgressSink, control: Control) -> JobOutcome:
            return await push(PushOrder(asked.proposal, begun, progress, control))

        doc = {"proposal": asked.proposal, "after": after}
        target = f"{machine}, proposal {asked.proposal}"
        return self._job(_Order(PUSH, asked.who, target, doc, do), lambda: in_force(self._store, machine, asked.proposal, after))

    async def _refused(self, requested: JobRequest, words: str, missing: str | Literal[False]) -> Answer | None:
        """The answer to who may not, to what was asked for before, and while something runs; None: go on."""
        if not await self._ground.may(requested.who):
            return _answer(requested.request, "forbidden", f"{requested.who} may not {words} here")
        again = self._book.again(requested)
        if again is not None:
            return again
        if missing:
            return _answer(requested.request, "conflict", missing)
        running = self._book.running
        if running is not None:  # before the journal is asked: what pushes now would look like what was left open
            return _answer(requested.request, "busy", f"the machine measures: {running.schedule or running.recipe}")
        return None

    def _job(self, order: _Order, look: Callable[[], JobOutcome | None]) -> _TableOrderJob:
        return _TableOrderJob(order, self._ground.audit, self._store, self._clock, look)

    def _begun(self, requested: JobRequest, name: str, job: _TableOrderJob, kind: JobKind) -> Answer:
        terms = Schedule(BY_HAND, "", "UTC", name)
        return self._book.begin(requested, terms, lambda begun, control: carry_out(job, terms, begun, control, self._ground.watchers), kind)


def _answer(request: int, outcome: Word, text: str) -> Answer:
    return Answer("answer", request, outcome, text[:4000], "")
