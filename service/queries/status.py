"""The current status: state of the core, due slots, and the latest stored results."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import Literal, Protocol

from abbe.service.domain.progress import DeviceStatus, RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AlarmKind
from abbe.service.domain.verification import Verification
from abbe.service.queries.checks import latest_checks
from abbe.service.queries.reader import Reader
from abbe.service.queries.timetable import NextDue, next_due
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import Alarm, AlarmHead, folded, is_open
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
class AlarmWork:
    """One step of the service's work on an alarm."""

    kind: AlarmKind
    utc: datetime
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmSummary(AlarmHead):
    """An alarm for people. If the alarm is over, ``signals`` are those that raised it.

    ``priority``: as in `Alarm`; ``outcome``: latest result of the work on the alarm.
    """

    alarm: int
    state: Literal["raised", "acknowledged", "cleared", "closed"]
    priority: int
    outcome: str = ""
    work: Sequence[AlarmWork] = ()
    proposal: int | None = None

    def is_shelved(self, now: datetime) -> bool:
        """Whether a person shelved the alarm until a later time than ``now``."""
        return self.shelved_until_utc is not None and self.shelved_until_utc > now


@dataclass(frozen=True, slots=True, kw_only=True)
class Activity:
    """State of the core: the running check, the devices, and what needs a person now."""

    job: RunningCheck | None
    devices: list[DeviceStatus]
    attention: list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveEvent(Activity):
    """One event of ``/api/v1/live``. ``revision`` grows when anything but the progress of a check changes."""

    event: Literal["snapshot"] = "snapshot"
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
    alarms: list[AlarmSummary] = field(default_factory=list)
    last: list[Verification]
    verified: VerifiedBy


class CoreState(Protocol):
    """Current state of the core. Every property raises CoreUnavailable while the core does not answer."""

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
        """Reason why a person is needed now."""
        ...


class StatusSource(Protocol):
    """Source of the status for the pages."""

    async def status(self) -> Status:
        """Return the content of the home page."""
        ...

    async def verifications(self, limit: int) -> list[Verification]:
        """Return the latest checks, newest first."""
        ...

    async def ready(self) -> None:
        """Do nothing if the store is readable and the core has answered recently; otherwise raise the reason."""
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
        """Return the latest checks, newest first."""
        return await asyncio.to_thread(latest_checks, self.reader, limit)

    async def ready(self) -> None:
        """Do nothing if the store is readable and the core has answered recently; otherwise raise the reason."""
        await self.verifications(1)
        _ = self._core.changes

    async def status(self) -> Status:
        """Return the content of the home page."""
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
            alarms=summaries(folded(entries)),
            last=last,
            verified=known,
        )

    async def _mqtt(self) -> BrokerStatus:
        if not self._broker:
            return BrokerStatus(configured=False)
        core, waiting = self._core, await asyncio.to_thread(self.reader.store.outbox.count)
        return BrokerStatus(configured=True, broker=self._broker, connected=core.mqtt_connected, waiting=waiting, dropped=core.mqtt_dropped)


def alarms(store: Store, machine: str, *, every: bool = False) -> list[AlarmSummary]:
    """Return the alarms of a machine, newest first: those that are active or not acknowledged, or all of them."""
    return summaries(folded(store.alarms.entries(machine)), every=every)


def summaries(found: Sequence[Alarm], *, every: bool = False) -> list[AlarmSummary]:
    """Convert alarms (oldest first) to summaries for people (newest first): the open alarms, or every alarm."""
    return [_alarm(one) for one in reversed(found) if every or is_open(one)]


def _alarm(one: Alarm) -> AlarmSummary:
    proposed = one.last(AlarmKind.PROPOSED)
    head = {item.name: getattr(one, item.name) for item in fields(AlarmHead)}
    return AlarmSummary(
        **head | {"signals": one.signals or one.first},
        alarm=one.number,
        state=one.word,
        priority=one.priority,
        outcome=one.outcome,
        work=[AlarmWork(kind=s.kind, utc=datetime.fromisoformat(s.utc), text=s.facts.text) for s in one.work],
        proposal=None if proposed is None else proposed.facts.proposal,
    )
