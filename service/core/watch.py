"""Watchers of the running job: the board (and with it the page) and the broker."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime

from abbe.service.clock import Clock
from abbe.service.core.board import Board
from abbe.service.domain.progress import Progress
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import StoreError
from abbe.service.mqtt.publisher import Publisher
from abbe.service.scheduler.ports import Doc
from abbe.service.verification.verified_by import VerifiedBy

LOOK_S = 5.0


class BoardWatch:
    """Updates the board, and reports the change."""

    def __init__(self, board: Board, changed: Callable[[], None]) -> None:
        self._board, self._changed = board, changed

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """A check begins."""
        self._board.job_started(schedule, at_utc)
        self._changed()

    def job_progress(self, progress: Progress) -> None:
        """The check got further."""
        self._board.job_progress(progress)
        self._changed()

    def job_ended(self, doc: Doc | None) -> None:
        """The check ended."""
        self._board.job_ended(doc)
        self._changed()


class VerifiedWatch:
    """Watches which measurement verified the table in force, and updates broker and page when that changes: any process may roll back."""

    def __init__(self, look: Callable[[], VerifiedBy], publisher: Publisher | None, clock: Clock, changed: Callable[[], None]) -> None:
        self._look, self._publisher, self._clock, self._changed = look, publisher, clock, changed
        self._published: VerifiedBy | None = None

    async def run(self) -> None:
        """Watch forever. A database that does not answer is asked again."""
        while True:
            with suppress(StoreError):
                self._publish(await asyncio.to_thread(self._look))
            await self._clock.sleep(LOOK_S)

    def _publish(self, known: VerifiedBy) -> None:
        if known == self._published:
            return
        self._published = known
        if self._publisher is not None:
            self._publisher.set_verified(known.as_doc())
        self._changed()


class StatePublisher:
    """Keeps the retained state message up to date."""

    def __init__(self, publisher: Publisher, clock: Clock) -> None:
        self._publisher = publisher
        self._clock = clock

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """A check begins."""
        self._publisher.set_state("measuring", at_utc, schedule=schedule.name)

    def job_progress(self, progress: Progress) -> None:
        """Do nothing: the state is retained, so every change is a write in the broker. Progress is for the page."""

    def job_ended(self, doc: Doc | None) -> None:
        """The check ended."""
        self._publisher.set_state("online", self._clock.utc())
