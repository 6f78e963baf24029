"""The timetable at work: each slot claimed once, one job at a time, nothing missed in silence.

A slot ends in one of these states, written to the ledger (at most 30 characters; the sentence goes into the alarm):
``done: <verdict>``, ``skipped: busy`` (another check was running), ``missed: <how> late`` (found too late: moving a machine hours
after the planned time would surprise whoever stands there), ``interrupted`` (the service was stopped).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from datetime import datetime, timedelta
from itertools import islice
from typing import Protocol

import structlog

from service.clock import Clock
from service.scheduler.ports import Doc, Ledger
from service.scheduler.slots import Schedule, next_slot, slots_between

log = structlog.get_logger("abbe.scheduler")

JUMP_S = 2.0
"""Wall clock and monotonic clock may differ by this much over one wait before we say that somebody set the clock."""

MAX_BACKLOG = 1000
"""More missed slots than this are reported as one span: a clock set to next year must not fill the disk."""

Job = Callable[[Schedule, datetime], Awaitable[str]]


class Alarms(Protocol):
    """Where the scheduler's own alarms go."""

    async def alarm(self, doc: Doc) -> None:
        """Queue an alarm."""
        ...


class Scheduler:
    """Runs the jobs of one machine.

    Parameters
    ----------
    schedules : sequence of Schedule
        The timetable.
    ledger : Ledger
        Remembers slots across restarts; its ``claim`` makes each of them run once.
    job : callable
        ``await job(schedule, slot)`` returns the state to write for the slot.
    alarms : Alarms
        Told of missed and skipped slots and of clock jumps.
    clock : Clock
        All waiting and all "now".
    poll_s : float, optional
        The longest wait: how soon a changed wall clock is noticed.
    """

    def __init__(
        self, schedules: Sequence[Schedule], ledger: Ledger, job: Job, alarms: Alarms, clock: Clock, *, poll_s: float = 30.0
    ) -> None:
        self._schedules = tuple(schedules)
        self._ledger = ledger
        self._job = job
        self._alarms = alarms
        self._clock = clock
        self._poll_s = poll_s
        self._cursor: dict[str, datetime] = {}
        self._upcoming: dict[str, datetime | None] = {}
        self._running: str | None = None

    def next_due(self) -> list[tuple[Schedule, datetime]]:
        """Return what comes next of each schedule, soonest first."""
        now = self._clock.utc()
        due = [(schedule, slot) for schedule in self._schedules if (slot := next_slot(schedule, now)) is not None]
        return sorted(due, key=lambda pair: pair[1])

    async def run(self) -> None:
        """Work for ever. Cancelling stops a running job through its own cancellation, and waits for it."""
        now = self._clock.utc()
        for schedule in self._schedules:
            # From the last slot we know of: what came due while the service was off is recorded, not forgotten.
            last = await self._ledger.last_claimed(schedule.name)
            self._move_cursor(schedule, now if last is None else min(last, now))
        async with asyncio.TaskGroup() as tasks:
            while True:
                for schedule in self._schedules:
                    await self._deal_with_due(schedule, tasks)
                await self._wait()

    def _move_cursor(self, schedule: Schedule, to: datetime) -> None:
        self._cursor[schedule.name] = to
        self._upcoming[schedule.name] = next_slot(schedule, to)

    async def _deal_with_due(self, schedule: Schedule, tasks: asyncio.TaskGroup) -> None:
        now = self._clock.utc()
        upcoming = self._upcoming[schedule.name]
        if upcoming is None or upcoming > now:
            return
        due = list(islice(slots_between(schedule, self._cursor[schedule.name], now), MAX_BACKLOG + 1))
        if len(due) > MAX_BACKLOG:
            self._move_cursor(schedule, now)
            await self._tell("SCH-004", f"{schedule.name}: more than {MAX_BACKLOG} slots missed between {due[0]:%F %R} and {now:%F %R} UTC")
            return
        self._move_cursor(schedule, due[-1])
        for slot in due:
            if await self._ledger.claim(schedule.name, slot):
                await self._decide(schedule, slot, tasks)

    async def _decide(self, schedule: Schedule, slot: datetime, tasks: asyncio.TaskGroup) -> None:
        late = self._clock.utc() - slot
        if late > timedelta(seconds=schedule.grace_s):
            await self._ledger.finish(schedule.name, slot, f"missed: {_span(late)} late")
            allowed = _span(timedelta(seconds=schedule.grace_s))
            await self._tell(
                "SCH-001", f"{schedule.name}: slot {slot:%F %R} UTC was missed: found {_span(late)} late, allowed are {allowed}"
            )
        elif self._running is not None:
            await self._ledger.finish(schedule.name, slot, "skipped: busy")
            await self._tell("SCH-002", f"{schedule.name}: slot {slot:%F %R} UTC was skipped: {self._running!r} was still running")
        else:
            self._running = schedule.name
            tasks.create_task(self._run_job(schedule, slot), name=f"check {schedule.name}")

    async def _run_job(self, schedule: Schedule, slot: datetime) -> None:
        state = "interrupted"
        try:
            state = await self._job(schedule, slot)
        finally:
            self._running = None
            await self._ledger.finish(schedule.name, slot, state)
            log.info("slot done", schedule=schedule.name, slot=slot.isoformat(), state=state)

    async def _wait(self) -> None:
        """Sleep to the next slot, or to the next look at the clock, and notice if somebody set the clock meanwhile."""
        utc, monotonic_s = self._clock.utc(), self._clock.monotonic_s()
        until_s = min(((slot - utc).total_seconds() for slot in self._upcoming.values() if slot is not None), default=self._poll_s)
        await self._clock.sleep(min(max(until_s, 0.0), self._poll_s))
        now = self._clock.utc()
        jump_s = (now - utc).total_seconds() - (self._clock.monotonic_s() - monotonic_s)
        if abs(jump_s) <= JUMP_S:
            return
        if jump_s < 0:
            # Slots already claimed stay claimed; without this a clock once set too far ahead would silence us until then.
            for schedule in self._schedules:
                self._move_cursor(schedule, min(self._cursor[schedule.name], now))
        await self._tell("SCH-003", f"the computer's clock jumped by {jump_s:+.0f} s to {now:%F %T} UTC")

    async def _tell(self, code: str, what: str) -> None:
        log.warning(what, code=code)
        await self._alarms.alarm({"code": code, "what": what, "at_utc": self._clock.utc().isoformat()})


def _span(length: timedelta) -> str:
    seconds = length.total_seconds()
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172800 else f"{seconds / 86400:.0f} days"
