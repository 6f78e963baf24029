"""The timetable at work: each slot claimed once, one job at a time, nothing missed in silence.

A slot that is due waits until it may start: no other check runs, no maintenance window, the machine as the schedule needs it. How long it
may wait is the schedule's grace; a slot found later than that is a missed one. What a slot ends as is in `abbe.service.scheduler.outcomes`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Protocol

import structlog

from abbe.service.clock import Clock
from abbe.service.domain.schedule import Schedule, Window
from abbe.service.scheduler import outcomes
from abbe.service.scheduler.job import FollowUp, FollowUps, RunJob, carry_out
from abbe.service.scheduler.ports import Doc, Readiness, SlotLedger, SlotState
from abbe.service.scheduler.ready import AlwaysReady
from abbe.service.scheduler.slots import next_slot, previous_slot, slots_after
from abbe.service.scheduler.waiting import Hindrance, Waiting, busy, maintenance, not_ready
from abbe.service.scheduler.windows import covering
from abbe.service.sequences.control import Control

log = structlog.get_logger("abbe.scheduler")

JUMP_S = 2.0
"""Wall clock and monotonic clock may differ by this much over one wait before we say that somebody set the clock."""

MAX_BACKLOG = 1000
"""More missed slots than this are written down as one span: a clock set to next year must not fill the disk."""

ADOPT_S = 900.0
"""How often slots are looked for that another service, which is gone, has left open."""

RunSlot = Callable[[Schedule, datetime], Awaitable[str]]
"""``await run(schedule, slot)``: runs the check of a slot; returns the state to write for it."""


class Alarms(Protocol):
    """Where the scheduler's own alarms go."""

    async def alarm(self, doc: Doc) -> None:
        """Queue an alarm."""
        ...


@dataclass(frozen=True, slots=True)
class LoopTerms:
    """On what terms slots start.

    Parameters
    ----------
    maintenance : sequence of Window
        Nothing starts in these.
    ready : Readiness
        Knows the preconditions.
    poll_s : float
        The longest wait: how soon a changed wall clock is noticed.
    recheck_s : float
        The longest wait while a slot waits for its preconditions.
    follow_ups : FollowUps, optional
        What is to be done beside the timetable; slots go first.
    run_job : callable, optional
        Runs the jobs of follow-ups; default: without a way to steer them.
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
        ``await run_slot(schedule, slot)`` returns the state to write for the slot.
    alarms : Alarms
        Gets missed and skipped slots and clock jumps.
    clock : Clock
        All waiting and all "now".
    terms : LoopTerms, optional
        Maintenance windows, preconditions, pace.
    """

    def __init__(
        self,
        schedules: Sequence[Schedule],
        ledger: SlotLedger,
        run_slot: RunSlot,
        alarms: Alarms,
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
        """Return what comes next of each schedule, soonest first."""
        now = self._clock.utc()
        due = [(schedule, slot) for schedule in self._schedules if (slot := next_slot(schedule, now)) is not None]
        return sorted(due, key=lambda pair: pair[1])

    async def run(self) -> None:
        """Work for ever. Cancelling stops a running job through its own cancellation, waits for it, and gives back what had to wait."""
        now = self._clock.utc()
        for schedule in self._schedules:
            # From the last slot we know of: what came due while the service was off is recorded, not forgotten.
            last = await self._ledger.last_claimed(schedule.name)
            self._move_cursor(schedule, now if last is None else min(last, now))
        self._adopt_at_s = self._clock.monotonic_s()
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._terms.ready.watch(), name="ready")
                while True:
                    await self._adopt()
                    for schedule in self._schedules:
                        await self._deal_with_due(schedule)
                    await self._start_what_may(tasks)
                    await self._start_follow_up(tasks)
                    await self._wait()
        finally:
            for waiting in self._waiting:
                await self._ledger.release(waiting.schedule.name, waiting.slot)

    def take(self, name: str) -> str:
        """Take the machine for a check that is not of the timetable; return what runs instead, or nothing. `give_back` it."""
        if self._running is None:
            self._running = name
            return ""
        return self._running

    def give_back(self) -> None:
        """The machine is free again: what waits for it may start."""
        self._running = None
        self._ended.set()

    def _move_cursor(self, schedule: Schedule, to: datetime) -> None:
        self._cursor[schedule.name] = to
        self._ahead[schedule.name] = slots_after(schedule, to)
        self._upcoming[schedule.name] = next(self._ahead[schedule.name], None)

    async def _adopt(self) -> None:
        """Decide on what a service that is gone has left open: what ran was broken off, what waited waits on."""
        if self._clock.monotonic_s() < self._adopt_at_s:
            return
        self._adopt_at_s = self._clock.monotonic_s() + ADOPT_S
        for schedule in self._schedules:
            for slot, ran in await self._ledger.adopt(schedule.name):
                if ran:
                    await self._end(schedule, slot, outcomes.broken_off(schedule.name, slot))
                else:
                    await self._take(schedule, slot)

    async def _deal_with_due(self, schedule: Schedule) -> None:
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
            due = await self._write_down_span(schedule, due[0], now)
            self._move_cursor(schedule, due[-1])
        if schedule.catch_up == "once":
            await self._stand_for(schedule, due[:-1], due[-1])
            due = due[-1:]
        for slot in due:
            if await self._ledger.claim(schedule.name, slot):
                await self._take(schedule, slot)

    async def _write_down_span(self, schedule: Schedule, first: datetime, now: datetime) -> list[datetime]:
        last = previous_slot(schedule, now) or first
        if await self._ledger.claim(schedule.name, first):
            await self._end(schedule, first, outcomes.whole_span(schedule.name, first, last))
        return [last]

    async def _stand_for(self, schedule: Schedule, older: Sequence[datetime], by: datetime) -> None:
        """Write down the older of several due slots: the run of the last one is for all of them, whichever service starts it."""
        ours = [slot for slot in older if await self._ledger.claim(schedule.name, slot)]
        for slot in ours:
            await self._end(schedule, slot, outcomes.stood_for(schedule.name, slot, by), tell=False)
        if ours:
            await self._tell(*outcomes.caught_up(schedule.name, ours, by))

    async def _take(self, schedule: Schedule, slot: datetime) -> None:
        """Decide on a slot that is ours: too late, or one that waits. Of one schedule no more than one waits."""
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

    async def _start_what_may(self, tasks: asyncio.TaskGroup) -> None:
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
                if now > waiting.grace_ends and not waiting.told:
                    waiting.told = True
                    await self._tell(*outcomes.still_waits(waiting, hindrance))
            else:
                self._running = waiting.schedule.name  # before anything is awaited: nothing else takes the machine now
                await self._ledger.begin(waiting.schedule.name, waiting.slot)
                self._waiting.remove(waiting)
                tasks.create_task(self._run_check(waiting.schedule, waiting.slot), name=f"check {waiting.schedule.name}")

    async def _hindrance(self, schedule: Schedule) -> Hindrance | None:
        """Return what keeps a schedule from starting now, the cheapest question first: devices are asked last."""
        if self._running is not None:
            return busy(self._running)
        window = covering(self._terms.maintenance, self._clock.utc())
        if window is not None:
            return maintenance(window.name)
        lack = await self._terms.ready.lack(schedule)
        return not_ready(lack) if lack else None

    async def _start_follow_up(self, tasks: asyncio.TaskGroup) -> None:
        """Start what no slot asks for, on the terms of its schedule."""
        if self._terms.follow_ups is None or self._running is not None:
            return
        due = await self._terms.follow_ups.due()
        if due is None or await self._hindrance(due.schedule) is not None or self._running is not None:
            return  # the last: a person took the machine while the devices were asked
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
            ended = outcomes.broken_off(schedule.name, slot)  # a defect: the service ends with it, and no person has stopped it
            raise
        finally:
            self.give_back()
            await self._end(schedule, slot, ended, tell=bool(ended.code))
            log.info("slot done", schedule=schedule.name, slot=slot.isoformat(), state=ended.state)

    async def _wait(self) -> None:
        """Sleep to the next slot, or to the next look at the clock, and notice if somebody set the clock meanwhile."""
        utc, monotonic_s = self._clock.utc(), self._clock.monotonic_s()
        moments = [slot for slot in self._upcoming.values() if slot is not None]
        # Once a slot's time is up it is given up, so no moment of those that wait lies in the past for longer than one turn.
        moments += [waiting.until for waiting in self._waiting if waiting.until is not None]
        longest_s = min(self._terms.poll_s, self._terms.recheck_s) if self._waiting else self._terms.poll_s
        until_s = min(((moment - utc).total_seconds() for moment in moments), default=longest_s)
        await self._nap(min(max(until_s, 0.0), longest_s))
        now = self._clock.utc()
        jump_s = (now - utc).total_seconds() - (self._clock.monotonic_s() - monotonic_s)
        if abs(jump_s) <= JUMP_S:
            return
        if jump_s < 0:
            # Slots already claimed stay claimed; without this a clock once set too far ahead would silence us until then.
            for schedule in self._schedules:
                self._move_cursor(schedule, min(self._cursor[schedule.name], now))
        await self._tell("SCH-003", f"the computer's clock jumped by {jump_s:+.0f} s to {now:%F %T} UTC")

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

    async def _end(self, schedule: Schedule, slot: datetime, outcome: outcomes.SlotOutcome, *, tell: bool = True) -> None:
        await self._ledger.finish(schedule.name, slot, outcome.state, outcome.text)
        if tell:
            await self._tell(outcome.code, outcome.text)

    async def _tell(self, code: str, what: str) -> None:
        log.warning(what, code=code)
        await self._alarms.alarm({"code": code, "what": what, "at_utc": self._clock.utc().isoformat()})
