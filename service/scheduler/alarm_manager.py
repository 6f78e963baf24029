"""The alarm desk: holds each check against the history, keeps the alarms, says what is to be done when the machine is free."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import structlog

from abbe.service.audit.book import AuditBook, this_account
from abbe.service.audit.chain import Event
from abbe.service.clock import Clock
from abbe.service.compensation.push_approved import Approved, PushOrder, next_approved
from abbe.service.domain.schedule import Needs, Schedule
from abbe.service.errors import AbbeError, Aborted, MachineInUse, Stopped, StoreError
from abbe.service.events import Progress, ProgressSink
from abbe.service.jobs.investigate import Note
from abbe.service.scheduler import record
from abbe.service.scheduler.job import FAILURES
from abbe.service.scheduler.ports import Doc, FollowUp, JobWatcher, SlotState
from abbe.service.scheduler.retrying_store import RetryingStore
from abbe.service.scheduler.store import ServiceStore
from abbe.service.sequences.control import Control, State
from abbe.service.storage.records import AlarmEntryRecord
from abbe.service.tables.push_outcome import OPEN, STOPPED, PushOutcome, by_journal, in_force, last_push
from abbe.service.verification.alarm_states import NO_ALARM, Alarm, AlarmKind, folded, next_step
from abbe.service.verification.alarms import READ_CHECKS, alarm_numbered, check_line, last_seq, look

log = structlog.get_logger("abbe.alarm")

CODES = {
    AlarmKind.RAISED: "ALM-001",
    AlarmKind.CLEARED: "ALM-002",
    AlarmKind.PROPOSED: "ALM-003",
    AlarmKind.ENDED: "ALM-004",
    AlarmKind.FAILED: "ALM-005",
    AlarmKind.PUSHED: "ALM-006",
}
"""Lines that the broker is told of, and how the message is called."""
SAID = {OPEN: "is open", STOPPED: "was stopped"}
"""Words of outcomes that make no sentence by themselves."""
NOTHING_YET = PushOutcome("failed", "the service ended before anything was written")
LAST_WORDS_S = 1.0
"""A service that ends has five seconds for everything."""


@dataclass(frozen=True, slots=True)
class Duties:
    """What the service does about alarms.

    Parameters
    ----------
    warn_days : float
        Alarm when a limit may be reached within so many days; 0: never.
    campaign : str
        What is measured for an alarm, for people.
    investigate : callable
        ``await investigate(alarm, note, progress, control)``.
    push : callable or None
        ``await push(order)``, which returns what was heard of it; None: the service pushes nothing.
    """

    warn_days: float
    campaign: str
    investigate: Callable[[Alarm, Note, ProgressSink, Control], Awaitable[None]]
    push: Callable[[PushOrder], Awaitable[PushOutcome]] | None = None


@dataclass(frozen=True, slots=True)
class Telling:
    """Whom the desk tells: topic of alarms (None: no broker), who is woken for it, the audit, and who watches jobs."""

    topic: str | None
    posted: Callable[[], None]
    audit: AuditBook
    watchers: Sequence[JobWatcher] = ()


class AlarmManager(RetryingStore):
    """Alarms of one machine: `checked` after each check, `due` whenever the machine is free.

    Parameters
    ----------
    store : ServiceStore
        Where checks, alarms, proposals and pushes are.
    clock : Clock
        Now.
    machine : str
        Its name.
    schedules : sequence of Schedule
        The timetable: who asks for proposals, and on which terms work may start.
    duties : Duties
        What is done.
    telling : Telling
        Whom it is told.
    """

    def __init__(
        self, store: ServiceStore, clock: Clock, machine: str, schedules: Sequence[Schedule], duties: Duties, telling: Telling
    ) -> None:
        super().__init__(store, clock)
        self._machine = machine
        self._schedules = tuple(schedules)
        self._duties = duties
        self._telling = telling
        self._checked_again: set[tuple[int, int]] = set()

    async def checked(self, doc: Doc, number: int) -> str:
        """Hold a kept verification against those before it; raise, hold or clear the alarm of its recipe. Returns that as a sentence."""
        recipe, warn_days = doc["recipe"], self._duties.warn_days
        records = await self._read(self._store.verifications_of, self._machine, READ_CHECKS)
        looked = await self._read(look, self._store, self._machine, recipe, records, warn_days)
        if looked.kind is None:
            return ""
        line = check_line(looked, recipe, doc["schedule"], number)
        entry = await self._line(None if looked.now is None else looked.now.number, looked.kind, line)
        return f"alarm {entry.alarm} {looked.kind}: {looked.found.text}"

    async def due(self) -> FollowUp | None:
        """Return what may start now: first the check after a push, then a push, then an investigation."""
        try:
            entries = await asyncio.to_thread(self._store.alarm_entries, self._machine)
            entries = await self._pushes_settled(entries)
            alarms = [one for one in folded(entries) if one.active]
            return self._check_again(alarms) or await self._push(entries) or self._investigation(alarms)
        except StoreError as trouble:
            log.warning("alarms cannot be read now", cause=trouble.detail)
            return None

    async def _pushes_settled(self, entries: list[AlarmEntryRecord]) -> list[AlarmEntryRecord]:
        """A push that was begun and never told of was interrupted with the service; one that was told as open may have been closed since.

        Which table is in force is read from the journal. Nothing of it is begun again here.
        """
        last = {e.alarm: e for e in entries if e.kind in (AlarmKind.PUSHING, AlarmKind.PUSHED)}
        told = False
        for entry in last.values():
            if entry.kind == AlarmKind.PUSHED and entry.doc.get("word") != OPEN:
                continue
            proposal, after = int(entry.doc["proposal"]), int(entry.doc.get("after", 0))
            now = await asyncio.to_thread(in_force, self._store, self._machine, proposal, after) or NOTHING_YET
            if entry.kind == AlarmKind.PUSHING or now.word != OPEN:
                text = f"{now.text} (it was interrupted with the service)" if entry.kind == AlarmKind.PUSHING else now.text
                await self._tell_pushed(entry.alarm, proposal, after, PushOutcome(now.word, text))
                told = True
        return await asyncio.to_thread(self._store.alarm_entries, self._machine) if told else entries

    async def _tell_pushed(self, alarm: int, proposal: int, after: int, done: PushOutcome) -> None:
        text = f"proposal {proposal} {SAID.get(done.word, done.word)}: {done.text}"
        await self._line(alarm, AlarmKind.PUSHED, {"proposal": proposal, "after": after, "word": done.word, "text": text})

    def _check_again(self, alarms: Sequence[Alarm]) -> FollowUp | None:
        """After a push that was kept the check that raised the alarm is made once at once: the trend begins anew with it."""
        for one in alarms:
            pushed = one.last(AlarmKind.PUSHED)
            schedule = self._schedule_of(one)
            if pushed is None or pushed.doc.get("word") != "kept" or one.held_seq > pushed.seq or schedule is None:
                continue
            if (one.number, pushed.seq) not in self._checked_again:
                # Marked when it begins: an errand that may not start yet is offered again.
                begun = partial(self._checked_again.add, (one.number, pushed.seq))
                return FollowUp(f"{schedule.name} (after push)", schedule, begun=begun)
        return None

    async def _push(self, entries: Sequence[AlarmEntryRecord]) -> FollowUp | None:
        if self._duties.push is None:
            return None
        now_s = self._clock.utc().timestamp()
        found = await asyncio.to_thread(next_approved, self._store, self._machine, entries, now_s)
        if found is None:
            return None
        one = next((a for a in folded(entries) if a.number == found.alarm), None)
        asked = self._schedule_of(one) if one is not None else None
        needs = Needs() if asked is None else asked.needs
        terms = Schedule(f"push of proposal {found.proposal}", "", "UTC", "push", needs=replace(needs, idle=True))
        return FollowUp(terms.name, terms, partial(self._pushed, found, terms), "push")

    def _investigation(self, alarms: Sequence[Alarm]) -> FollowUp | None:
        for one in alarms:
            schedule = self._schedule_of(one)
            if schedule is not None and schedule.on_alarm == "propose" and next_step(one) is not None:
                needs = replace(schedule.needs, idle=True)  # a machine at work, or in another process's hands, is waited for
                terms = replace(schedule, name=f"investigation of alarm {one.number}", recipe=self._duties.campaign, needs=needs)
                return FollowUp(terms.name, terms, partial(self._investigated, one, terms), "investigation")
        return None

    def _schedule_of(self, one: Alarm) -> Schedule | None:
        """The schedule that raised an alarm; if it is gone, one of the same recipe."""
        same = [s for s in self._schedules if s.recipe == one.recipe]
        return next((s for s in same if s.name == one.schedule), next(iter(same), None))

    async def _investigated(self, one: Alarm, terms: Schedule, control: Control) -> str:
        last = SlotState("done: nothing")

        async def note(kind: AlarmKind, doc: Doc) -> Alarm:
            nonlocal last
            await self._line(one.number, kind, doc)
            last = SlotState(f"done: {kind}", doc["text"])
            return await self._read(alarm_numbered, self._store, self._machine, one.number)

        self._begin(terms)
        try:
            await control.unless_aborted(self._investigate(one, note, control))
        except MachineInUse as busy:
            return _waits(busy)
        except Exception as error:
            await note(AlarmKind.FAILED, _failed(error))
            # A defect of this program ends the service, as in a check; but its line stays: the next one must not fall over it again.
            if _is_defect(error):
                raise
        finally:
            control.now(State.ENDED)
            self._end()
        return last

    async def _investigate(self, one: Alarm, note: Note, control: Control) -> None:
        await self._duties.investigate(one, note, self._progress, control)

    async def _pushed(self, found: Approved, terms: Schedule, control: Control) -> str:
        after = await self._read(last_push, self._store, self._machine)
        text = f"proposal {found.proposal} is being pushed"
        begun: Doc = {"proposal": found.proposal, "approval": found.approval, "after": after, "text": text}
        told: list[AlarmEntryRecord] = []

        async def tell_begun() -> None:
            if not told:
                told.append(await self._line(found.alarm, AlarmKind.PUSHING, begun))

        self._begin(terms)
        try:
            said = await control.unless_aborted(self._push_now(PushOrder(found.proposal, tell_begun, self._progress, control)))
        except MachineInUse as busy:
            return _waits(busy)
        except asyncio.CancelledError:
            if told:
                await self._stopped_with_the_service(found, after)
            raise
        except Exception as error:
            if _is_defect(error):
                raise
            await tell_begun()
            ended = isinstance(error, Stopped | Aborted)
            said = PushOutcome(
                STOPPED if ended else "failed", "; ".join([record.cause_of(error)["what"], *getattr(error, "__notes__", [])])
            )
        finally:
            control.now(State.ENDED)
            self._end()
        done = await self._read(by_journal, self._store, self._machine, found.proposal, after, said)
        await self._tell_pushed(found.alarm, found.proposal, after, done)
        return SlotState(f"done: {done.word}", done.text)

    async def _push_now(self, order: PushOrder) -> PushOutcome:
        assert self._duties.push is not None
        return await self._duties.push(order)

    async def _stopped_with_the_service(self, found: Approved, after: int) -> None:
        """Say by the journal where it stands, now, if the database takes it at once; else the next start says it."""
        try:
            async with asyncio.timeout(LAST_WORDS_S):
                done = await asyncio.to_thread(in_force, self._store, self._machine, found.proposal, after) or NOTHING_YET
                log.warning("the push was stopped with the service", word=done.word, text=done.text)
                text = f"{done.text} (stopped with the service)"
                await self._tell_pushed(found.alarm, found.proposal, after, PushOutcome(done.word, text))
        except (AbbeError, TimeoutError) as trouble:
            log.warning("the push was stopped with the service; the next start says where it stands", cause=str(trouble))

    def _begin(self, terms: Schedule) -> None:
        for watcher in self._telling.watchers:
            watcher.job_started(terms, self._clock.utc())

    def _progress(self, progress: Progress) -> None:
        for watcher in self._telling.watchers:
            watcher.job_progress(progress)

    def _end(self) -> None:
        for watcher in self._telling.watchers:
            watcher.job_ended(None)

    async def _line(self, number: int | None, kind: AlarmKind, doc: Doc) -> AlarmEntryRecord:
        """Write a line with its message and its record in the audit."""
        messages = []
        if self._telling.topic is not None and kind in CODES:
            head = {"schema": record.SCHEMA, "machine": self._machine, "code": CODES[kind], "at_utc": self._clock.utc().isoformat()}
            messages.append((self._telling.topic, head | {"kind": str(kind), "what": doc["text"], "signals": doc.get("signals", [])}))

        def append() -> AlarmEntryRecord:
            seq = 0 if number is None else last_seq(self._store.alarm_entries(self._machine), number) + 1
            return self._store.add_alarm_entry(self._machine, number, seq, str(kind), doc, messages)

        entry = await self._write(append)
        if messages:
            self._telling.posted()
        log.warning(doc["text"], alarm=entry.alarm, kind=str(kind))
        if kind is not AlarmKind.HELD:
            target = f"{self._machine}, alarm {entry.alarm}" if entry.alarm != NO_ALARM else self._machine
            try:
                event = Event(this_account(), "abbe serve", target, str(kind), {"text": doc["text"]})
                await asyncio.to_thread(self._telling.audit.write, event)
            except AbbeError as error:  # the line itself is kept: a service that ends here would warn of nothing more
                log.error("not in the audit", cause=error.detail)
        return entry


def _failed(error: Exception) -> Doc:
    cause = record.cause_of(error)
    if isinstance(error, Stopped | Aborted):
        return {"text": f"the investigation was ended by a person: {cause['what']}", "cause": cause}
    return {"text": f"the investigation could not go on: {cause['what']}", "cause": cause}


def _is_defect(error: Exception) -> bool:
    """Whether something other than devices, data and numerics failed."""
    return not isinstance(error, FAILURES) and not (isinstance(error, ExceptionGroup) and error.split(FAILURES)[1] is None)


def _waits(busy: MachineInUse) -> str:
    log.info("waiting for another process", cause=str(busy))
    return SlotState("waits", str(busy))
