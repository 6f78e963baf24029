"""Puts together what the page and its JSON show: the board, the timetable and the store."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Protocol
from zoneinfo import ZoneInfo

from abbe.service.clock import Clock
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.running_check import RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.slots import cron_in_words
from abbe.service.scheduler.store import ServiceStore
from abbe.service.verification.alarm_states import folded, is_open
from abbe.service.verification.alarms import alarm_doc
from abbe.service.verification.verified_by import VerifiedBy, strange_table, verified_by
from abbe.service.web import words
from abbe.service.web.schemas import Alarm, Due, Mqtt, Status, Verification, Verified


class PageStatus(Protocol):
    """How things stand now. All of it raises CoreSilent while nobody knows."""

    @property
    def devices(self) -> list[DeviceStatus]:
        """The devices, and when they were last heard of."""
        ...

    @property
    def job(self) -> RunningCheck | None:
        """The check that runs."""
        ...

    @property
    def changes(self) -> int:
        """Grows when more than the progress of a check has changed."""
        ...

    @property
    def mqtt_connected(self) -> bool:
        """Whether the broker is there."""
        ...

    @property
    def mqtt_dropped(self) -> int:
        """Alarms that were dropped because too many waited for the broker."""
        ...

    @property
    def attention(self) -> list[str]:
        """What needs a person now."""
        ...


class View:
    """Reads; never writes.

    Parameters
    ----------
    machine : str
        Name of the machine.
    version : str
        Version of this program.
    board : PageStatus
        The moment.
    archive : ServiceStore
        The past.
    next_due : callable
        The future.
    broker : str
        Address of the broker as shown to people; empty if there is none in the machine file.
    clock : Clock
        Now.
    """

    def __init__(  # noqa: PLR0913 - what one page shows, from where each is known
        self,
        machine: str,
        version: str,
        board: PageStatus,
        archive: ServiceStore,
        next_due: Callable[[], Sequence[tuple[Schedule, datetime]]],
        broker: str,
        clock: Clock,
        control: str = "",
    ) -> None:
        self._machine = machine
        self._version = version
        self._board = board
        self._archive = archive
        self._next_due = next_due
        self._broker = broker
        self._clock = clock
        self._control = control

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

    async def ready(self) -> None:
        """Return if the store can be read and the core has said lately how things stand; else raise what is wrong."""
        await self.verifications(1)
        _ = self._board.changes

    async def status(self) -> Status:
        """Return everything the page shows."""
        last = await self.verifications(10)
        mqtt = Mqtt(configured=False)
        if self._broker:
            waiting = await asyncio.to_thread(self._archive.waiting_messages)
            board = self._board
            mqtt = Mqtt(configured=True, broker=self._broker, connected=board.mqtt_connected, waiting=waiting, dropped=board.mqtt_dropped)
        now = self._clock.utc()
        entries = await asyncio.to_thread(self._archive.alarm_entries, self._machine)
        upcoming = self._next_due()
        # A slot that was skipped leaves no check and may leave no alarm: without it an open page would go on as if it had not been due.
        slot = await asyncio.to_thread(self._archive.newest_slot, [f"{self._machine}/{schedule.name}" for schedule, _ in upcoming])
        job, attention = self._board.job, self._board.attention
        known = await asyncio.to_thread(verified_by, self._archive, self._machine, control=self._control, strange=strange_table(attention))
        asked = 0 if job is None else job.prompt
        return Status(
            machine=self._machine,
            version=self._version,
            now_utc=now,
            revision=f"{last[0].id if last else 0}.{self._board.changes}.{len(entries)}.{asked}.{known.why}{known.number}.{slot}",
            job=job,
            devices=self._board.devices,
            next_due=[_due(schedule, slot_utc, now) for schedule, slot_utc in upcoming],
            mqtt=mqtt,
            alarms=[Alarm.model_validate(alarm_doc(one)) for one in reversed(folded(entries)) if is_open(one)],
            last=last,
            attention=attention,
            verified=_verified(known),
        )


def _verified(known: VerifiedBy) -> Verified:
    utc = datetime.fromisoformat(known.utc) if known.utc else None
    return Verified(state=known.state, why=known.why, number=known.number, utc=utc, text=known.text, changes=list(known.changes))


def _due(schedule: Schedule, slot: datetime, now: datetime) -> Due:
    return Due(
        schedule=schedule.name,
        recipe=schedule.recipe,
        due_utc=slot,
        timezone=schedule.timezone,
        cron_words=cron_in_words(schedule),
        words=words.due(slot, now, ZoneInfo(schedule.timezone)),
    )
