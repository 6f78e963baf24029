"""Store methods for the slots of schedules: each is taken by one process only, and none stays open when that process is gone."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Row, select, update
from sqlalchemy.dialects.postgresql import insert as pg_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert

from abbe.service.domain.owner import Owner, this_process
from abbe.service.domain.service_records import SlotRecord
from abbe.service.errors import StoreError
from abbe.service.storage.base import StoreBase, utc_text
from abbe.service.storage.tables import slots

CLAIMED = "claimed"
RUNNING = "running"
RELEASED = "released"
"""Claimed and not started by a service that ended: the next one takes it."""

SLOT_COLUMNS = (slots.c.id, slots.c.schedule, slots.c.slot_utc, slots.c.state, slots.c.reason, slots.c.claimed_utc, slots.c.finished_utc)


class SlotStore(StoreBase):
    """Slots of schedules. UNIQUE (schedule, slot) makes each of them one row, whoever comes first."""

    def claim_slot(self, schedule: str, slot_utc: datetime | str) -> bool:
        """Take a slot of a schedule.

        Parameters
        ----------
        schedule : str
            Its name.
        slot_utc : datetime or str
            When it is due; text is ISO 8601 with time zone.

        Returns
        -------
        bool
            False if somebody has it.
        """
        values = {"schedule": schedule, "slot_utc": _slot(slot_utc), "state": CLAIMED, "claimed_utc": self._now()} | _owner(this_process())

        def work(connection: Connection) -> bool:
            fresh = pg_insert(slots) if connection.dialect.name == "postgresql" else sqlite_insert(slots)
            return connection.execute(fresh.values(values).on_conflict_do_nothing().returning(slots.c.id)).first() is not None

        return self._write(work)

    def begin_slot(self, schedule: str, slot_utc: datetime | str) -> None:
        """Note that the machine is about to move for a claimed slot: from here on it is never run by anybody else.

        Raises
        ------
        StoreError
            If nobody claimed it.
        """
        self._mark(schedule, slot_utc, {"state": RUNNING})

    def release_slot(self, schedule: str, slot_utc: datetime | str) -> None:
        """Give a claimed slot back that was not started: the next service decides on it.

        Raises
        ------
        StoreError
            If nobody claimed it.
        """
        self._mark(schedule, slot_utc, {"state": RELEASED} | _owner(None))

    def finish_slot(self, schedule: str, slot_utc: datetime | str, state: str, reason: str = "") -> None:
        """Write how a claimed slot ended.

        Parameters
        ----------
        schedule : str
            Its name.
        slot_utc : datetime or str
            As it was claimed.
        state : str
            E.g. ``"done"``; at most 30 characters.
        reason : str
            The sentence to it.

        Raises
        ------
        StoreError
            If nobody claimed it.
        """
        self._mark(schedule, slot_utc, {"state": state, "reason": reason, "finished_utc": self._now()})

    def adopt_slots(self, schedule: str) -> list[SlotRecord]:
        """Take over the open slots of a schedule whose process is gone; each is given to one caller only.

        Returns
        -------
        list of SlotRecord
            As they were found, in order of time; they belong to this process now.
        """
        query = select(*SLOT_COLUMNS, slots.c.owner_host, slots.c.owner_pid, slots.c.owner_start)
        query = query.where(slots.c.schedule == schedule, slots.c.finished_utc.is_(None)).order_by(slots.c.slot_utc)
        if not self._read(lambda connection: connection.execute(query).all()):
            return []

        def work(connection: Connection) -> list[SlotRecord]:
            me = _owner(this_process())
            return [slot_record(row) for row in connection.execute(query).all() if _is_nobodys(row) and _taken(connection, row, me)]

        return self._write(work)

    def slots_of(self, schedule: str, limit: int = 100) -> list[SlotRecord]:
        """List the latest slots of a schedule, newest first."""
        query = select(*SLOT_COLUMNS).where(slots.c.schedule == schedule).order_by(slots.c.slot_utc.desc()).limit(limit)
        return [slot_record(row) for row in self._read(lambda connection: connection.execute(query).all())]

    def newest_slot(self, schedules: Sequence[str]) -> str:
        """Return number and state of the slot of these schedules that was taken last, as one word; empty: none was."""
        query = select(slots.c.id, slots.c.state).where(slots.c.schedule.in_(schedules)).order_by(slots.c.id.desc()).limit(1)
        found = self._read(lambda connection: connection.execute(query).first())
        return "" if found is None else f"{found.id}-{found.state}"

    def _mark(self, schedule: str, slot_utc: datetime | str, values: dict[str, object]) -> None:
        key = _slot(slot_utc)
        statement = update(slots).where(slots.c.schedule == schedule, slots.c.slot_utc == key).values(values)
        if self._write(lambda connection: connection.execute(statement).rowcount) != 1:
            raise StoreError(f"slot {key} of schedule {schedule!r} was not claimed")


def _owner(owner: Owner | None) -> dict[str, object]:
    if owner is None:
        return {"owner_host": None, "owner_pid": None, "owner_start": None}
    return {"owner_host": owner.host, "owner_pid": owner.pid, "owner_start": owner.start}


def _is_nobodys(row: Row[*tuple[Any, ...]]) -> bool:
    return row.owner_pid is None or Owner(row.owner_host, row.owner_pid, row.owner_start).is_gone()


def _taken(connection: Connection, row: Row[*tuple[Any, ...]], me: dict[str, object]) -> bool:
    """Only from the owner that was seen: of two services that start together after a power cut one gets it."""
    was = slots.c.owner_pid.is_(None) if row.owner_pid is None else slots.c.owner_start == row.owner_start
    state = CLAIMED if row.state == RELEASED else row.state  # one that ran stays one that ran: it must not be run again
    statement = update(slots).where(slots.c.id == row.id, slots.c.state == row.state, was).values(me | {"state": state})
    return connection.execute(statement).rowcount == 1


def slot_record(row: Row[*tuple[Any, ...]]) -> SlotRecord:
    """Return a row of `SLOT_COLUMNS` as a record."""
    return SlotRecord(row.id, row.schedule, row.slot_utc, row.state, row.reason or "", row.claimed_utc, row.finished_utc)


def _slot(moment: datetime | str) -> str:
    if isinstance(moment, datetime):
        return utc_text(moment)
    try:
        return utc_text(datetime.fromisoformat(moment))
    except ValueError:
        raise StoreError(f"slot time {moment!r} is not ISO 8601", "write e.g. 2026-11-21T03:00:00Z") from None
