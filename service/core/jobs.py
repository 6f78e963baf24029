"""The jobs of this run of the service, by number, and how a person steers them: checks of the timetable, checks and full campaigns that a
person starts, and what follows from alarms: investigations and pushes. What a person orders of tables (`abbe.service.core.orders`) is a job
too.

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

from abbe.service.campaigns.builtin_recipes import parted
from abbe.service.channel.messages import MOST_JOBS, Answer, DoneByHand, Outcome, StartJob, SteerJob
from abbe.service.clock import Clock
from abbe.service.domain.bounds import TEXT, WORD
from abbe.service.domain.job_state import JobKind, JobState
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.ports import FollowUp, SlotState
from abbe.service.sequences.control import Control, State

log = structlog.get_logger("abbe.jobs")

MOST_KEYS = 1000
BY_HAND = "by hand"
AGAIN = "asked for before, with this key"
"""Text of the answer to what was done before."""
ASKING = "asking"
"""State of a job that waits until a person has done something by hand."""

Run = Callable[[Schedule, datetime, Control], Awaitable[SlotState]]
"""``await run(schedule, slot, control)``: how the check ended."""


ByHand = Callable[[datetime, Control], Awaitable[SlotState]]
"""``await work(begun, control)``: what a person wants done, and how it ended."""


async def deny(_: str) -> bool:
    """Nobody may."""
    return False


@dataclass(frozen=True, slots=True)
class FullCampaigns:
    """What a person may start besides checks: names, and ``of(recipe, who)``, how one is carried out for somebody; None: it is none.

    ``may``: whether somebody may propose tables, by the table of users as it is now: a full campaign ends with a proposal of his.
    """

    names: tuple[str, ...] = ()
    of: Callable[[str, str], ByHand | None] = lambda recipe, who: None
    may: Callable[[str], Awaitable[bool]] = deny


@dataclass(frozen=True, slots=True)
class JobRequest:
    """Who asks for something, in which request; ``what`` is what he may not ask for again under another meaning of ``key``."""

    request: int
    who: str
    key: str
    what: str


class MachineClaim(Protocol):
    """Who sees to it that one check runs at a time."""

    def take(self, name: str) -> str:
        """Take the machine; return what runs on it instead, or nothing."""
        ...

    def give_back(self) -> None:
        """The machine is free again."""
        ...


@dataclass
class _Job:
    seen: JobState
    control: Control = field(default_factory=Control)
    task: asyncio.Task[SlotState] | None = None


class JobRegistry:
    """Knows every job since the service began, the latest `MOST_JOBS` of them by number.

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
        self.place: MachineClaim | None = None
        """Where a job by hand is started; None: nowhere (``--once``, or not yet)."""
        self.full = FullCampaigns()
        """The full campaigns; none unless somebody says which."""
        self._tasks: asyncio.TaskGroup | None = None

    def open(self, place: MachineClaim, tasks: asyncio.TaskGroup) -> None:
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

    async def __call__(self, schedule: Schedule, slot_utc: datetime) -> SlotState:
        """Run the check of a slot; return the slot's state. This is the scheduler's job."""
        job = self._new(schedule, "")
        return await self._carry_out(job, lambda: self._run(schedule, slot_utc, job.control))

    async def errand(self, errand: FollowUp) -> SlotState:
        """Do what no slot asks for, as a job; return how it ended."""
        job = self._new(errand.schedule, "", errand.kind)
        work = errand.work
        assert work is not None
        return await self._carry_out(job, lambda: work(job.control))

    def _new(self, schedule: Schedule, who: str, kind: JobKind = "check") -> _Job:
        number = secrets.token_hex(6)
        by_hand = "" if who else schedule.name
        job = _Job(
            JobState(
                id=number,
                kind=kind,
                recipe=schedule.recipe[:WORD],
                schedule=by_hand[:WORD],
                who=who,
                state=State.READY,
                text="",
                begun_utc=self._clock.utc(),
            )
        )
        self._jobs[number] = job
        while len(self._jobs) > MOST_JOBS:
            self._jobs.popitem(last=False)
        return job

    async def _carry_out(self, job: _Job, run: Callable[[], Awaitable[SlotState]]) -> SlotState:
        end = SlotState("interrupted")
        self._now = job
        self._changed()
        try:
            end = await run()
        finally:
            self._now = None
            job.seen = replace(
                job.seen,
                state=str(end),
                text=end.reason[:TEXT],
                ended_utc=self._clock.utc(),
                verification=end.verification,
                solution=end.solution,
                proposal=end.proposal,
            )
            self._changed()
        return end

    async def _by_hand(self, job: _Job, work: ByHand, place: MachineClaim) -> SlotState:
        try:
            return await self._carry_out(job, lambda: work(job.seen.begun_utc, job.control))
        finally:
            place.give_back()

    # ---- what is seen -----------------------------------------------------------------------------------------------

    @property
    def running(self) -> JobState | None:
        """The job that runs, with the state of its measurement."""
        return None if self._now is None else self._look(self._now)

    def seen(self) -> tuple[JobState, ...]:
        """The latest jobs, newest first."""
        return tuple(self._look(job) for job in reversed(self._jobs.values()))

    def _look(self, job: _Job) -> JobState:
        if job.seen.ended_utc is not None:
            return job.seen
        control, now, prompt = job.control, job.control.situation, job.control.prompts.now
        state = now.state
        if state is State.READY:  # the work has not said anything yet; what a person has asked for is kept for it
            asked = ((State.ABORTING, control.aborting), (State.STOPPING, control.stopping), (State.PAUSING, control.pausing))
            state = next((one for one, is_asked in asked if is_asked), State.RUNNING)
        if prompt is None:
            return replace(job.seen, state=state, text=now.why)
        shown = ASKING if state is State.RUNNING else state
        return replace(job.seen, state=shown, text=now.why, prompt=prompt.number, ask=prompt.text[:WORD])

    # ---- what is asked for ------------------------------------------------------------------------------------------

    async def start(self, asked: StartJob) -> Answer:
        """Start a declared recipe or a full campaign, once for each key."""
        refused = await self._refused(asked.who)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        campaign = self.full.of(asked.recipe, asked.who)
        if campaign is not None and not await self.full.may(asked.who):
            return _answer(asked.request, "forbidden", f"{asked.who} may not propose tables here, and {asked.recipe} ends with a proposal")
        requested = JobRequest(asked.request, asked.who, asked.key, asked.recipe)
        again = self.again(requested)
        if again is not None:
            return again
        schedule = Schedule(BY_HAND, "", "UTC", asked.recipe)
        if campaign is not None:
            return self.begin(requested, schedule, campaign, "campaign")
        if parted(asked.recipe)[0] not in self._recipes:
            there = ", ".join((*self._recipes, *self.full.names))
            return _answer(asked.request, "unknown", f"there is no recipe {asked.recipe!r} here; there are: {there}")
        return self.begin(requested, schedule, lambda begun, control: self._run(schedule, begun, control))

    def again(self, requested: JobRequest) -> Answer | None:
        """The answer to what was asked for with this key before; None: it was not."""
        known = self._keys.get((requested.who, requested.key)) if requested.key else None
        if known is None:
            return None
        if known[1] != requested.what:
            return _answer(requested.request, "conflict", "this key was used for another request", known[0])
        return _answer(requested.request, "done", AGAIN, known[0])

    def begin(self, requested: JobRequest, schedule: Schedule, work: ByHand, kind: JobKind = "check") -> Answer:
        """Begin a job that a person wants, now, if nothing else has the machine. Whether he may is for the caller to ask."""
        if self.place is None or self._tasks is None:
            return _answer(requested.request, "busy", "the service starts, ends, or runs its timetable once; it takes no jobs")
        other = self.place.take(f"{BY_HAND}: {schedule.recipe}")
        if other:
            return _answer(requested.request, "busy", f"the machine measures: {other}")
        job = self._new(schedule, requested.who, kind)
        if requested.key:
            self._keys[requested.who, requested.key] = (job.seen.id, requested.what)
            while len(self._keys) > MOST_KEYS:
                self._keys.popitem(last=False)
        job.task = self._tasks.create_task(self._by_hand(job, work, self.place), name=f"job {job.seen.id}")
        log.info("job started", job=job.seen.id, kind=kind, recipe=schedule.recipe, who=requested.who)
        return _answer(requested.request, "done", "", job.seen.id)

    async def steer(self, asked: SteerJob) -> Answer:
        """Stop, abort, pause or go on with the job that runs."""
        job = await self._asked_of(asked)
        if isinstance(job, Answer):
            return job
        if job.control.state is State.ENDED:
            return _answer(asked.request, "conflict", "the measurement of this job is over; its figures are judged now", asked.job)
        if asked.how == "pause" and job.control.hurry:
            return _answer(asked.request, "conflict", f"it cannot be paused now: {job.control.hurry}", asked.job)
        {"stop": job.control.stop, "abort": job.control.abort, "pause": job.control.pause, "resume": job.control.resume}[asked.how]()
        log.info("job steered", job=asked.job, how=asked.how, who=asked.who)
        self._changed()
        return _answer(asked.request, "done", "", asked.job)

    async def done_by_hand(self, asked: DoneByHand) -> Answer:
        """Take somebody's word that what a job asks for is done; not for any other prompt than the one that stands."""
        job = await self._asked_of(asked)
        if isinstance(job, Answer):
            return job
        if not job.control.prompts.answer(asked.prompt):
            return _answer(asked.request, "conflict", f"prompt {asked.prompt} is not what this job waits for: look at it again", asked.job)
        log.info("done by hand", job=asked.job, prompt=asked.prompt, who=asked.who)
        self._changed()
        return _answer(asked.request, "done", "", asked.job)

    async def _asked_of(self, asked: SteerJob | DoneByHand) -> _Job | Answer:
        """The running job that somebody may say something to, or why not."""
        refused = await self._refused(asked.who)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        job = self._jobs.get(asked.job)
        if job is None:
            return _answer(asked.request, "unknown", f"there is no job {asked.job!r} since the service began")
        if job.seen.ended_utc is not None:
            return _answer(asked.request, "conflict", f"this job has ended: {job.seen.state}", asked.job)
        return job

    async def _refused(self, who: str) -> str:
        return "" if await self._may(who) else f"{who} may not measure here"


def _answer(request: int, outcome: Outcome, text: str = "", job: str = "") -> Answer:
    return Answer("answer", request, outcome, text[:4000], job)
