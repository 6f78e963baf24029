"""Manage alarms: compare each check with the history, store the alarms, offer their follow-up work when the machine is free."""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import structlog

from abbe.service.audit.book import AuditBook, this_account
from abbe.service.clock import Clock
from abbe.service.compensation.approved import ApprovedProposal, PushOrder, next_approved
from abbe.service.domain.document import Doc
from abbe.service.domain.progress import JobOutcome, ProgressSink
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind, AuditEvent
from abbe.service.errors import AbbeError, Aborted, MachineInUse, Stopped, StoreError
from abbe.service.scheduler.job import FollowUp, Job, failure
from abbe.service.scheduler.ports import SlotState
from abbe.service.scheduler.retrying_store import RetryingStore
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import OPEN, STOPPED, JournalView, reconciled
from abbe.service.verification import verify
from abbe.service.verification.alarm_rules import READ_CHECKS, check_facts, evaluate_alarm
from abbe.service.verification.alarm_states import NO_ALARM, Alarm, Note, folded, step_alone
from abbe.service.verification.alarms import alarm_numbered, alarms_of, last_seq

log = structlog.get_logger("abbe.alarm")

CODES = {
    AlarmKind.RAISED: "ALM-001",
    AlarmKind.CLEARED: "ALM-002",
    AlarmKind.PROPOSED: "ALM-003",
    AlarmKind.ENDED: "ALM-004",
    AlarmKind.FAILED: "ALM-005",
    AlarmKind.PUSHED: "ALM-006",
}
"""Published kinds of entries, and the code of their messages."""
OUTCOME_TEXTS = {OPEN: "is open", STOPPED: "was stopped"}
"""Text for outcome words that make no sentence by themselves."""
NOTHING_YET = JobOutcome("failed", "the service ended before anything was written")
WAITS = "waits"


Investigate = Callable[[Alarm, Note, ProgressSink, Control], Awaitable[None]]
"""``await investigate(alarm, note, progress, control)``: takes an alarm to a proposal or to the reason why there is none."""


@dataclass(frozen=True, slots=True)
class Duties:
    """Reactions of the service to alarms.

    Parameters
    ----------
    warn_days : float
        Alarm when a limit may be reached within this many days; 0: never.
    campaign : str
        Recipe of the full campaign that an investigation measures, for people.
    investigate : callable
        ``await investigate(alarm, note, progress, control)``.
    push : callable or None
        ``await push(order)`` returns the outcome as far as it is known; None: the service does not push by itself.
    """

    warn_days: float
    campaign: str
    investigate: Investigate
    push: Callable[[PushOrder], Awaitable[JobOutcome]] | None = None


@dataclass(frozen=True, slots=True)
class AlarmChannels:
    """Recipients of alarms: the topic of their messages (None: no broker), the callback that wakes the publisher, and the audit."""

    topic: str | None
    posted: Callable[[], None]
    audit: AuditBook


class AlarmManager(RetryingStore):
    """Alarms of one machine: call `checked` after each check, `due` whenever the machine is free.

    Parameters
    ----------
    store : Store
        Holds checks, alarms, proposals and pushes.
    schedules : sequence of Schedule
        The timetable: which schedules ask for proposals, and the preconditions of follow-up work.
    """

    def __init__(
        self, store: Store, clock: Clock, machine: str, schedules: Sequence[Schedule], duties: Duties, channels: AlarmChannels
    ) -> None:
        super().__init__(store, clock)
        self._machine = machine
        self._schedules = tuple(schedules)
        self.duties = duties
        """Reactions of the service to alarms."""
        self._channels = channels
        self._checked_again: set[tuple[int, int]] = set()

    async def checked(self, doc: Doc, number: int) -> str:
        """Compare a stored verification with earlier ones; raise, keep or clear its recipe's alarm. Return the effect as text, or empty."""
        recipe, warn_days = doc["recipe"], self.duties.warn_days
        records = await self._read(self._store.verifications.of_machine, self._machine, READ_CHECKS)
        looked = await self._read(evaluate_alarm, self._store, self._machine, recipe, records, warn_days)
        if looked.kind is None:
            return ""
        line = check_facts(looked, recipe, doc["schedule"], number)
        entry = await self.line(None if looked.now is None else looked.now.number, looked.kind, line)
        return f"alarm {entry.alarm} {looked.kind}: {looked.found.text}"

    async def due(self) -> FollowUp | None:
        """Return the work that may start now: first the check after a push, then a push, then an investigation."""
        try:
            entries = await asyncio.to_thread(self._store.alarms.entries, self._machine)
            entries = await self._pushes_settled(entries)
            alarms = [one for one in folded(entries) if one.active]
            return self._check_again(alarms) or await self._push(entries) or self._investigation(alarms)
        except StoreError as trouble:
            log.warning("the alarms cannot be read; trying again later", cause=trouble.detail)
            return None

    async def _pushes_settled(self, entries: list[AlarmEntryRecord]) -> list[AlarmEntryRecord]:
        """Record the outcome of each push that was interrupted when the service stopped, or was still open when last recorded.

        The table in force is read from the journal. No push is restarted here.
        """
        last = {e.alarm: e for e in entries if e.kind in (AlarmKind.PUSHING, AlarmKind.PUSHED)}
        changed = False
        for entry in last.values():
            if entry.kind == AlarmKind.PUSHED and entry.facts.word != OPEN:
                continue
            proposal, after = entry.facts.proposal or 0, entry.facts.after
            now = await asyncio.to_thread(self._of_proposal, proposal, after) or NOTHING_YET
            if entry.kind == AlarmKind.PUSHING or now.word != OPEN:
                text = f"{now.text} (it was interrupted when the service stopped)" if entry.kind == AlarmKind.PUSHING else now.text
                await self._record_pushed(entry.alarm, proposal, after, JobOutcome(now.word, text))
                changed = True
        return await asyncio.to_thread(self._store.alarms.entries, self._machine) if changed else entries

    async def note(self, number: int, kind: AlarmKind, facts: AlarmFacts) -> Alarm:
        """Write an entry of an alarm; return the alarm including it."""
        await self.line(number, kind, facts)
        return await self._read(alarm_numbered, self._store, self._machine, number)

    async def settled(self, found: ApprovedProposal, after: int, reported: JobOutcome) -> JobOutcome:
        """Record the end of the push that followed push number ``after``, as the push journal shows it; return the outcome."""
        done = reconciled(await self._read(self._of_proposal, found.proposal, after), reported)
        await self._record_pushed(found.alarm, found.proposal, after, done)
        return done

    async def last_push(self) -> int:
        """Return the number of the machine's last push."""
        return (await self._read(JournalView.read, self._store, self._machine)).last_push

    async def interrupted(self, found: ApprovedProposal, after: int) -> None:
        """Record at once the state of a push that is interrupted because the service stops."""
        done = await asyncio.to_thread(self._of_proposal, found.proposal, after) or NOTHING_YET
        log.warning("the push was interrupted by the end of the service", word=done.word, text=done.text)
        text = f"{done.text} (stopped because the service stopped)"
        await self._record_pushed(found.alarm, found.proposal, after, JobOutcome(done.word, text))

    def _of_proposal(self, proposal: int, after: int) -> JobOutcome | None:
        """Return the outcome of a proposal's last push after push number ``after``, from the present journal; None if there is none."""
        return JournalView.read(self._store, self._machine).of_proposal(proposal, after)

    async def _record_pushed(self, alarm: int, proposal: int, after: int, done: JobOutcome) -> None:
        text = f"proposal {proposal} {OUTCOME_TEXTS.get(done.word, done.word)}: {done.text}"
        await self.line(alarm, AlarmKind.PUSHED, AlarmFacts(proposal=proposal, after=after, word=done.word, text=text))

    def _check_again(self, alarms: Sequence[Alarm]) -> FollowUp | None:
        """Return the check to repeat once after a kept push: the one that raised the alarm. Its trend starts anew with this check."""
        for one in alarms:
            pushed = one.last(AlarmKind.PUSHED)
            schedule = self._schedule_of(one)
            if pushed is None or pushed.facts.word != "kept" or one.judged_seq > pushed.seq or schedule is None:
                continue
            if (one.number, pushed.seq) not in self._checked_again:
                # Marked only when it begins: a check that may not start yet is offered again.
                begun = partial(self._checked_again.add, (one.number, pushed.seq))
                return FollowUp(replace(schedule, name=f"{schedule.name} (after push)"), begun=begun)
        return None

    async def _push(self, entries: Sequence[AlarmEntryRecord]) -> FollowUp | None:
        if self.duties.push is None:
            return None
        now_s = self._clock.utc().timestamp()
        found = await asyncio.to_thread(next_approved, self._store, self._machine, entries, now_s)
        if found is None:
            return None
        one = next((a for a in folded(entries) if a.number == found.alarm), None)
        asked = self._schedule_of(one) if one is not None else None
        needs = Needs() if asked is None else asked.needs
        terms = Schedule(f"push of proposal {found.proposal}", "", "UTC", "push", needs=replace(needs, idle=True))
        return FollowUp(terms, self.push_job(found, terms))

    def push_job(self, found: ApprovedProposal, terms: Schedule) -> Job[JobOutcome]:
        """Return the push of an approved proposal as a job."""
        return _ApprovedPush(self, found, terms)

    def _investigation(self, alarms: Sequence[Alarm]) -> FollowUp | None:
        for one in alarms:
            schedule = self._schedule_of(one)
            if schedule is not None and schedule.on_alarm == "propose" and step_alone(one) is not None:
                needs = replace(schedule.needs, idle=True)  # wait while the machine works or another process uses it
                terms = replace(schedule, name=f"investigation of alarm {one.number}", recipe=self.duties.campaign, needs=needs)
                return FollowUp(terms, _Investigation(self, one, terms, self.duties.investigate))
        return None

    async def against(self, number: int) -> str:
        """Return why the cause of an alarm cannot be searched now; an empty text if it can."""
        known = await self._read(alarms_of, self._store, self._machine)
        one = next((one for one in known if one.number == number), None)
        if one is None:
            return f"{self._machine} has no alarm {number}"
        return "" if one.active else f"alarm {number} is over: the last check passed, and there is no cause to look for"

    async def ordered(self, number: int, by: str, look: Investigate, progress: ProgressSink, control: Control) -> JobOutcome:
        """Investigate an alarm because the user ``by`` asked for it: resume after its last entry, or start anew if it has an answer.

        Raises
        ------
        Exception
            As `look` raises; an entry of the alarm records the error, unless another process has the machine.
        """
        alarm = await self.note(number, AlarmKind.ORDERED, AlarmFacts(name=by, text=f"{by} has started the search for the cause"))
        terms = Schedule(f"investigation of alarm {number}", "", "UTC", self.duties.campaign)
        return await _Investigation(self, alarm, terms, look).told(progress, control)

    def _schedule_of(self, one: Alarm) -> Schedule | None:
        """Return the schedule that raised an alarm; if it no longer exists, another schedule of the same recipe."""
        same = [s for s in self._schedules if s.recipe == one.recipe]
        return next((s for s in same if s.name == one.schedule), next(iter(same), None))

    async def line(self, number: int | None, kind: AlarmKind, facts: AlarmFacts) -> AlarmEntryRecord:
        """Write an entry with its message and its record in the audit."""
        messages = []
        if self._channels.topic is not None and kind in CODES:
            head = {"schema": verify.SCHEMA, "machine": self._machine, "code": CODES[kind], "at_utc": self._clock.utc().isoformat()}
            messages.append(
                (self._channels.topic, head | {"kind": str(kind), "what": facts.text, "signals": [asdict(one) for one in facts.signals]})
            )

        def append() -> AlarmEntryRecord:
            seq = 0 if number is None else last_seq(self._store.alarms.entries(self._machine), number) + 1
            return self._store.alarms.append(self._machine, number, seq, kind, facts, messages)

        entry = await self._write(append)
        if messages:
            self._channels.posted()
        log.warning(facts.text, alarm=entry.alarm, kind=str(kind))
        if kind is not AlarmKind.CONTINUED:
            target = f"{self._machine}, alarm {entry.alarm}" if entry.alarm != NO_ALARM else self._machine
            try:
                event = AuditEvent(who=this_account(), action="abbe serve", target=target, outcome=str(kind), doc={"text": facts.text})
                await asyncio.to_thread(self._channels.audit.write, event)
            except AbbeError as error:  # the entry itself is stored: a service that ended here would raise no more alarms
                log.error("the audit record of an alarm was not written", cause=error.detail)
        return entry


class _AlarmJob(Job[JobOutcome]):
    """Work for an alarm. It waits while another process uses the machine; this does not count as a try."""

    def __init__(self, manager: AlarmManager, terms: Schedule) -> None:
        self._manager, self.terms = manager, terms

    async def do(self, progress: ProgressSink, control: Control) -> JobOutcome:
        try:
            return await self.work(progress, control)
        except MachineInUse as busy:
            log.info("waiting for another process", cause=str(busy))
            return JobOutcome(WAITS, str(busy))

    @abstractmethod
    async def work(self, progress: ProgressSink, control: Control) -> JobOutcome:
        """Do the work, once the machine is free."""

    async def end(self, outcome: JobOutcome) -> SlotState:
        return SlotState(WAITS, outcome.text) if outcome.word == WAITS else SlotState.of(outcome)


class _Investigation(_AlarmJob):
    """Takes an alarm to a proposal or to the reason why there is none. Each step is an entry of the alarm; the last one is the outcome."""

    kind = "investigation"

    def __init__(self, manager: AlarmManager, alarm: Alarm, terms: Schedule, look: Investigate) -> None:
        super().__init__(manager, terms)
        self.alarm = alarm.number
        self._alarm, self._look, self._last = alarm, look, JobOutcome("nothing", "")

    async def work(self, progress: ProgressSink, control: Control) -> JobOutcome:
        await self._look(self._alarm, self._note, progress, control)
        return self._last

    async def told(self, progress: ProgressSink, control: Control) -> JobOutcome:
        """Do the work as a part of another job; a failure becomes an entry of the alarm."""
        try:
            return await self.work(progress, control)
        except MachineInUse:
            raise
        except Exception as error:
            await self.failed(error)
            raise

    async def failed(self, error: Exception) -> JobOutcome:
        cause = verify.cause_of(error)
        how = "was ended by a person" if isinstance(error, Stopped | Aborted) else "failed"
        await self._note(AlarmKind.FAILED, AlarmFacts(text=f"the investigation {how}: {cause.what}", cause=cause))
        return self._last

    async def defect(self, error: Exception) -> None:
        """Record the defect, so that the next service does not fail at the same alarm again."""
        await self.failed(error)

    async def _note(self, kind: AlarmKind, facts: AlarmFacts) -> Alarm:
        self._last = JobOutcome(str(kind), facts.text, proposal=facts.proposal)
        return await self._manager.note(self._alarm.number, kind, facts)


class _ApprovedPush(_AlarmJob):
    """A push that a person approved. It counts as a try once its first entry is written; its outcome is read from the push journal."""

    kind = "push"

    def __init__(self, manager: AlarmManager, found: ApprovedProposal, terms: Schedule) -> None:
        super().__init__(manager, terms)
        self.alarm = found.alarm or None  # a push without an alarm is recorded under `NO_ALARM`
        self._found, self._after, self._is_begun = found, 0, False

    async def begin(self) -> None:
        self._after = await self._manager.last_push()

    async def work(self, progress: ProgressSink, control: Control) -> JobOutcome:
        push = self._manager.duties.push
        assert push is not None
        return await push(PushOrder(self._found.proposal, self._begun, progress, control))

    async def _begun(self) -> None:
        if not self._is_begun:
            text = f"proposal {self._found.proposal} is being pushed"
            found = self._found
            facts = AlarmFacts(proposal=found.proposal, approval=found.approval, after=self._after, text=text)
            await self._manager.line(found.alarm, AlarmKind.PUSHING, facts)
            self._is_begun = True

    async def failed(self, error: Exception) -> JobOutcome:
        await self._begun()
        return failure(error)

    async def end(self, outcome: JobOutcome) -> SlotState:
        if outcome.word != WAITS:
            outcome = await self._manager.settled(self._found, self._after, outcome)
        return await super().end(outcome)

    async def interrupted(self) -> None:
        """Record the state that the push journal shows; if there is no time left, the next start of the service records it."""
        if self._is_begun:
            await self._manager.interrupted(self._found, self._after)
