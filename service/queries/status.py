"""The current status: state of the core, due slots, and the latest stored results."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal, Protocol

from pydantic import TypeAdapter

from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import Verification
from abbe.service.queries.reader import Reader
from abbe.service.queries.results import latest_checks
from abbe.service.queries.timetable import NextDue, next_due
from abbe.service.verification.alarm_states import folded, is_open
from abbe.service.verification.alarms import alarm_doc
from abbe.service.verification.verified_by import VerifiedBy, strange_table, verified_by

LATEST = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokerStatus:
    """Connection to the MQTT broker. ``waiting``, ``dropped``: numbers of messages."""

    configured: bool
    broker: str = ""
    connected: bool = False
    waiting: int = 0
    dropped: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenAlarm:
    """An alarm that is active or not acknowledged. ``signals``: figures that raised it; ``outcome``: actions so far."""

    alarm: int
    state: Literal["raised", "acknowledged", "cleared"]
    recipe: str
    schedule: str
    text: str
    signals: list[dict[str, str | float | None]]
    raised_utc: datetime
    acknowledged_by: str = ""
    cleared_utc: datetime | None = None
    outcome: str = ""
    proposal: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Activity:
    """State of the core: the running check, the devices, and what needs a person now."""

    job: RunningCheck | None
    devices: list[DeviceStatus]
    attention: list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveEvent(Activity):
    """One event of ``/api/v1/live``. ``revision`` grows when anything but the progress of a check changes."""

    event: Literal["moment"] = "moment"
    revision: int
    mqtt_connected: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Activity):
    """Content of the home page. ``revision`` changes when anything but the progress of a check changes; ``last``: checks, newest first;
    ``verified``: the measurement that verified the table in force."""

    machine: str
    version: str
    now_utc: datetime
    revision: str
    next_due: list[NextDue]
    mqtt: BrokerStatus
    alarms: list[OpenAlarm] = field(default_factory=list)
    last: list[Verification]
    verified: VerifiedBy


_ALARM = TypeAdapter(OpenAlarm)


class CoreState(Protocol):
    """Current state of the core. Every property raises CoreSilent while the core does not answer."""

    @property
    def devices(self) -> list[DeviceStatus]:
        """The devices and the time of their last answer."""
        ...

    @property
    def job(self) -> RunningCheck | None:
        """The running check."""
        ...

    @property
    def changes(self) -> int:
        """Counter that grows when anything but the progress of a check changes."""
        ...

    @property
    def mqtt_connected(self) -> bool:
        """Whether the broker is connected."""
        ...

    @property
    def mqtt_dropped(self) -> int:
        """Number of alarms that were dropped because too many waited for the broker."""
        ...

    @property
    def attention(self) -> list[str]:
        """What needs a person now."""
        ...


class StatusSource(Protocol):
    """Source of the status for the pages."""

    async def status(self) -> Status:
        """Content of the home page."""
        ...

    async def verifications(self, limit: int) -> list[Verification]:
        """The latest checks, newest first."""
        ...

    async def ready(self) -> None:
        """Return if the service can store and show a check now; otherwise raise the reason."""
        ...


class StatusReader:
    """Assembles the status; never writes.

    ``upcoming`` returns the next slot of each schedule, soonest first; ``broker``: address for people, empty without a broker.
    """

    def __init__(
        self, reader: Reader, version: str, core: CoreState, upcoming: Callable[[], Sequence[tuple[Schedule, datetime]]], broker: str
    ) -> None:
        self.reader, self._version, self._core, self._upcoming, self._broker = reader, version, core, upcoming, broker

    async def verifications(self, limit: int) -> list[Verification]:
        """The latest checks, newest first."""
        return await asyncio.to_thread(latest_checks, self.reader, limit)

    async def ready(self) -> None:
        """Return if the store is readable and the core has answered recently; otherwise raise the reason."""
        await self.verifications(1)
        _ = self._core.changes

    async def status(self) -> Status:
        """Content of the home page."""
        reader, core, upcoming = self.reader, self._core, self._upcoming()
        now, machine = reader.clock.utc(), reader.machine
        job, attention = core.job, core.attention
        entries = await asyncio.to_thread(reader.store.alarms.entries, machine)
        # A skipped slot leaves no check and perhaps no alarm: the revision has to contain the slot, or an open page would not notice it.
        slot = await asyncio.to_thread(reader.store.slots.newest, [f"{machine}/{schedule.name}" for schedule, _ in upcoming])
        strange = strange_table(attention)
        known = await asyncio.to_thread(verified_by, reader.store, machine, control=reader.control, strange=strange)
        last = await self.verifications(LATEST)
        prompt = 0 if job is None else job.prompt
        return Status(
            machine=machine,
            version=self._version,
            now_utc=now,
            revision=f"{last[0].id if last else 0}.{core.changes}.{len(entries)}.{prompt}.{known.why}{known.number}.{slot}",
            job=job,
            devices=core.devices,
            attention=attention,
            next_due=[next_due(schedule, slot_utc, now) for schedule, slot_utc in upcoming],
            mqtt=await self._mqtt(),
            alarms=[_ALARM.validate_python(alarm_doc(one)) for one in reversed(folded(entries)) if is_open(one)],
            last=last,
            verified=known,
        )

    async def _mqtt(self) -> BrokerStatus:
        if not self._broker:
            return BrokerStatus(configured=False)
        core, waiting = self._core, await asyncio.to_thread(self.reader.store.outbox.count)
        return BrokerStatus(configured=True, broker=self._broker, connected=core.mqtt_connected, waiting=waiting, dropped=core.mqtt_dropped)
