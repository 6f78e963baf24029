"""Run a job, report its progress to watchers, and record its beginning, its end, or that the service stopped during it.

Checks, full campaigns, investigations, pushes and rollbacks are each a `Job`; `carry_out` runs any of them (decision 0039).
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.domain.document import Doc
from abbe.service.domain.progress import JobKind, JobOutcome, Progress, ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, Aborted, Stopped
from abbe.service.scheduler.ports import AfterCheck, Check, JobWatcher, Shelf, SlotState
from abbe.service.sequences.control import Control, State
from abbe.service.verification import verify

log = structlog.get_logger("abbe.job")

T = TypeVar("T")
FAILURES = (DriverError, AbbeError, OSError, ArithmeticError, ValueError)
"""Failures that are not defects of this program: devices, the job's own errors, files, numerics (LinAlgError is a ValueError). Anything
else ends the service with a traceback, and systemd starts it again."""
SHUTDOWN_RECORD_S = 1.0
"""How long a job may record its state when the service stops; the service has five seconds for everything."""


class Job(ABC, Generic[T]):
    """Work that has the machine to itself, and its records.

    ``T``: what the work returns. ``terms``: its name and recipe, as watchers and people see them. ``kind``, ``alarm``: as in `JobState`.
    """

    kind: JobKind = "check"
    alarm: int | None = None
    terms: Schedule
    handles_abort: ClassVar[bool] = False
    """Whether the work ends by itself when aborted; otherwise it is cancelled."""

    async def begin(self) -> None:
        """Record that the job begins; if this fails, do not start the work."""

    @abstractmethod
    async def do(self, progress: ProgressSink, control: Control) -> T:
        """Do the work."""

    @abstractmethod
    async def failed(self, error: Exception) -> T:
        """Return the outcome of a failure of devices, data or numerics."""

    async def defect(self, error: Exception) -> None:
        """Record a defect of this program before it ends the service."""

    @abstractmethod
    async def end(self, outcome: T) -> SlotState:
        """Record the outcome."""

    async def interrupted(self) -> None:
        """Record the state when the service stops, within `SHUTDOWN_RECORD_S`."""

    def document(self) -> Doc | None:
        """Return the document that watchers get at the end."""
        return None


@dataclass(frozen=True, slots=True)
class FollowUp:
    """Work outside the timetable. Like a check it has the machine to itself and starts under the preconditions of a schedule.

    ``job``: None for the schedule's check. ``begun``: called when the work gets the machine.
    """

    schedule: Schedule
    job: Job[Any] | None = None
    begun: Callable[[], None] | None = None

    @property
    def name(self) -> str:
        """Name of the work, for people."""
        return self.schedule.name


class FollowUps(Protocol):
    """Source of work outside the timetable."""

    async def due(self) -> FollowUp | None:
        """Return what may start now, or None."""
        ...


RunJob = Callable[[Job[Any]], Awaitable[SlotState]]
"""``await run(job)``: runs a job so that people can see and steer it; returns how it ended."""


async def carry_out(job: Job[T], begun_utc: datetime, control: Control, watchers: Sequence[JobWatcher] = ()) -> SlotState:
    """Run a job to its end; return its final state.

    Parameters
    ----------
    begun_utc : datetime
        When the job began.
    control : Control
        Pauses and stops the job.
    watchers : sequence of JobWatcher
        Called at the start, at each progress, and once the end is recorded.

    Raises
    ------
    CancelledError
        The service stops.
    Exception
        A defect of this program; failures of devices, data and numerics are outcomes.
    """

    def progressed(progress: Progress) -> None:
        for watcher in watchers:
            watcher.job_progress(progress)

    for watcher in watchers:
        watcher.job_started(job.terms, begun_utc)
    try:
        return await job.end(await _outcome(job, progressed, control))
    finally:
        for watcher in watchers:
            watcher.job_ended(job.document())


async def _outcome(job: Job[T], progress: ProgressSink, control: Control) -> T:
    try:
        await job.begin()
        work = job.do(progress, control)
        return await (work if job.handles_abort else control.unless_aborted(work))
    except asyncio.CancelledError:
        await _record_interruption(job)
        raise
    except Exception as error:
        if is_defect(error):
            await job.defect(error)
            raise
        return await job.failed(error)
    finally:
        control.now(State.ENDED)


async def _record_interruption(job: Job[T]) -> None:
    try:
        async with asyncio.timeout(SHUTDOWN_RECORD_S):
            await job.interrupted()
    except (AbbeError, TimeoutError) as trouble:
        log.warning("interrupted by the end of the service; not recorded", job=job.terms.name, cause=str(trouble))


def is_defect(error: Exception) -> bool:
    """Return whether an error is a defect of this program, not a failure of devices, data or numerics.

    Devices that are watched side by side fail with an exception group; if one member is a defect, the group counts as a defect.
    """
    return not isinstance(error, FAILURES) and not (isinstance(error, ExceptionGroup) and error.split(FAILURES)[1] is None)


def failure(error: Exception) -> JobOutcome:
    """Return the outcome of work that failed or that a person ended: cause, remedy, and the notes of the error."""
    ended, cause = isinstance(error, Stopped | Aborted), verify.cause_of(error)
    parts = [cause.what, "" if ended else cause.remedy, *getattr(error, "__notes__", [])]
    return JobOutcome("stopped" if ended else "failed", "; ".join(filter(None, parts)))


@dataclass(frozen=True, slots=True)
class CheckJobs:
    """Runs the check of a slot as a job.

    Parameters
    ----------
    machine : str
        Name of the machine, for the documents.
    check : callable
        ``await check(recipe, progress, control)``.
    shelf : Shelf
        Stores the documents.
    clock : Clock
        Times of failed checks.
    after : callable, optional
        ``await after(doc, number)``, called for every stored verification.
    """

    machine: str
    check: Check
    shelf: Shelf
    clock: Clock
    after: AfterCheck | None = None

    def __call__(self, schedule: Schedule, slot_utc: datetime) -> Job[Doc]:
        """Return the check of one slot as a job."""
        return _CheckJob(self, schedule, slot_utc)


class _CheckJob(Job[Doc]):
    """The check of one slot. Its result, or the cause of its failure, is stored; the timetable continues either way."""

    handles_abort = True

    def __init__(self, checks: CheckJobs, schedule: Schedule, slot_utc: datetime) -> None:
        self.terms, self._checks = schedule, checks
        self._occasion = verify.Occasion(checks.machine, schedule, slot_utc)
        self._started_utc, self._started_s = checks.clock.utc(), checks.clock.monotonic_s()
        self._doc: Doc | None = None

    async def do(self, progress: ProgressSink, control: Control) -> Doc:
        return verify.check_doc(self._occasion, await self._checks.check(self.terms.recipe, progress, control))

    async def failed(self, error: Exception) -> Doc:
        log.warning("check failed", schedule=self.terms.name, **asdict(verify.cause_of(error)), exc_info=_traceback(error))
        return verify.failed_doc(self._occasion, error, self._started_utc, self._checks.clock.monotonic_s() - self._started_s)

    async def end(self, outcome: Doc) -> SlotState:
        self._doc = outcome
        number = await self._checks.shelf.keep(outcome)
        consequence = "" if self._checks.after is None else await self._checks.after(outcome, number)
        log.info("check done", schedule=self.terms.name, verification=number, verdict=outcome["verdict"], text=outcome["text"])
        return SlotState(f"done: {outcome['verdict']}", consequence, verification=number)

    def document(self) -> Doc | None:
        return self._doc


def _traceback(cause: Exception) -> Exception | None:
    """Return the error if its traceback helps people; None for failures such as a disconnected cable."""
    return None if isinstance(cause, DriverError | AbbeError | OSError | ExceptionGroup) else cause
