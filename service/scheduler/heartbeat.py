"""Heartbeat of a service in the database: its state, for the fleet's list and other readers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Protocol

import structlog

from abbe.service.clock import Clock
from abbe.service.domain.document import Doc
from abbe.service.domain.progress import Progress
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import BEAT_S
from abbe.service.errors import StoreError

log = structlog.get_logger("abbe.heartbeat")

MEASURING = "measuring"
WAITING = "waiting"


class HeartbeatSink(Protocol):
    """The part of the store that heartbeats need."""

    def put(self, machine: str, doc: Doc) -> None:
        """Write the current state of a machine's service."""
        ...


class Heartbeat:
    """Keeps a machine's row up to date. If the database does not accept a row, nothing waits: the next row replaces it.

    Parameters
    ----------
    store : HeartbeatSink
        Gets the rows.
    next_due : callable
        The timetable's next slots.
    attention : sequence of str
        What needs a person now, maintained by others.
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
        self._changed = asyncio.Event()

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Note that a check begins."""
        self._job = {"schedule": schedule.name, "recipe": schedule.recipe, "since_utc": at_utc.isoformat()}
        self._changed.set()

    def job_progress(self, progress: Progress) -> None:
        """Do nothing: progress is for the machine's own page."""

    def attention_changed(self) -> None:
        """Note that ``attention`` has changed."""
        self._changed.set()

    def job_ended(self, doc: Doc | None) -> None:
        """Note that the check ended."""
        self._job = None
        self._changed.set()

    def doc(self) -> Doc:
        """Return the current row."""
        due = [{"schedule": one.name, "recipe": one.recipe, "due_utc": at.isoformat()} for one, at in self._next_due()]
        state = WAITING if self._job is None else MEASURING
        row = {"schema": 1, "state": state, "job": self._job, "due": due, "version": self._version, "began_utc": self._began.isoformat()}
        return row | {"attention": list(self._attention)}

    async def run(self) -> None:
        """Write now, at every change, and once every `BEAT_S`; until cancelled."""
        while True:
            self._changed.clear()
            try:
                await asyncio.to_thread(self._store.put, self._machine, self.doc())
            except StoreError as trouble:
                log.warning("heartbeat not written", cause=trouble.detail)
            await self._beat()

    async def _beat(self) -> None:
        """Wait for a change, at most `BEAT_S`."""
        waits = {asyncio.ensure_future(self._changed.wait()), asyncio.ensure_future(self._clock.sleep(BEAT_S))}
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for one in waits:
                one.cancel()
