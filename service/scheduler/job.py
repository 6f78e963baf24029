"""One way to carry out a job: watchers hear of it, its begin and its end are written down, and a stop of the service has its last words.

Checks, full campaigns, investigations, pushes and rollbacks all go through `carry_out`; what differs is a `Job` of its own.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Sequence
from datetime import datetime
from typing import Generic, TypeVar

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.domain.job_state import JobOutcome
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError, Aborted, Stopped
from abbe.service.events import Progress, ProgressSink
from abbe.service.scheduler import record
from abbe.service.scheduler.ports import AfterCheck, Check, Doc, JobWatcher, Shelf, SlotState
from abbe.service.sequences.control import Control, State

log = structlog.get_logger("abbe.job")

T = TypeVar("T")
FAILURES = (DriverError, AbbeError, OSError, ArithmeticError, ValueError)
"""What a job may fail with without being a defect of this program: devices, the job's own errors, files, numerics
(LinAlgError is a ValueError). Anything else ends the service with a traceback, and systemd starts it again."""
LAST_WORDS_S = 1.0
"""A service that ends has five seconds for everything."""


class Job(ABC, Generic[T]):
    """What is carried out, and what is written down of it. ``T``: what the work gives."""

    name: str
    """What it is, for the log."""
    hears_abort = False
    """Whether the work itself ends on an abort; else it is cancelled."""

    async def begin(self) -> None:
        """Write down that it begins; what cannot be written down is not begun."""

    @abstractmethod
    async def do(self, progress: ProgressSink, control: Control) -> T:
        """Do the work."""

    @abstractmethod
    async def failed(self, error: Exception) -> T:
        """What a failure is for people: an outcome, no error."""

    async def defect(self, error: Exception) -> None:
        """Write down what must stay of a defect of this program, which ends the service then."""

    @abstractmethod
    async def end(self, outcome: T) -> SlotState:
        """Write down how it ended."""

    async def last_words(self) -> None:
        """Write down where it stands when the service ends, if the store takes it at once."""

    def document(self) -> Doc | None:
        """What watchers get at the end."""
        return None


async def carry_out(job: Job[T], terms: Schedule, begun_utc: datetime, control: Control, watchers: Sequence[JobWatcher]) -> SlotState:
    """Carry out a job.

    Parameters
    ----------
    job : Job
        The work and its records.
    terms : Schedule
        The terms on which it runs, for watchers.
    begun_utc : datetime
        When it began.
    control : Control
        Who may pause and stop it.
    watchers : sequence of JobWatcher
        Hear of its start, progress and end.

    Returns
    -------
    SlotState
        How it ended.

    Raises
    ------
    CancelledError
        The service ends.
    Exception
        A defect of this program; failures of devices, data and numerics are outcomes.
    """

    def progressed(progress: Progress) -> None:
        for watcher in watchers:
            watcher.job_progress(progress)

    for watcher in watchers:
        watcher.job_started(terms, begun_utc)
    try:
        return await job.end(await _outcome(job, progressed, control))
    finally:
        for watcher in watchers:
            watcher.job_ended(job.document())


async def _outcome(job: Job[T], progress: ProgressSink, control: Control) -> T:
    try:
        await job.begin()
        work = _coroutine(job, progress, control)
        return await (work if job.hears_abort else control.unless_aborted(work))
    except asyncio.CancelledError:
        await _stopped_with_the_service(job)
        raise
    except Exception as error:
        if is_defect(error):
            await job.defect(error)
            raise
        return await job.failed(error)
    finally:
        control.now(State.ENDED)


async def _coroutine(job: Job[T], progress: ProgressSink, control: Control) -> T:
    return await job.do(progress, control)


async def _stopped_with_the_service(job: Job[T]) -> None:
    try:
        async with asyncio.timeout(LAST_WORDS_S):
            await job.last_words()
    except (AbbeError, TimeoutError) as trouble:
        log.warning("stopped with the service; its end is not written down", job=job.name, cause=str(trouble))


def is_defect(error: Exception) -> bool:
    """Whether something other than devices, data and numerics failed.

    Devices that are watched side by side fail with a group; one unknown member makes all of it a defect.
    """
    return not isinstance(error, FAILURES) and not (isinstance(error, ExceptionGroup) and error.split(FAILURES)[1] is None)


def failure(error: Exception) -> JobOutcome:
    """What a person reads of work that was ended or failed: cause, remedy, and what was noted on its way."""
    ended, cause = isinstance(error, Stopped | Aborted), record.cause_of(error)
    words = [cause["what"], "" if ended else cause["remedy"], *getattr(error, "__notes__", [])]
    return JobOutcome("stopped" if ended else "failed", "; ".join(filter(None, words)))


class CheckJob:
    """Runs checks of one machine.

    Parameters
    ----------
    machine : str
        Name of the machine, for the documents.
    check : callable
        ``await check(recipe, progress, control)``.
    shelf : Shelf
        Keeps the documents.
    watchers : sequence of JobWatcher
        Hear of start, progress and end.
    clock : Clock
        Times of failed checks.
    after : callable, optional
        Hears of every verification that was kept.
    """

    def __init__(
        self, machine: str, check: Check, shelf: Shelf, watchers: Sequence[JobWatcher], clock: Clock, after: AfterCheck | None = None
    ) -> None:
        self.machine, self.check, self.shelf, self.clock, self.after = machine, check, shelf, clock, after
        self._watchers = tuple(watchers)

    async def __call__(self, schedule: Schedule, slot_utc: datetime) -> SlotState:
        """Run the check of one slot; return the slot's state."""
        return await self.run(schedule, slot_utc, Control())

    async def run(self, schedule: Schedule, slot_utc: datetime, control: Control) -> SlotState:
        """Run the check of one slot under somebody's control; return the slot's state with the number of the verification."""
        return await carry_out(_OneCheck(self, schedule, slot_utc), schedule, self.clock.utc(), control, self._watchers)


class _OneCheck(Job[Doc]):
    """The check of one slot: what it found is kept, and if it failed, why. The timetable goes on either way."""

    hears_abort = True

    def __init__(self, of: CheckJob, schedule: Schedule, slot_utc: datetime) -> None:
        self._of, self.name = of, schedule.name
        self._occasion = record.Occasion(of.machine, schedule, slot_utc)
        self._started_utc, self._started_s = of.clock.utc(), of.clock.monotonic_s()
        self._doc: Doc | None = None

    async def do(self, progress: ProgressSink, control: Control) -> Doc:
        return record.found(self._occasion, await self._of.check(self._occasion.schedule.recipe, progress, control))

    async def failed(self, error: Exception) -> Doc:
        log.warning("check failed", schedule=self.name, **record.cause_of(error), exc_info=_traceback(error))
        return record.failed(self._occasion, error, self._started_utc, self._of.clock.monotonic_s() - self._started_s)

    async def end(self, outcome: Doc) -> SlotState:
        self._doc = outcome
        number = await self._of.shelf.keep(outcome)
        meant = "" if self._of.after is None else await self._of.after(outcome, number)
        log.info("check done", schedule=self.name, verification=number, verdict=outcome["verdict"], text=outcome["text"])
        return SlotState(f"done: {outcome['verdict']}", meant, verification=number)

    def document(self) -> Doc | None:
        return self._doc


def _traceback(cause: Exception) -> Exception | None:
    """The error if its traceback helps anybody: not for a cable that came off."""
    return None if isinstance(cause, DriverError | AbbeError | OSError | ExceptionGroup) else cause
