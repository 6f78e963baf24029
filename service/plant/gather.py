"""Gather the facts that OPC UA and MTConnect show about the machine: status, scheduled checks that were not run, and the push journal."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from abbe.service.domain.progress import DeviceStatus, RunningCheck
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, PushEntry, PushState
from abbe.service.domain.service_records import SlotRecord
from abbe.service.domain.verification import CheckFailure, Verification
from abbe.service.push.journal import NOT_YET, PushFacts, facts
from abbe.service.queries.status import Status
from abbe.service.storage.store import Store
from abbe.service.verification.verified_by import VerifiedBy


@dataclass(frozen=True, slots=True)
class PlantUnit:
    """A unit: its symbol, its UNECE code (OPC UA), and its name in MTConnect with the conversion factor."""

    symbol: str
    unece: str
    mtconnect: str = ""
    factor: float = 1.0

    @property
    def number(self) -> int:
        """UNECE code as the number that OPC UA uses (Part 8, 5.6.3.3): one byte per character."""
        return int.from_bytes(self.unece.encode(), "big")


UNITS = {
    "um": PlantUnit("µm", "4H", "MILLIMETER", 1e-3),
    "mm": PlantUnit("mm", "MMT", "MILLIMETER"),
    "urad": PlantUnit("µrad", "B97"),
    "ppm": PlantUnit("ppm", "59"),
    "s": PlantUnit("s", "SEC", "SECOND"),
    "c": PlantUnit("°C", "CEL", "CELSIUS"),
    "percent": PlantUnit("%", "P1", "PERCENT"),
}


def unit_of(key: str) -> PlantUnit | None:
    """Return the unit that ends a figure's name, e.g. ``um``; None if no unit does."""
    return UNITS.get(key.rpartition("_")[2]) if "_" in key else None


@dataclass(frozen=True, slots=True)
class PlantAlarm:
    """An event that a person should look at."""

    code: str
    text: str
    at_utc: datetime
    device: str = ""


@dataclass(frozen=True, slots=True)
class ActiveTable:
    """The active compensation table according to the push journal. The controller is not asked."""

    bank: int
    crc: int
    push: int
    since_utc: datetime


@dataclass(frozen=True, slots=True)
class PlantFacts:
    """Facts of one instant; checks and alarms newest first.

    ``table``: None if the journal does not show it; ``verified``: which measurement verified it, None if unknown.
    """

    machine: str
    version: str
    now_utc: datetime
    running: RunningCheck | None
    next_utc: datetime | None
    checks: tuple[Verification, ...]
    alarms: tuple[PlantAlarm, ...]
    devices: tuple[DeviceStatus, ...]
    table: ActiveTable | None = None
    verified: VerifiedBy | None = None

    @property
    def verdict(self) -> str | None:
        """Verdict of the last check if it measured the table in force, else the state of that table. None: no check yet."""
        if self.verified is not None and not self.verified.holds:
            return self.verified.state
        return self.checks[0].verdict if self.checks else None

    @property
    def state(self) -> str:
        """``measuring`` or ``idle``."""
        return "idle" if self.running is None else "measuring"


class FactsSource(Protocol):
    """Source of the facts. Reads only."""

    async def facts(self) -> PlantFacts:
        """Return the current facts.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        ...


SHOWN_ALARMS = 20
_NOT_RUN = {"missed": "SCH-001", "skipped": "SCH-002", "interrupted": "SCH-007"}


class Gatherer:
    """Reads the facts; never writes.

    Parameters
    ----------
    status : callable
        Returns the status page's data: machine, job, devices, next slots and last checks.
    store : Store, optional
        Source of scheduled checks that were not run, and of pushes. Without it there are only alarms of failed checks, and no table.
    """

    def __init__(self, status: Callable[[], Awaitable[Status]], store: Store | None = None, control: str = "") -> None:
        self._status, self._store, self._control = status, store, control
        self._revision = ""
        self._cached: tuple[tuple[PlantAlarm, ...], ActiveTable | None] = ((), None)

    async def facts(self) -> PlantFacts:
        """Return the current facts. The store is read again only when the status or the minute has changed.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        status = await self._status()
        revision = f"{status.revision} {status.now_utc:%H:%M}"
        if self._store is not None and revision != self._revision:
            self._cached = await asyncio.to_thread(self._read, self._store, status.machine)
            self._revision = revision
        failed = [_alarm_of(check, check.cause) for check in status.last if check.cause is not None]
        alarms = sorted([*failed, *self._cached[0]], key=lambda alarm: alarm.at_utc, reverse=True)
        return PlantFacts(
            machine=status.machine,
            version=status.version,
            now_utc=status.now_utc,
            running=status.job,
            next_utc=min((due.due_utc for due in status.next_due), default=None),
            checks=tuple(
                one for one in status.last if not one.push or one.verdict == "pass"
            ),  # a failed check of a push is about a table that was rolled back
            alarms=tuple(alarms[:SHOWN_ALARMS]),
            devices=tuple(status.devices),
            table=self._cached[1],
            verified=status.verified,
        )

    def _read(self, store: Store, machine: str) -> tuple[tuple[PlantAlarm, ...], ActiveTable | None]:
        slots = store.slots.not_run(machine, SHOWN_ALARMS)
        return tuple(_slot_alarm(slot) for slot in slots), table_in_force(store.pushes.last(machine, self._control))


def _alarm_of(check: Verification, cause: CheckFailure) -> PlantAlarm:
    return PlantAlarm(cause.code, cause.what, check.started_utc, cause.device)


def _slot_alarm(slot: SlotRecord) -> PlantAlarm:
    text = slot.reason or f"{slot.schedule}: slot {slot.slot_utc} was {slot.state}"
    return PlantAlarm(
        _NOT_RUN.get(slot.state.partition(":")[0], "SCH-001"), text, datetime.fromisoformat(slot.finished_utc or slot.claimed_utc)
    )


def table_in_force(journal: Sequence[PushEntry]) -> ActiveTable | None:
    """Return the active table according to the journal of the last push; None if unknown.

    Before activation and after a failed push the old table is active, after KEEP the new one, after a person's acceptance the accepted one.
    It is unknown between activation and the end of a push, and while the push waits for a person.
    """
    if not journal:
        return None
    last, known = journal[-1], facts(tuple(journal))
    bank, crc = _bank_and_crc(last.state, known)
    return None if NOT_YET in (bank, crc) else ActiveTable(bank, crc, last.push, datetime.fromisoformat(last.utc))


def _bank_and_crc(state: PushState, known: PushFacts) -> tuple[int, int]:
    """Bank and CRC of the table in force; `NOT_YET` if it is not known."""
    match state:
        case PushState.ACCEPTED:
            return known.accepted_bank, known.accepted_crc
        case PushState.KEEP:
            return known.target, known.crc
        case PushState.ROLLED_BACK:
            return known.bank, known.base_crc
        case _ if state in BEFORE_ACTIVATION or state in (PushState.REJECTED, PushState.ABORTED):
            return known.base_bank, known.base_crc
    return NOT_YET, NOT_YET
