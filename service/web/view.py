"""Puts together what the page and its JSON show: the board, the timetable and the store."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Protocol
from zoneinfo import ZoneInfo

from service.clock import Clock
from service.scheduler.slots import Schedule, cron_in_words
from service.storage.records import VerificationRecord
from service.web import words
from service.web.board import Board
from service.web.schemas import Due, Mqtt, Status, Verification


class Archive(Protocol):
    """The part of the store that is read here."""

    def verifications_of(self, machine: str, limit: int = ...) -> list[VerificationRecord]:
        """Return the latest checks, newest first."""
        ...

    def waiting_messages(self) -> int:
        """Return how many messages wait for the broker."""
        ...


class View:
    """Reads; never writes.

    Parameters
    ----------
    machine : str
        Name of the machine.
    version : str
        Version of this program.
    board : Board
        The moment.
    archive : Archive
        The past.
    next_due : callable
        The future.
    broker : str
        Address of the broker as shown to people; empty if there is none in the machine file.
    clock : Clock
        Now.
    """

    def __init__(
        self,
        machine: str,
        version: str,
        board: Board,
        archive: Archive,
        next_due: Callable[[], Sequence[tuple[Schedule, datetime]]],
        broker: str,
        clock: Clock,
    ) -> None:
        self._machine = machine
        self._version = version
        self._board = board
        self._archive = archive
        self._next_due = next_due
        self._broker = broker
        self._clock = clock

    async def verifications(self, limit: int) -> list[Verification]:
        """Return the latest checks, newest first."""
        rows = await asyncio.to_thread(self._archive.verifications_of, self._machine, limit)
        # Rows of other makers (a check from the command line) may lack what a schedule knows.
        blank = {"schedule": "", "recipe": "", "duration_s": 0.0, "values": {}, "uncertainties": {}, "limits": {}, "runs": [], "text": ""}
        return [
            Verification.model_validate(
                {
                    **blank,
                    "machine": self._machine,
                    "slot_utc": row.utc,
                    "started_utc": row.utc,
                    **row.doc,
                    "id": row.id,
                    "verdict": row.verdict,
                }
            )
            for row in rows
        ]

    async def status(self) -> Status:
        """Return everything the page shows."""
        last = await self.verifications(10)
        mqtt = Mqtt(configured=False)
        if self._broker:
            waiting = await asyncio.to_thread(self._archive.waiting_messages)
            mqtt = Mqtt(configured=True, broker=self._broker, connected=self._board.mqtt_connected, waiting=waiting)
        now = self._clock.utc()
        return Status(
            machine=self._machine,
            version=self._version,
            now_utc=now,
            revision=f"{last[0].id if last else 0}.{self._board.changes}",
            job=self._board.job,
            devices=self._board.devices,
            next_due=[_due(schedule, slot, now) for schedule, slot in self._next_due()],
            mqtt=mqtt,
            last=last,
        )


def _due(schedule: Schedule, slot: datetime, now: datetime) -> Due:
    return Due(
        schedule=schedule.name,
        recipe=schedule.recipe,
        due_utc=slot,
        timezone=schedule.timezone,
        cron_words=cron_in_words(schedule),
        words=words.due(slot, now, ZoneInfo(schedule.timezone)),
    )
