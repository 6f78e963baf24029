"""The checks of this run of the service, by number: those of the timetable and those that a person starts; and how a person steers them.

Rights are decided here, not where a request comes from: the web process says who asks, and the users' table says what he may.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Protocol

import structlog

from service.channel.messages import MOST_JOBS, Answer, JobSeen, Outcome, StartJob, SteerJob
from service.clock import Clock
from service.scheduler.slots import Schedule
from service.sequences.control import Control, State

log = structlog.get_logger("abbe.jobs")

MOST_KEYS = 1000
BY_HAND = "by hand"

Run = Callable[[Schedule, datetime, Control], Awaitable[tuple[str, int]]]
"""``await run(schedule, slot, control)``: how the check ended, and the number of its verification."""


class Place(Protocol):
    """Who sees to it that one check runs at a time."""

    def take(self, name: str) -> str:
        """Take the machine; return what runs on it instead, or nothing."""
        ...

    def give_back(self) -> None:
        """The machine is free again."""
        ...


@dataclass
class _Job:
    seen: JobSeen
    control: Control = field(default_factory=Control)
    task: asyncio.Task[str] | None = None


class JobBook:
    """Knows every check since the service began, the latest `MOST_JOBS` of them by number.

    Parameters
    ----------
    run : callable
        Runs one check.
    recipes : sequence of str
        What a person may start.
    may : callable
        ``await may(who)``: whether somebody may start and steer measurements, by the table of users as it is now.
    clock : Clock
        Times of jobs.
    changed : callable
        Told whenever a job begins, changes or ends.
    """

    def __init__(
        self, run: Run, recipes: Sequence[str], may: Callable[[str], Awaitable[bool]], clock: Clock, changed: Callable[[], None]
    ) -> None:
        self._run, self._recipes, self._may, self._clock, self._changed = run, tuple(recipes), may, clock, changed
        self._jobs: OrderedDict[str, _Job] = OrderedDict()
        self._keys: OrderedDict[tuple[str, str], tuple[str, str]] = OrderedDict()
        self._now: _Job | None = None
        self.place: Place | None = None
        """Where a job by hand is started; None: nowhere (``--once``, or not yet)."""
        self._tasks: asyncio.TaskGroup | None = None

    def open(self, place: Place, tasks: asyncio.TaskGroup) -> None:
        """From now on people may start jobs; they run in ``tasks``."""
        self.place, self._tasks = place, tasks

    async def close(self) -> None:
        """Nothing is started any more, and what was started by hand is stopped: the devices hold the motion."""
        self.place = None
        running = [job.task for job in self._jobs.values() if job.task is not None and not job.task.done()]
        for task in running:
            task.cancel()
        if running:
            await asyncio.wait(running)

    # ---- what runs --------------------------------------------------------------------------------------------------

    async def __call__(self, schedule: Schedule, slot_utc: datetime) -> str:
        """Run the check of a slot; return the slot's state. This is the scheduler's job."""
        return await self._carry_out(self._new(schedule, ""), schedule, slot_utc)

    def _new(self, schedule: Schedule, who: str) -> _Job:
        number = secrets.token_hex(6)
        by_hand = "" if who else schedule.name
        job = _Job(JobSeen(number, schedule.recipe, by_hand, who, State.READY, "", self._clock.utc(), None, None))
        self._jobs[number] = job
        while len(self._jobs) > MOST_JOBS:
            self._jobs.popitem(last=False)
        return job

    async def _carry_out(self, job: _Job, schedule: Schedule, slot_utc: datetime) -> str:
        state, number = "interrupted", None
        self._now = job
        self._changed()
        try:
            state, number = await self._run(schedule, slot_utc, job.control)
        finally:
            self._now = None
            job.seen = replace(job.seen, state=str(state), ended_utc=self._clock.utc(), verification=number)
            self._changed()
        return state

    async def _by_hand(self, job: _Job, schedule: Schedule, place: Place) -> str:
        try:
            return await self._carry_out(job, schedule, job.seen.begun_utc)
        finally:
            place.give_back()

    # ---- what is seen -----------------------------------------------------------------------------------------------

    @property
    def running(self) -> JobSeen | None:
        """The job that runs, with the state of its measurement."""
        return None if self._now is None else self._look(self._now)

    def seen(self) -> tuple[JobSeen, ...]:
        """The latest jobs, newest first."""
        return tuple(self._look(job) for job in reversed(self._jobs.values()))

    def _look(self, job: _Job) -> JobSeen:
        if job.seen.ended_utc is not None:
            return job.seen
        now = job.control.situation
        return replace(job.seen, state=State.RUNNING if now.state is State.READY else now.state, text=now.why)

    # ---- what is asked for ------------------------------------------------------------------------------------------

    async def start(self, asked: StartJob) -> Answer:
        """Start a declared recipe, once for each key."""
        refused = await self._refused(asked.who)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        known = self._keys.get((asked.who, asked.key)) if asked.key else None
        if known is not None:
            same = known[1] == asked.recipe
            return _answer(asked.request, "done" if same else "conflict", "" if same else "this key was used for another recipe", known[0])
        if asked.recipe not in self._recipes:
            return _answer(asked.request, "unknown", f"there is no recipe {asked.recipe!r} here; there are: {', '.join(self._recipes)}")
        if self.place is None or self._tasks is None:
            return _answer(asked.request, "busy", "the service starts, ends, or runs its timetable once; it takes no jobs")
        schedule = Schedule(BY_HAND, "", "UTC", asked.recipe)
        other = self.place.take(f"{BY_HAND}: {asked.recipe}")
        if other:
            return _answer(asked.request, "busy", f"the machine measures: {other}")
        job = self._new(schedule, asked.who)
        if asked.key:
            self._keys[asked.who, asked.key] = (job.seen.id, asked.recipe)
            while len(self._keys) > MOST_KEYS:
                self._keys.popitem(last=False)
        job.task = self._tasks.create_task(self._by_hand(job, schedule, self.place), name=f"job {job.seen.id}")
        log.info("job started", job=job.seen.id, recipe=asked.recipe, who=asked.who)
        return _answer(asked.request, "done", "", job.seen.id)

    async def steer(self, asked: SteerJob) -> Answer:
        """Stop, abort, pause or go on with the job that runs."""
        refused = await self._refused(asked.who)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        job = self._jobs.get(asked.job)
        if job is None:
            return _answer(asked.request, "unknown", f"there is no job {asked.job!r} since the service began")
        if job.seen.ended_utc is not None:
            return _answer(asked.request, "conflict", f"this job has ended: {job.seen.state}", asked.job)
        if job.control.state is State.ENDED:
            return _answer(asked.request, "conflict", "the measurement of this job is over; its figures are judged now", asked.job)
        {"stop": job.control.stop, "abort": job.control.abort, "pause": job.control.pause, "resume": job.control.resume}[asked.how]()
        log.info("job steered", job=asked.job, how=asked.how, who=asked.who)
        self._changed()
        return _answer(asked.request, "done", "", asked.job)

    async def _refused(self, who: str) -> str:
        return "" if await self._may(who) else f"{who} may not measure here"


def _answer(request: int, outcome: Outcome, text: str = "", job: str = "") -> Answer:
    return Answer("answer", request, outcome, text[:4000], job)
