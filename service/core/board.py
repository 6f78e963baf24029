"""Current state known to the core: the running check, the devices, the broker. Kept in memory; results are in the store.

Watchers of the running job keep the board (and with it the page) and the broker up to date. `SnapshotSource` makes the `Snapshot`.
"""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from datetime import datetime, timedelta
from pathlib import Path

from abbe.service.channel.messages import Snapshot
from abbe.service.clock import Clock
from abbe.service.core.jobs import JobRegistry
from abbe.service.domain.document import TEXT, WORD, Doc
from abbe.service.domain.progress import DeviceStatus, Progress, RunningCheck
from abbe.service.domain.schedule import DueSlot, Schedule
from abbe.service.errors import StoreError
from abbe.service.mqtt.publisher import Publisher
from abbe.service.verification.verified_by import VerifiedBy


class Board:
    """Current state, reported by the job and the publisher; ``devices``: role and URL of each device of the machine file."""

    def __init__(self, devices: Mapping[str, str], clock: Clock) -> None:
        self._clock = clock
        self._devices_before: list[DeviceStatus] = []
        self.devices = [DeviceStatus(role=role, url=url, state="not used yet") for role, url in devices.items()]
        self.job: RunningCheck | None = None
        self.mqtt_connected = False
        self.mqtt_dropped = 0
        self.attention: list[str] = []
        self.changes = 0

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Note that a check begins."""
        self.changes += 1
        self.job = RunningCheck(schedule=schedule.name, recipe=schedule.recipe, since_utc=at_utc)
        self._devices_before = self.devices
        self.devices = [replace(device, state="in use", at_utc=at_utc, text="") for device in self.devices]

    def job_progress(self, progress: Progress) -> None:
        """Note the progress of the check."""
        if self.job is not None:
            self.job = replace(self.job, **{field.name: getattr(progress, field.name) for field in fields(Progress)})

    def job_ended(self, doc: Doc | None) -> None:
        """Note how the check ended. A stopped or failed check changes only the state of the device that caused its end."""
        self.changes += 1
        self.job = None
        cause = doc["cause"] if doc is not None else None
        if doc is None or cause is not None:
            self.devices = [self._blamed(device, cause) for device in self._devices_before]
        else:
            now = self._clock.utc()
            self.devices = [replace(device, state="answered", at_utc=now, text="") for device in self.devices]

    def _blamed(self, device: DeviceStatus, cause: Doc | None) -> DeviceStatus:
        if cause is None or cause["device"] not in {device.role, device.url}:
            return device
        return replace(device, state="fault", at_utc=self._clock.utc(), text=cause["what"])

    def changed(self) -> None:
        """Note any other change, such as a new text for a person."""
        self.changes += 1

    def broker(self, connected: bool) -> None:
        """Note whether the broker is connected."""
        if connected != self.mqtt_connected:
            self.changes += 1
            self.mqtt_connected = connected

    def messages_dropped(self, count: int) -> None:
        """Note that waiting messages were dropped because the broker was away for too long."""
        self.changes += 1
        self.mqtt_dropped += count


LOOK_S = 5.0


class BoardWatch:
    """Passes the events of checks on to the board, and calls ``changed``."""

    def __init__(self, board: Board, changed: Callable[[], None]) -> None:
        self._board, self._changed = board, changed

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Tell the board that a check begins."""
        self._board.job_started(schedule, at_utc)
        self._changed()

    def job_progress(self, progress: Progress) -> None:
        """Tell the board how far the check is."""
        self._board.job_progress(progress)
        self._changed()

    def job_ended(self, doc: Doc | None) -> None:
        """Tell the board how the check ended."""
        self._board.job_ended(doc)
        self._changed()


class StatePublisher:
    """Keeps the retained state message up to date."""

    def __init__(self, publisher: Publisher, clock: Clock) -> None:
        self._publisher = publisher
        self._clock = clock

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """Publish that the machine is being measured."""
        self._publisher.set_state("measuring", at_utc, schedule=schedule.name)

    def job_progress(self, progress: Progress) -> None:
        """Do nothing: the broker would write every change of a retained message to disk. The page shows the progress."""

    def job_ended(self, doc: Doc | None) -> None:
        """Publish that the service is online and idle."""
        self._publisher.set_state("online", self._clock.utc())


class VerifiedWatch:
    """Watches which measurement verified the table in force, and reports changes to broker and page, since any process may roll back."""

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


AGAIN = timedelta(minutes=1)
"""Time after which the timetable is evaluated again; sooner only if a slot has come due."""


class SnapshotSource:
    """Makes snapshots from the board, the registry of jobs (``jobs``), the timetable (``next_due``) and the clock."""

    def __init__(self, board: Board, jobs: JobRegistry, next_due: Callable[[], Sequence[tuple[Schedule, datetime]]], clock: Clock) -> None:
        self._board, self._jobs, self._next_due, self._clock = board, jobs, next_due, clock
        self._due: tuple[DueSlot, ...] = ()
        self._looked: datetime | None = None

    def now(self, web_restarts: int) -> Snapshot:
        """Return the present state of the service."""
        board = self._board
        devices = tuple(replace(d, role=d.role[:WORD], url=d.url[:TEXT], text=d.text[:TEXT]) for d in board.devices)
        attention = tuple(text[:TEXT] for text in board.attention)
        return Snapshot(
            "snapshot",
            board.changes,
            self._check(),
            devices,
            self._slots(),
            board.mqtt_connected,
            board.mqtt_dropped,
            attention,
            rss_bytes(),
            web_restarts,
        )

    def _check(self) -> RunningCheck | None:
        check, job = self._board.job, self._jobs.running
        if check is None:
            return None
        if job is not None:
            check = replace(check, id=job.id, state=job.state, prompt=job.prompt, ask=job.ask)
        return replace(
            check,
            schedule=check.schedule[:WORD],
            recipe=check.recipe[:WORD],
            stage=check.stage[:WORD],
            message=check.message[:TEXT],
            why=check.why[:TEXT],
            done=check.done if math.isfinite(check.done) else 0.0,
            total=check.total if math.isfinite(check.total) else 0.0,
            eta_s=check.eta_s if check.eta_s is not None and math.isfinite(check.eta_s) else None,
        )

    def _slots(self) -> tuple[DueSlot, ...]:
        now = self._clock.utc()
        come = any(due.slot_utc <= now for due in self._due)
        if self._looked is None or come or not self._looked <= now < self._looked + AGAIN:
            self._looked = now
            self._due = tuple(DueSlot(schedule=schedule, slot_utc=slot) for schedule, slot in self._next_due()[:200])
        return self._due


def rss_bytes() -> int:
    """Return the resident memory of this process, bytes; 0 where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return 0
