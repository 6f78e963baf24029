"""What a service says of itself in the database, so that others who read it know its machine: the fleet's list."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from typing import Protocol

import structlog

from abbe.service.clock import Clock
from abbe.service.domain.progress import Progress
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import StoreError
from abbe.service.scheduler.ports import Doc

log = structlog.get_logger("abbe.station")

BEAT_S = 60.0
"""One row is written anew so often."""
SILENT_AFTER = timedelta(seconds=3 * BEAT_S)
"""A service on another computer that was not heard for so long does not run."""
MEASURING = "measuring"
WAITING = "waiting"


class HeartbeatSink(Protocol):
    """The part of the store that is written here."""

    def put(self, machine: str, doc: Doc) -> None:
        """Write the present state of a machine's service."""
        ...


class Heartbeat:
    """Keeps a machine's row true. A database that does not take it now gets the next one: nothing waits for this.

    Parameters
    ----------
    machine, version : str
        Name of the machine; version of this program.
    store : HeartbeatDesk
        Where to.
    next_due : callable
        The timetable's next slots.
    clock : Clock
        Beats.
    attention : sequence of str
        What needs a person now, kept by others.
    """

    def __init__(
        self,
        machine: str,
        version: str,
        store: HeartbeatSink,
        next_due: Callable[[], Sequence[tuple[Schedule, datetime]]],
        clock: Clock,
        attention: Sequence[str] = (),
    ) -> None:
        self._machine, self._version = machine, version
        self._store, self._next_due, self._clock, self._attention = store, next_due, clock, attention
        self._job: Doc | None = None
        self._began = clock.utc()
        self._news = asyncio.Event()

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Note that a check begins."""
        self._job = {"schedule": schedule.name, "recipe": schedule.recipe, "since_utc": at_utc.isoformat()}
        self._news.set()

    def job_progress(self, progress: Progress) -> None:
        """Progress is for the machine's own page."""

    def noted(self) -> None:
        """Hear that what needs a person has changed."""
        self._news.set()

    def job_ended(self, doc: Doc | None) -> None:
        """Note that it ended."""
        self._job = None
        self._news.set()

    def doc(self) -> Doc:
        """What is said now."""
        due = [{"schedule": one.name, "recipe": one.recipe, "due_utc": at.isoformat()} for one, at in self._next_due()]
        state = WAITING if self._job is None else MEASURING
        told = {"schema": 1, "state": state, "job": self._job, "due": due, "version": self._version, "began_utc": self._began.isoformat()}
        return told | {"attention": list(self._attention)}

    async def run(self) -> None:
        """Write now, at every change, and once a beat; until cancelled."""
        while True:
            self._news.clear()
            try:
                await asyncio.to_thread(self._store.put, self._machine, self.doc())
            except StoreError as trouble:
                log.warning("the fleet's list was not told", cause=trouble.detail)
            await self._beat()

    async def _beat(self) -> None:
        """Until there is news, or a beat has passed."""
        waits = {asyncio.ensure_future(self._news.wait()), asyncio.ensure_future(self._clock.sleep(BEAT_S))}
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for one in waits:
                one.cancel()
