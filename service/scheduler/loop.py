"""Run the timetable: each slot is claimed once, one job runs at a time, and every missed slot is reported.

A due slot waits until no other check runs, no maintenance window is open and the machine meets the schedule's preconditions. It waits at
most for the schedule's grace period; a slot found later is missed. With ``catch_up = "once"`` it waits without limit.
`abbe.service.scheduler.outcomes` lists the outcomes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Protocol

import structlog

from abbe.service.clock import Clock
from abbe.service.domain.document import Doc
from abbe.service.domain.schedule import Schedule, Window
from abbe.service.scheduler import outcomes
from abbe.service.scheduler.job import FollowUp, FollowUps, RunJob, carry_out
from abbe.service.scheduler.outcomes import Hindrance, Waiting, busy, maintenance, not_ready
from abbe.service.scheduler.ports import Readiness, SlotLedger, SlotState
from abbe.service.scheduler.ready import AlwaysReady
from abbe.service.scheduler.slots import covering, next_slot, previous_slot, slots_after, time_rule
from abbe.service.sequences.control import Control

log = structlog.get_logger("abbe.scheduler")

JUMP_S = 2.0
"""Wall clock and monotonic clock may differ by this much over one wait, s; beyond it the clock was set."""

MAX_BACKLOG = 1000
"""More missed slots than this are recorded as one span: a clock set to next year must not fill the disk."""

ADOPT_S = 900.0
"""Time between two searches for open slots of a service that is gone, s."""

RunSlot = Callable[[Schedule, datetime], Awaitable[str]]
"""``await run(schedule, slot)``: runs the check of a slot; returns the state to record for it."""


class AlarmSink(Protocol):
    """Recipient of the scheduler's own alarms."""

    async def alarm(self, doc: Doc) -> None:
        """Queue an alarm."""
        ...


@dataclass(frozen=True, slots=True)
class LoopTerms:
    """Conditions and pace of the scheduler.

    Parameters
    ----------
    maintenance : sequence of Window
        Windows in which nothing starts.
    ready : Readiness
        Checks the preconditions.
    poll_s : float
        Longest wait, s: how soon a changed wall clock is noticed.
    recheck_s : float
        Longest wait while a slot waits for its preconditions, s.
    follow_ups : FollowUps, optional
        Work outside the timetable; slots go first.
    run_job : callable, optional
        Runs the jobs of follow-ups; without it people cannot see or steer them.
    """

    maintenance: Sequence[Window] = ()
    ready: Readiness = field(default_factory=AlwaysReady)
    poll_s: float = 30.0
    recheck_s: float = 30.0
    follow_ups: FollowUps | None = None
    run_job: RunJob | None = None


class Scheduler:
    """Runs the jobs of one machine.

    Parameters
    ----------
    schedules : sequence of Schedule
        The timetable.
    ledger : SlotLedger
        Remembers slots across restarts; its ``claim`` makes each of them run once.
    run_slot : callable
        ``await run_slot(schedule, slot)`` returns the state to record for the slot.
    alarms : AlarmSink
        Gets missed and skipped slots and clock jumps.
    terms : LoopTerms, optional
        Maintenance windows, preconditions, pace.
    """

    def __init__(
        self,
        schedules: Sequence[Schedule],
        ledger: SlotLedger,
        run_slot: RunSlot,
        alarms: AlarmSink,
        clock: Clock,
        terms: LoopTerms | None = None,
    ) -> None:
        self._schedules = tuple(schedules)
        self._ledger = ledger
        self._run_slot = run_slot
        self._alarms = alarms
        self._clock = clock
        self._terms = terms or LoopTerms()
        self._cursor: dict[str, datetime] = {}
        self._ahead: dict[str, Iterator[datetime]] = {}
        self._upcoming: dict[str, datetime | None] = {}
        self._running: str | None = None
        self._waiting: list[Waiting] = []
        self._ended = asyncio.Event()
        self._adopt_at_s = 0.0

    def next_due(self) -> list[tuple[Schedule, datetime]]:
        """Return the next slot of each schedule, soonest first."""
        now = self._clock.utc()
        due = [(schedule, slot) for schedule in self._schedules if (slot := next_slot(schedule, now)) is not None]
        return sorted(due, key=lambda pair: pair[1])

    async def run(self) -> None:
        """Work forever. When cancelled, cancel a running job, wait until it has ended, and release the waiting slots."""
        now = self._clock.utc()
        since = await self._ledger.in_force_since({one.name: time_rule(one) for one in self._schedules}, now)
        for schedule in self._schedules:
            # From the last known slot on: slots that came due while the service was off are recorded. A changed time rule was not in force
            # then: its slots before the change were never due.
            last = await self._ledger.last_claimed(schedule.name)
            self._move_cursor(schedule, now if last is None else min(max(last, since[schedule.name]), now))
        self._adopt_at_s = self._clock.monotonic_s()
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._terms.ready.watch(), name="ready")
                while True:
                    await self._adopt()
                    for schedule in self._schedules:
                        await self._handle_due(schedule)
                    await self._start_waiting(tasks)
                    await self._start_follow_up(tasks)
                    await self._wait()
        finally:
            for waiting in self._waiting:
                await self._ledger.release(waiting.schedule.name, waiting.slot)

    def take(self, name: str) -> str:
        """Take the machine for work outside the timetable until `give_back`; return "", or the name of the work that has it."""
        if self._running is None:
            self._running = name
            return ""
        return self._running

    def give_back(self) -> None:
        """Release the machine: waiting slots may start."""
        self._running = None
        self._ended.set()

    def _move_cursor(self, schedule: Schedule, to: datetime) -> None:
        self._cursor[schedule.name] = to
        self._ahead[schedule.name] = slots_after(schedule, to)
        self._upcoming[schedule.name] = next(self._ahead[schedule.name], None)

    async def _adopt(self) -> None:
        """Take over the open slots of a service that is gone: a running check was interrupted, a waiting slot keeps waiting."""
        if self._clock.monotonic_s() < self._adopt_at_s:
            return
        self._adopt_at_s = self._clock.monotonic_s() + ADOPT_S
        for schedule in self._schedules:
            for slot, ran in await self._ledger.adopt(schedule.name):
                if ran:
                    await self._end(schedule, slot, outcomes.broken_off(schedule.name, slot))
                else:
                    await self._take(schedule, slot)

    async def _handle_due(self, schedule: Schedule) -> None:
        now = self._clock.utc()
        upcoming = self._upcoming[schedule.name]
        if upcoming is None or upcoming > now:
            return
        due: list[datetime] = []
        while upcoming is not None and upcoming <= now and len(due) <= MAX_BACKLOG:
            due.append(upcoming)
            upcoming = next(self._ahead[schedule.name], None)
        self._cursor[schedule.name], self._upcoming[schedule.name] = due[-1], upcoming
        if len(due) > MAX_BACKLOG:
            due = await self._record_span(schedule, due[0], now)
            self._move_cursor(schedule, due[-1])
        if schedule.catch_up == "once":
            await self._stand_for(schedule, due[:-1], due[-1])
            due = due[-1:]
        for slot in due:
            if await self._ledger.claim(schedule.name, slot):
                await self._take(schedule, slot)

    async def _record_span(self, schedule: Schedule, first: datetime, now: datetime) -> list[datetime]:
        last = previous_slot(schedule, now) or first
        if await self._ledger.claim(schedule.name, first):
            await self._end(schedule, first, outcomes.whole_span(schedule.name, first, last))
        return [last]

    async def _stand_for(self, schedule: Schedule, older: Sequence[datetime], by: datetime) -> None:
        """Record the older of several due slots: the run of the last one stands for all of them, whichever service starts it."""
        ours = [slot for slot in older if await self._ledger.claim(schedule.name, slot)]
        for slot in ours:
            await self._end(schedule, slot, outcomes.stood_for(schedule.name, slot, by), alarm=False)
        if ours:
            await self._raise_alarm(*outcomes.caught_up(schedule.name, ours, by))

    async def _take(self, schedule: Schedule, slot: datetime) -> None:
        """Let a claimed slot wait, or record it as missed if it is too late. At most one slot of a schedule waits."""
        late = self._clock.utc() - slot
        if schedule.catch_up == "skip" and late > timedelta(seconds=schedule.grace_s):
            await self._end(schedule, slot, outcomes.found_late(schedule, slot, late))
            return
        if schedule.catch_up == "skip" and self._running == schedule.name:
            await self._end(schedule, slot, outcomes.overrun(schedule.name, slot))
            return
        new = Waiting(schedule, slot)
        for other in [one for one in self._waiting if one.schedule.name == schedule.name]:
            older, new = (other, new) if other.slot < slot else (new, other)
            if schedule.catch_up == "skip":
                await self._end(schedule, older.slot, outcomes.superseded(older, new.slot))
            else:
                await self._end(schedule, older.slot, outcomes.stood_for(schedule.name, older.slot, new.slot, older.hindrance))
            self._waiting.remove(other)
        self._waiting.append(new)

    async def _start_waiting(self, tasks: asyncio.TaskGroup) -> None:
        self._ended.clear()
        for waiting in sorted(self._waiting, key=lambda one: one.slot):
            now, until = self._clock.utc(), waiting.until
            hindrance = await self._hindrance(waiting.schedule)
            if hindrance is None and self._running is not None:  # taken while the devices were asked
                hindrance = busy(self._running)
            if until is not None and (now > until or (hindrance is not None and now >= until)):
                hindrance = hindrance or waiting.hindrance
                self._waiting.remove(waiting)
                late = outcomes.found_late(waiting.schedule, waiting.slot, now - waiting.slot)
                await self._end(
                    waiting.schedule, waiting.slot, late if hindrance is None else outcomes.kept_from_starting(waiting, hindrance)
                )
            elif hindrance is not None:
                waiting.hindrance = hindrance
                if now > waiting.grace_ends and not waiting.alarmed:
                    waiting.alarmed = True
                    await self._raise_alarm(*outcomes.still_waits(waiting, hindrance))
            else:
                self._running = waiting.schedule.name  # before anything is awaited, so that nothing else takes the machine
                await self._ledger.begin(waiting.schedule.name, waiting.slot)
                self._waiting.remove(waiting)
                tasks.create_task(self._run_check(waiting.schedule, waiting.slot), name=f"check {waiting.schedule.name}")

    async def _hindrance(self, schedule: Schedule) -> Hindrance | None:
        """Return what keeps a schedule from starting now. The cheapest question comes first; devices are asked last."""
        if self._running is not None:
            return busy(self._running)
        window = covering(self._terms.maintenance, self._clock.utc())
        if window is not None:
            return maintenance(window.name)
        lack = await self._terms.ready.lack(schedule)
        return not_ready(lack) if lack else None

    async def _start_follow_up(self, tasks: asyncio.TaskGroup) -> None:
        """Start work outside the timetable, under the preconditions of its schedule."""
        if self._terms.follow_ups is None or self._running is not None:
            return
        due = await self._terms.follow_ups.due()
        if due is None or await self._hindrance(due.schedule) is not None or self._running is not None:
            return  # the last condition: a person took the machine while the devices were asked
        self._running = due.name
        if due.begun is not None:
            due.begun()
        tasks.create_task(self._run_follow_up(due), name=due.name)

    async def _run_follow_up(self, due: FollowUp) -> None:
        try:
            if due.job is None:
                await self._run_slot(due.schedule, self._clock.utc())
            elif self._terms.run_job is not None:
                await self._terms.run_job(due.job)
            else:
                await carry_out(due.job, self._clock.utc(), Control())
        finally:
            self.give_back()
            log.info("follow-up done", follow_up=due.name)

    async def _run_check(self, schedule: Schedule, slot: datetime) -> None:
        ended = outcomes.stopped(schedule.name, slot)
        try:
            state = await self._run_slot(schedule, slot)
            ended = outcomes.SlotOutcome(state, "", state.reason if isinstance(state, SlotState) else "")
        except Exception:
            ended = outcomes.broken_off(schedule.name, slot)  # a defect: the service ends with it, and no person stopped it
            raise
        finally:
            self.give_back()
            await self._end(schedule, slot, ended, alarm=bool(ended.code))
            log.info("slot done", schedule=schedule.name, slot=slot.isoformat(), state=ended.state)

    async def _wait(self) -> None:
        """Sleep until the next slot or the next look at the clock, and notice if the clock was set meanwhile."""
        utc, monotonic_s = self._clock.utc(), self._clock.monotonic_s()
        instants = [slot for slot in self._upcoming.values() if slot is not None]
        # A slot whose time is up is dropped, so the deadline of a waiting slot lies in the past for at most one turn.
        instants += [waiting.until for waiting in self._waiting if waiting.until is not None]
        longest_s = min(self._terms.poll_s, self._terms.recheck_s) if self._waiting else self._terms.poll_s
        until_s = min(((instant - utc).total_seconds() for instant in instants), default=longest_s)
        await self._nap(min(max(until_s, 0.0), longest_s))
        now = self._clock.utc()
        jump_s = (now - utc).total_seconds() - (self._clock.monotonic_s() - monotonic_s)
        if abs(jump_s) <= JUMP_S:
            return
        if jump_s < 0:
            # Claimed slots stay claimed; without this a clock once set too far ahead would stop the timetable until then.
            for schedule in self._schedules:
                self._move_cursor(schedule, min(self._cursor[schedule.name], now))
        await self._raise_alarm("SCH-003", f"the computer's clock jumped by {jump_s:+.0f} s to {now:%F %T} UTC")

    async def _nap(self, seconds: float) -> None:
        """Sleep, or, while a slot waits for the machine, until the running check has ended."""
        if not self._waiting or (self._running is None and not self._ended.is_set()):
            await self._clock.sleep(seconds)
            return
        naps = [asyncio.ensure_future(self._clock.sleep(seconds)), asyncio.ensure_future(self._ended.wait())]
        try:
            await asyncio.wait(naps, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for nap in naps:
                nap.cancel()

    async def _end(self, schedule: Schedule, slot: datetime, outcome: outcomes.SlotOutcome, *, alarm: bool = True) -> None:
        await self._ledger.finish(schedule.name, slot, outcome.state, outcome.text)
        if alarm:
            await self._raise_alarm(outcome.code, outcome.text)

    async def _raise_alarm(self, code: str, what: str) -> None:
        log.warning(what, code=code)
        await self._alarms.alarm({"code": code, "what": what, "at_utc": self._clock.utc().isoformat()})
