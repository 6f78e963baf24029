"""Gather the facts from the status page's data, the slots that were not run, and the journal of pushes."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from datetime import datetime

from abbe.service.domain.push_entry import BEFORE_ACTIVATION, PushEntry, PushState
from abbe.service.domain.service_records import SlotRecord
from abbe.service.domain.verification import CheckFailure, Verification
from abbe.service.plant.facts import ActiveTable, PlantAlarm, PlantFacts
from abbe.service.push.journal import NOT_YET, PushFacts, facts
from abbe.service.queries.status import Status
from abbe.service.storage.store import Store

SHOWN_ALARMS = 20
_NOT_RUN = {"missed": "SCH-001", "skipped": "SCH-002", "interrupted": "SCH-007"}


class Gatherer:
    """Reads the facts; never writes.

    Parameters
    ----------
    status : callable
        Returns the status page's data: machine, job, devices, next slots and last checks.
    store : Store, optional
        Slots and pushes. Without it there are only the alarms of failed checks, and no table.
    """

    def __init__(self, status: Callable[[], Awaitable[Status]], store: Store | None = None, control: str = "") -> None:
        self._status, self._store, self._control = status, store, control
        self._revision = ""
        self._cached: tuple[tuple[PlantAlarm, ...], ActiveTable | None] = ((), None)

    async def facts(self) -> PlantFacts:
        """Return the current facts. Slots and pushes are read again when the status or the minute has changed.

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
    """Return the active table, as far as the journal of the last push knows it.

    Before activation and after a push that failed it is the old one, after KEEP the new one, after a person's acceptance the accepted one.
    Between activation and the end, and where a person has to look, it is unknown: None.
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
