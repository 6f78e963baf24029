"""Orders of people, run as jobs: a full campaign, a rollback to the previous table, or the push of an approved proposal.

Rights are decided here. The audit records who ordered and why before anything is done, and afterwards how it ended. The end of a push is
read from the push journal, not from reports.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import Answer, Outcome, PushNow, RollBack
from abbe.service.clock import Clock
from abbe.service.compensation.approved import PushOrder
from abbe.service.compensation.proposal_decisions import proposal_status
from abbe.service.compensation.proposal_doc import load
from abbe.service.compensation.rollback import RollbackOrder, RollbackRequest
from abbe.service.core.jobs import FullCampaigns, JobRegistry, JobRequest, by_hand, no_alarms
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.progress import JobKind, JobOutcome, ProgressSink
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AbbeError, NotStored, TableRefused
from abbe.service.scheduler.alarm_manager import AlarmManager
from abbe.service.scheduler.job import Job, failure
from abbe.service.scheduler.ports import SlotState
from abbe.service.scheduler.retrying_store import RetryingStore
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.recipes.campaigns import is_full
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import STOPPED, JournalView, RollbackOffer, reconciled
from abbe.service.verification.alarm_states import Alarm, Note

log = structlog.get_logger("abbe.orders")
CAMPAIGN: Final = "campaign"
ROLLBACK: Final = "rollback"
PUSH: Final = "push"
NO_PAUSE = "a table is being changed: stop the rollback, or let it finish"
OrderedRollback = Callable[[RollbackOrder], Awaitable[JobOutcome]]
"""``await rollback(order)``: restores the previous table; returns the outcome as far as it is known."""
Push = Callable[[PushOrder], Awaitable[JobOutcome]]
"""``await push(order)``: pushes the approved proposal; returns the outcome as far as it is known."""
BY_ITSELF = "this service pushes approved proposals by itself ([alarm] push), or has no controller"


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """A full campaign that a person started: its recipe, the proposer, the sink for progress, and the control that pauses and stops it.

    ``cause``: the alarm whose cause the campaign looks for, and the function that writes the alarm's lines; None: no alarm. ``resume``:
    the interrupted campaign that this one completes; empty: a new one.
    """

    recipe: str
    by: str
    progress: ProgressSink
    control: Control
    cause: tuple[Alarm, Note] | None = None
    resume: str = ""


MeasureCampaign = Callable[[CampaignOrder], Awaitable[JobOutcome]]
"""``await measure(order)``: measures, solves, proposes; if an alarm is the cause, its lines tell the outcome."""


@dataclass(frozen=True, slots=True)
class OrderActions:
    """Functions that carry out the orders: a rollback, and a push of an approved proposal; None if the order is not possible here."""

    ordered_rollback: OrderedRollback | None = None
    push: Push | None = None


@dataclass(frozen=True, slots=True)
class OrderContext:
    """The machine's name, ``await may(who)`` for the right to order, the audit, and the identity of the machine's control."""

    machine: str
    may: Callable[[str], Awaitable[bool]]
    audit: AuditBook
    control: str = ""


Action = Callable[[ProgressSink, Control], Awaitable[JobOutcome]]
"""``await act(progress, control)``: carries out the order."""


@dataclass(frozen=True, slots=True)
class _AuditTrail:
    """The audit records of one order; ``begun``: the first of them."""

    audit: AuditBook
    begun: AuditEvent

    async def write(self, outcome: str, text: str = "") -> None:
        """Write a record of the order's state."""
        doc = self.begun.doc | ({"text": text} if text else {})
        await asyncio.to_thread(self.audit.write, replace(self.begun, outcome=outcome, doc=doc))


class _OrderJob(Job[JobOutcome]):
    """An order, with its records in the audit."""

    def __init__(self, kind: JobKind, recipe: str, trail: _AuditTrail, act: Action) -> None:
        self.kind, self.terms = kind, by_hand(recipe)
        self._trail, self._act = trail, act

    async def begin(self) -> None:
        await self._trail.write("begun")

    async def do(self, progress: ProgressSink, control: Control) -> JobOutcome:
        control.now(State.RUNNING)
        control.no_pause_reason = NO_PAUSE if self.kind == ROLLBACK else ""  # a push measures first, and that can be paused
        return await self._act(progress, control)

    async def failed(self, error: Exception) -> JobOutcome:
        return failure(error)

    async def end(self, outcome: JobOutcome) -> SlotState:
        log.warning("order ended", kind=self.kind, who=self._trail.begun.who, word=outcome.word, text=outcome.text)
        try:
            await self._trail.write(outcome.word, outcome.text)
        except AbbeError as error:  # what was done is in the store; a service that ended here would do no more work
            log.error("audit record failed", cause=error.detail)
        return SlotState.of(outcome)

    async def interrupted(self) -> None:
        await self._trail.write(STOPPED, "stopped: the service stopped; completed runs are kept")


Look = Callable[[], JobOutcome | None]
"""Returns the outcome of an order as the push journal shows it; None: the order wrote nothing."""
RetryingLook = Callable[[Look], Awaitable[JobOutcome | None]]


class _TableOrderJob(_OrderJob):
    """An order for the tables; its outcome is read from the push journal. ``retrying(look)``: repeats ``look`` until the database
    answers."""

    def __init__(self, kind: JobKind, recipe: str, trail: _AuditTrail, act: Action, look: Look, retrying: RetryingLook) -> None:
        super().__init__(kind, recipe, trail, act)
        self._look, self._retrying = look, retrying

    async def end(self, outcome: JobOutcome) -> SlotState:
        return await super().end(reconciled(await self._retrying(self._look), outcome))

    async def interrupted(self) -> None:
        """Record the order's outcome by the push journal; the next start rolls back an open push."""
        done = await asyncio.to_thread(self._look) or JobOutcome("failed", "the service ended before anything was written")
        log.warning("order interrupted by the end of the service", kind=self.kind, word=done.word, text=done.text)
        await self._trail.write(done.word, f"{done.text} (stopped because the service stopped)")


def full_campaigns(
    context: OrderContext,
    names: tuple[str, ...],
    measure: MeasureCampaign,
    may: Callable[[str], Awaitable[bool]],
    alarms: AlarmManager | None = None,
) -> FullCampaigns:
    """Return the full campaigns as the registry of jobs needs them.

    Parameters
    ----------
    context : OrderContext
        Machine and audit; its ``may`` is not used.
    names : tuple of str
        Campaigns that can be started.
    measure : callable
        Measures, solves and proposes.
    may : callable
        ``await may(who)``: whether a user may propose tables.
    alarms : AlarmManager, optional
        The alarms whose cause a campaign can look for.
    """

    def of(recipe: str, who: str, alarm: int, resume: str) -> _OrderJob | None:
        if not is_full(recipe, names):
            return None

        async def act(progress: ProgressSink, control: Control) -> JobOutcome:
            order = CampaignOrder(recipe, person(who), progress, control, resume=resume)
            if not alarm or alarms is None:
                return await measure(order)

            async def look(one: Alarm, note: Note, progress: ProgressSink, control: Control) -> None:
                await measure(replace(order, cause=(one, note)))

            return await alarms.ordered(alarm, order.by, look, order.progress, order.control)

        target = f"{context.machine}, {recipe}" + (f", alarm {alarm}" if alarm else "") + (f", resumes {resume}" if resume else "")
        begun = AuditEvent(who=who, action=CAMPAIGN, target=target, outcome="begun", doc={})
        job = _OrderJob(CAMPAIGN, recipe, _AuditTrail(context.audit, begun), act)
        job.alarm = alarm or None
        return job

    return FullCampaigns(names, of, may, no_alarms if alarms is None else alarms.against)


class Orders(RetryingStore):
    """Takes orders for the tables and runs them as jobs. ``store`` holds the push journal."""

    def __init__(self, store: Store, clock: Clock, jobs: JobRegistry, context: OrderContext, actions: OrderActions) -> None:
        super().__init__(store, clock)
        self._jobs, self._context, self._actions = jobs, context, actions

    async def rollback(self, asked: RollBack) -> Answer:
        """Begin a rollback, once for each key; refused if another table is in force than the user saw, or there is no previous table."""
        requested = JobRequest(asked.request, asked.who, asked.key, f"{ROLLBACK} of push {asked.push}, {asked.crc:08X}: {asked.reason}")
        refused = await self._refused(
            requested, "order a rollback", self._actions.ordered_rollback is None and "this service has no controller"
        )
        if refused is not None:
            return refused
        try:
            now = await asyncio.to_thread(self._offered)
        except TableRefused as no:
            return _answer(asked.request, "conflict", str(no))
        if (now.push, now.crc) != (asked.push, asked.crc):
            what = f"another table has come into force meanwhile: {now.crc:08X} of push {now.push}; check it first"
            return _answer(asked.request, "conflict", what)
        return self._jobs.begin(requested, self._rollback_job(asked))

    def _offered(self) -> RollbackOffer:
        return JournalView.read(self._store, self._context.machine, self._context.control).offer()

    def _rollback_job(self, asked: RollBack) -> _TableOrderJob:
        number, ordered_rollback = secrets.token_hex(6), self._actions.ordered_rollback
        assert ordered_rollback is not None

        async def act(progress: ProgressSink, control: Control) -> JobOutcome:
            return await ordered_rollback(RollbackOrder(asked.push, asked.crc, RollbackRequest(asked.who, asked.reason, number, control)))

        doc = {"reason": asked.reason, "order": number, "push": asked.push, "crc": f"{asked.crc:08X}"}
        target = f"{self._context.machine}, table of push {asked.push} ({asked.crc:08X})"
        begun = AuditEvent(who=asked.who, action=ROLLBACK, target=target, outcome="begun", doc=doc)

        def look() -> JobOutcome | None:
            return JournalView.read(self._store, self._context.machine).of_order(number)

        return _TableOrderJob(ROLLBACK, f"{ROLLBACK} of push {asked.push}", self._trail(begun), act, look, self._read)

    async def push(self, asked: PushNow) -> Answer:
        """Begin to push an approved proposal, once for each key; the job first measures a verification with the present table."""
        requested = JobRequest(asked.request, asked.who, asked.key, f"{PUSH} of proposal {asked.proposal}")
        refused = await self._refused(requested, "order a push", self._actions.push is None and BY_ITSELF)
        if refused is not None:
            return refused
        try:
            against, after = await asyncio.to_thread(self._not_approved, asked.proposal)
        except NotStored as error:
            return _answer(asked.request, "unknown", error.detail)
        if against:
            return _answer(asked.request, "conflict", against)
        return self._jobs.begin(requested, self._push_job(asked, after))

    def _not_approved(self, proposal: int) -> tuple[str, int]:
        """Return why a proposal cannot be pushed now (empty: it can), and the number of the last push."""
        machine, found = self._context.machine, load(self._store, proposal)
        journal = JournalView.read(self._store, machine)
        after = journal.last_push
        if found.candidate.machine != machine:
            return f"proposal {proposal} is for {found.candidate.machine}, not for {machine}", after
        now = proposal_status(self._store, proposal, found, self._clock.utc().timestamp(), journal)
        return "" if now.word == "approved" else f"proposal {proposal} is {now.word}: {now.text}", after

    def _push_job(self, asked: PushNow, after: int) -> _TableOrderJob:
        push, machine = self._actions.push, self._context.machine
        assert push is not None

        async def in_audit() -> None:
            """Do nothing: the audit already has a record of the beginning."""

        async def act(progress: ProgressSink, control: Control) -> JobOutcome:
            return await push(PushOrder(asked.proposal, in_audit, progress, control))

        doc, target = {"proposal": asked.proposal, "after": after}, f"{machine}, proposal {asked.proposal}"
        begun = AuditEvent(who=asked.who, action=PUSH, target=target, outcome="begun", doc=doc)

        def look() -> JobOutcome | None:
            return JournalView.read(self._store, machine).of_proposal(asked.proposal, after)

        return _TableOrderJob(PUSH, f"{PUSH} of proposal {asked.proposal}", self._trail(begun), act, look, self._read)

    async def _refused(self, requested: JobRequest, order: str, missing: str | Literal[False]) -> Answer | None:
        """Return the refusal if the user has no right, repeats a request, or another job runs; None: proceed."""
        if not await self._context.may(requested.who):
            return _answer(requested.request, "forbidden", f"{requested.who} may not {order} here")
        earlier = self._jobs.earlier_answer(requested)
        if earlier is not None:
            return earlier
        if missing:
            return _answer(requested.request, "conflict", missing)
        running = self._jobs.running
        if running is not None:  # before reading the journal: a running push would look like an interrupted one
            return _answer(requested.request, "busy", f"the machine is in use: {running.schedule or running.recipe}")
        return None

    def _trail(self, begun: AuditEvent) -> _AuditTrail:
        return _AuditTrail(self._context.audit, begun)


def _answer(request: int, outcome: Outcome, text: str) -> Answer:
    return Answer("answer", request, outcome, text[:4000], "")


def may(store: Store, who: str, need: Permission) -> bool:
    """Return whether ``who`` (``user:NAME`` or ``token:NAME/TOKEN``) can log in and has a role with the right ``need``."""
    name = person(who)
    user = store.people.find(name) if name else None
    if user is None or user.disabled_utc is not None:
        return False
    return any(user.role == role and need in ALLOWED[role] for role in Role)  # an unknown role allows nothing


def person(who: str) -> str:
    """Return the user's name in ``user:NAME`` or ``token:NAME/TOKEN``; empty for anything else."""
    kind, _, rest = who.partition(":")
    return rest.partition("/")[0] if kind in {"user", "token"} else ""
