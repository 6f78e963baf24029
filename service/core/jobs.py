"""The jobs since the service began, by number, and how people start and steer them.

A job is a check of the timetable, a check or full campaign that a person starts, the consequence of an alarm (an investigation or a push),
or an order for the tables (`abbe.service.core.orders`). Rights are decided here, not where a request comes from: the web process names the
user, and the table of users decides what this user may do.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Protocol

import structlog

from abbe.service.channel.messages import MOST_JOBS, Answer, ConfirmPrompt, Outcome, StartJob, SteerJob
from abbe.service.clock import Clock
from abbe.service.domain.document import TEXT, WORD
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobState
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.job import Job, carry_out
from abbe.service.scheduler.ports import JobWatcher, SlotState
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.recipes.campaigns import is_full, split_recipe_name

log = structlog.get_logger("abbe.jobs")

MOST_KEYS = 1000
BY_HAND = "by hand"
AGAIN = "already requested with this key"
"""Text of the answer to a repeated request."""
ASKING = "asking"
"""State of a job that waits for a person to do something by hand."""


def by_hand(recipe: str) -> Schedule:
    """Return the schedule of a job that a person starts; it runs immediately."""
    return Schedule(BY_HAND, "", "UTC", recipe)


async def deny(_: str) -> bool:
    """Allow no user."""
    return False


async def no_alarms(_: int) -> str:
    """Refuse to search for the cause of an alarm: this service raises no alarms."""
    return "this service raises no alarms"


@dataclass(frozen=True, slots=True)
class FullCampaigns:
    """Full campaigns that a person may start: their names, and ``of(recipe, who, alarm, resume)``, the job for a user (None: no campaign).

    ``may``: whether a user may propose tables, by the current table of users: a full campaign ends with this user's proposal;
    ``against``: why the cause of an alarm cannot be searched, an empty text if it can.
    """

    names: tuple[str, ...] = ()
    of: Callable[[str, str, int, str], Job[Any] | None] = lambda recipe, who, alarm, resume: None
    may: Callable[[str], Awaitable[bool]] = deny
    against: Callable[[int], Awaitable[str]] = no_alarms


@dataclass(frozen=True, slots=True)
class JobRequest:
    """A request for a job. ``key``: idempotency key; ``what``: the requested work. A user may repeat a key only for the same work."""

    request: int
    who: str
    key: str
    what: str


class MachineClaim(Protocol):
    """Ensures that only one job uses the machine."""

    def take(self, name: str) -> str:
        """Take the machine; return the name of the job that has it instead, or an empty string."""
        ...

    def give_back(self) -> None:
        """Release the machine."""
        ...


@dataclass
class _Entry:
    job: Job[Any]
    record: JobState
    control: Control = field(default_factory=Control)
    task: asyncio.Task[SlotState] | None = None


class JobRegistry:
    """Runs jobs, and remembers the latest `MOST_JOBS` of them by number.

    Parameters
    ----------
    checks : callable
        ``checks(schedule, slot)`` makes the check of a slot.
    recipes : sequence of str
        Recipes that a person may start.
    may : callable
        ``await may(who, need)``: whether a user has a permission, by the current table of users.
    changed : callable
        Called whenever a job begins, changes or ends.
    watchers : sequence of JobWatcher
        Follow every job.
    """

    def __init__(
        self,
        checks: Callable[[Schedule, datetime], Job[Any]],
        recipes: Sequence[str],
        may: Callable[[str, Permission], Awaitable[bool]],
        clock: Clock,
        changed: Callable[[], None],
        watchers: Sequence[JobWatcher] = (),
    ) -> None:
        self._checks, self._recipes, self._may, self._clock, self._changed = checks, tuple(recipes), may, clock, changed
        self._watchers = tuple(watchers)
        self._jobs: OrderedDict[str, _Entry] = OrderedDict()
        self._keys: OrderedDict[tuple[str, str], tuple[str, str]] = OrderedDict()
        self._now: _Entry | None = None
        self.claim: MachineClaim | None = None
        """Claim on the machine for jobs that people start; None: no such jobs are accepted (``--once``, or not yet started)."""
        self.full = FullCampaigns()
        """The full campaigns; by default there are none."""
        self._tasks: asyncio.TaskGroup | None = None

    def open(self, claim: MachineClaim, tasks: asyncio.TaskGroup) -> None:
        """Accept jobs from people from now on; they run in ``tasks``."""
        self.claim, self._tasks = claim, tasks

    async def close(self) -> None:
        """Accept no more jobs, and cancel the jobs started by hand; their cancellation stops the axes."""
        self.claim = None
        running = [entry.task for entry in self._jobs.values() if entry.task is not None and not entry.task.done()]
        for task in running:
            task.cancel()
        if running:
            await asyncio.wait(running)

    # ---- running ----------------------------------------------------------------------------------------------------

    async def __call__(self, schedule: Schedule, slot_utc: datetime) -> SlotState:
        """Run the check of a slot for the scheduler; return the slot's state."""
        return await self.run(self._checks(schedule, slot_utc))

    async def run(self, job: Job[Any]) -> SlotState:
        """Run a job that the service starts by itself; return its final state."""
        return await self._run(self._new(job, ""))

    def _new(self, job: Job[Any], who: str) -> _Entry:
        number = secrets.token_hex(6)
        entry = _Entry(
            job,
            JobState(
                id=number,
                kind=job.kind,
                recipe=job.terms.recipe[:WORD],
                schedule="" if who else job.terms.name[:WORD],
                who=who,
                state=State.READY,
                text="",
                begun_utc=self._clock.utc(),
                alarm=job.alarm,
            ),
        )
        self._jobs[number] = entry
        while len(self._jobs) > MOST_JOBS:
            self._jobs.popitem(last=False)
        return entry

    async def _run(self, entry: _Entry) -> SlotState:
        end = SlotState("interrupted")
        self._now = entry
        self._changed()
        try:
            end = await carry_out(entry.job, entry.record.begun_utc, entry.control, self._watchers)
        finally:
            self._now = None
            entry.record = replace(
                entry.record,
                state=str(end),
                text=end.reason[:TEXT],
                ended_utc=self._clock.utc(),
                verification=end.verification,
                solution=end.solution,
                proposal=end.proposal,
            )
            self._changed()
        return end

    async def _run_by_hand(self, entry: _Entry, claim: MachineClaim) -> SlotState:
        try:
            return await self._run(entry)
        finally:
            claim.give_back()

    # ---- state -----------------------------------------------------------------------------------------------------

    @property
    def running(self) -> JobState | None:
        """The running job, with the state of its measurement; None: no job runs."""
        return None if self._now is None else self._state_of(self._now)

    def latest(self) -> tuple[JobState, ...]:
        """The latest jobs, newest first."""
        return tuple(self._state_of(entry) for entry in reversed(self._jobs.values()))

    def _state_of(self, entry: _Entry) -> JobState:
        if entry.record.ended_utc is not None:
            return entry.record
        control, now, prompt = entry.control, entry.control.progress, entry.control.prompts.now
        state = control.state
        if state is State.READY:  # the work has not reported yet; a person's request waits for it
            asked = ((State.ABORTING, control.aborting), (State.STOPPING, control.stopping), (State.PAUSING, control.pausing))
            state = next((one for one, is_asked in asked if is_asked), State.RUNNING)
        if prompt is None:
            return replace(entry.record, state=state, text=now.why)
        shown = ASKING if state is State.RUNNING else state
        return replace(entry.record, state=shown, text=now.why, prompt=prompt.number, ask=prompt.text[:WORD])

    # ---- requests ---------------------------------------------------------------------------------------------------

    async def start(self, asked: StartJob) -> Answer:
        """Start a recipe or a full campaign, once for each key."""
        refused = await self._refused(asked.who)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        campaign = self.full.of(asked.recipe, asked.who, asked.alarm, asked.resume)
        if campaign is not None and not await self.full.may(asked.who):
            return _answer(asked.request, "forbidden", f"{asked.who} may not propose tables here, and {asked.recipe} ends with a proposal")
        what = f"{asked.recipe} for alarm {asked.alarm}" if asked.alarm else asked.recipe
        what += f", resumes {asked.resume}" if asked.resume else ""
        requested = JobRequest(asked.request, asked.who, asked.key, what)
        earlier = self.earlier_answer(requested)
        if earlier is not None:
            return earlier
        if asked.alarm and (against := await self._against(asked)):
            return _answer(asked.request, "conflict", against)
        if campaign is not None:
            return self.begin(requested, campaign)
        if asked.resume:
            return _answer(asked.request, "conflict", f"{asked.recipe!r} cannot be resumed: only a full campaign can")
        if split_recipe_name(asked.recipe)[0] not in self._recipes:
            there = ", ".join((*self._recipes, *self.full.names))
            return _answer(asked.request, "unknown", f"there is no recipe {asked.recipe!r} here; there are: {there}")
        return self.begin(requested, self._checks(by_hand(asked.recipe), self._clock.utc()))

    async def _against(self, asked: StartJob) -> str:
        """Return why a job cannot look for the cause of an alarm; empty: it can."""
        if not is_full(asked.recipe, self.full.names):
            return f"{asked.recipe!r} does not find the cause of an alarm: start a full campaign"
        return await self.full.against(asked.alarm)

    def earlier_answer(self, requested: JobRequest) -> Answer | None:
        """Return the earlier answer to this key; None: the key is new."""
        known = self._keys.get((requested.who, requested.key)) if requested.key else None
        if known is None:
            return None
        if known[1] != requested.what:
            return _answer(requested.request, "conflict", "this key was used for another request", known[0])
        return _answer(requested.request, "done", AGAIN, known[0])

    def begin(self, requested: JobRequest, job: Job[Any]) -> Answer:
        """Begin a requested job if the machine is free. The caller has checked the user's rights."""
        if self.claim is None or self._tasks is None:
            return _answer(
                requested.request, "busy", "the service takes no jobs now: it is starting, ending, or running its timetable once"
            )
        other = self.claim.take(f"{BY_HAND}: {job.terms.recipe}")
        if other:
            return _answer(requested.request, "busy", f"the machine is in use: {other}")
        entry = self._new(job, requested.who)
        if requested.key:
            self._keys[requested.who, requested.key] = (entry.record.id, requested.what)
            while len(self._keys) > MOST_KEYS:
                self._keys.popitem(last=False)
        entry.task = self._tasks.create_task(self._run_by_hand(entry, self.claim), name=f"job {entry.record.id}")
        log.info("job started", job=entry.record.id, kind=job.kind, recipe=job.terms.recipe, who=requested.who)
        return _answer(requested.request, "done", "", entry.record.id)

    async def steer(self, asked: SteerJob) -> Answer:
        """Stop, abort, pause or resume the running job."""
        entry = await self._asked_of(asked, Permission.STOP if asked.how in {"stop", "abort"} else Permission.MEASURE)
        if isinstance(entry, Answer):
            return entry
        control = entry.control
        if control.state is State.ENDED:
            return _answer(asked.request, "conflict", "the measurement of this job has ended; its figures are being judged", asked.job)
        if asked.how == "pause" and control.no_pause_reason:
            return _answer(asked.request, "conflict", f"the job cannot be paused now: {control.no_pause_reason}", asked.job)
        {"stop": control.stop, "abort": control.abort, "pause": control.pause, "resume": control.resume}[asked.how]()
        log.info("job steered", job=asked.job, how=asked.how, who=asked.who)
        self._changed()
        return _answer(asked.request, "done", "", asked.job)

    async def done_by_hand(self, asked: ConfirmPrompt) -> Answer:
        """Confirm that a person has carried out the open prompt of a job."""
        entry = await self._asked_of(asked, Permission.MEASURE)
        if isinstance(entry, Answer):
            return entry
        if not entry.control.prompts.answer(asked.prompt):
            return _answer(asked.request, "conflict", f"this job does not wait for prompt {asked.prompt}; look at the job again", asked.job)
        log.info("done by hand", job=asked.job, prompt=asked.prompt, who=asked.who)
        self._changed()
        return _answer(asked.request, "done", "", asked.job)

    async def _asked_of(self, asked: SteerJob | ConfirmPrompt, need: Permission) -> _Entry | Answer:
        """Return the running job if the user has a permission, else the refusal."""
        refused = await self._refused(asked.who, need)
        if refused:
            return _answer(asked.request, "forbidden", refused)
        entry = self._jobs.get(asked.job)
        if entry is None:
            return _answer(asked.request, "unknown", f"there is no job {asked.job!r} since the service began")
        if entry.record.ended_utc is not None:
            return _answer(asked.request, "conflict", f"this job has ended: {entry.record.state}", asked.job)
        return entry

    async def _refused(self, who: str, need: Permission = Permission.MEASURE) -> str:
        return "" if await self._may(who, need) else f"{who} may not {need} here"


def _answer(request: int, outcome: Outcome, text: str = "", job: str = "") -> Answer:
    return Answer("answer", request, outcome, text[:4000], job)
