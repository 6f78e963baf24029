"""The job of a slot: run the check, keep what it found, and if it failed say why. The timetable goes on either way."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import AbbeError
from abbe.service.events import Progress
from abbe.service.scheduler import record
from abbe.service.scheduler.ports import AfterCheck, Check, Doc, JobWatcher, Shelf, SlotState
from abbe.service.sequences.control import Control

log = structlog.get_logger("abbe.check")

FAILURES = (DriverError, AbbeError, OSError, ArithmeticError, ValueError)
"""What a check may fail with without being a defect of this program: devices, the job's own errors, files, numerics
(LinAlgError is a ValueError). Anything else ends the service with a traceback, and systemd starts it again."""


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
        Told of start, progress and end.
    clock : Clock
        Times of failed checks.
    after : callable, optional
        Told of every verification that was kept.
    """

    def __init__(
        self, machine: str, check: Check, shelf: Shelf, watchers: Sequence[JobWatcher], clock: Clock, after: AfterCheck | None = None
    ) -> None:
        self._machine = machine
        self._check = check
        self._shelf = shelf
        self._watchers = tuple(watchers)
        self._clock = clock
        self._after = after

    async def __call__(self, schedule: Schedule, slot_utc: datetime) -> str:
        """Run the check of one slot; return the slot's state."""
        return (await self.run(schedule, slot_utc, Control()))[0]

    async def run(self, schedule: Schedule, slot_utc: datetime, control: Control) -> tuple[str, int]:
        """Run the check of one slot under somebody's control; return the slot's state and the number of the verification."""
        doc: Doc | None = None
        for watcher in self._watchers:
            watcher.job_started(schedule, self._clock.utc())
        try:
            doc = await self._run(record.Occasion(self._machine, schedule, slot_utc), control)
            number = await self._shelf.keep(doc)
            meant = "" if self._after is None else await self._after(doc, number)
        finally:
            for watcher in self._watchers:
                watcher.job_ended(doc)
        log.info("check done", schedule=schedule.name, verification=number, verdict=doc["verdict"], text=doc["text"])
        return SlotState(f"done: {doc['verdict']}", meant), number

    async def _run(self, occasion: record.Occasion, control: Control) -> Doc:
        started_utc, started_s = self._clock.utc(), self._clock.monotonic_s()
        try:
            return record.found(occasion, await self._check(occasion.schedule.recipe, self._progress, control))
        except FAILURES as failure:
            cause: Exception = failure
        except ExceptionGroup as group:
            # A check that watches its devices side by side fails with a group. One unknown member makes all of it a defect.
            if group.split(FAILURES)[1] is not None:
                raise
            cause = group
        log.warning("check failed", schedule=occasion.schedule.name, **record.cause_of(cause), exc_info=_defect(cause))
        return record.failed(occasion, cause, started_utc, self._clock.monotonic_s() - started_s)

    def _progress(self, progress: Progress) -> None:
        for watcher in self._watchers:
            watcher.job_progress(progress)


def _defect(cause: Exception) -> Exception | None:
    """Return the error if its traceback helps anybody: not for a cable that came off."""
    return None if isinstance(cause, DriverError | AbbeError | OSError | ExceptionGroup) else cause
