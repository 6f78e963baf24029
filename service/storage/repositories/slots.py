"""Slots of schedules: each is taken by one process only, and none stays open when that process no longer runs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, Connection, func, or_, select, update

from abbe.service.domain.owner import Owner, this_process
from abbe.service.domain.service_records import SlotRecord
from abbe.service.domain.utc import utc_text
from abbe.service.errors import StoreError
from abbe.service.storage.mapping import SLOT, owner_of
from abbe.service.storage.repository import Repository, dialect_insert
from abbe.service.storage.tables import slots

CLAIMED = "claimed"
RUNNING = "running"
RELEASED = "released"
"""Claimed and not started by a service that ended: the next one takes it."""
NOT_RUN = ("missed", "skipped", "interrupted")
_OWNER = owner_of(slots)
_NO_OWNER: dict[str, object] = {"owner_host": None, "owner_pid": None, "owner_start": None}


class Slots(Repository):
    """Slots of schedules. UNIQUE (schedule, slot) makes each of them one row.

    Arguments ``slot_utc`` are when a slot is due; text is ISO 8601 with time zone.
    """

    def claim(self, schedule: str, slot_utc: datetime | str) -> bool:
        """Take a slot of a schedule; False if it is taken."""
        values = {"schedule": schedule, "slot_utc": _slot(slot_utc), "state": CLAIMED, "claimed_utc": self._db.now()}

        def work(connection: Connection) -> bool:
            fresh = dialect_insert(connection, slots).values(values | _OWNER.values(this_process()))
            return connection.execute(fresh.on_conflict_do_nothing().returning(slots.c.id)).first() is not None

        return self._db.commit(work)

    def begin(self, schedule: str, slot_utc: datetime | str) -> None:
        """Note that the machine is about to move for a claimed slot: from here on no other process runs it.

        Raises
        ------
        StoreError
            It was not claimed.
        """
        self._mark(schedule, slot_utc, {"state": RUNNING})

    def release(self, schedule: str, slot_utc: datetime | str) -> None:
        """Give a claimed slot back that was not started: the next service decides on it.

        Raises
        ------
        StoreError
            It was not claimed.
        """
        self._mark(schedule, slot_utc, _NO_OWNER | {"state": RELEASED})

    def finish(self, schedule: str, slot_utc: datetime | str, state: str, reason: str = "") -> None:
        """Write how a claimed slot ended: ``state``, at most 30 characters (``"done"``), and the sentence to it.

        Raises
        ------
        StoreError
            It was not claimed.
        """
        self._mark(schedule, slot_utc, {"state": state, "reason": reason, "finished_utc": self._db.now()})

    def adopt(self, schedule: str) -> list[SlotRecord]:
        """Take over the open slots of a schedule whose process no longer runs; each is given to one caller only.

        Returns
        -------
        list of SlotRecord
            As they were found, in order of time; they belong to this process now.
        """
        owner = (slots.c.owner_host, slots.c.owner_pid, slots.c.owner_start)
        query = SLOT.select().add_columns(*owner).where(slots.c.schedule == schedule, slots.c.finished_utc.is_(None))
        query = query.order_by(slots.c.slot_utc)
        if not self._db.read(lambda connection: connection.execute(query).all()):
            return []

        def work(connection: Connection) -> list[SlotRecord]:
            adopted = []
            for row in connection.execute(query).all():
                owner = None if row.owner_pid is None else Owner(row.owner_host, row.owner_pid, row.owner_start)
                slot = SLOT.read(row)
                if (owner is None or owner.is_gone()) and _take(connection, slot, owner):
                    adopted.append(slot)
            return adopted

        return self._db.commit(work)

    def latest(self, schedule: str, limit: int = 100) -> list[SlotRecord]:
        """List the latest slots of a schedule, newest first."""
        return self._all(SLOT, slots.c.schedule == schedule, order=slots.c.slot_utc, newest=True, limit=limit)

    def newest(self, schedules: Sequence[str]) -> str:
        """Number and state of the slot of these schedules that was taken last, as one word; empty: none was."""
        found = self._all(SLOT, slots.c.schedule.in_(schedules), newest=True, limit=1)
        return "".join(f"{one.id}-{one.state}" for one in found)

    def last_due(self, schedule: str) -> datetime | None:
        """When the latest slot of a schedule was due that any process claimed; None: there is none."""
        found = self._all(SLOT, slots.c.schedule == schedule, order=slots.c.slot_utc, newest=True, limit=1)
        return datetime.fromisoformat(found[0].slot_utc) if found else None

    def not_run(self, machine: str, limit: int = 20) -> list[SlotRecord]:
        """List the latest slots of a machine that were missed, skipped or interrupted, newest first."""
        states = or_(*(slots.c.state.startswith(word) for word in NOT_RUN))
        return self._all(SLOT, _timetable_of(machine), states, newest=True, limit=limit)

    def counts(self, machine: str) -> dict[str, int]:
        """How many slots of a machine's timetables are in each state."""
        query = select(slots.c.state, func.count()).where(_timetable_of(machine)).group_by(slots.c.state)
        return {str(state): int(count) for state, count in self._db.read(lambda connection: connection.execute(query).all())}

    def _mark(self, schedule: str, slot_utc: datetime | str, values: dict[str, object]) -> None:
        key = _slot(slot_utc)
        statement = update(slots).where(slots.c.schedule == schedule, slots.c.slot_utc == key).values(values)
        if self._db.commit(lambda connection: connection.execute(statement).rowcount) != 1:
            raise StoreError(f"slot {key} of schedule {schedule!r} was not claimed")


def _take(connection: Connection, slot: SlotRecord, owner: Owner | None) -> bool:
    """Only from the owner that was seen: of two services that start together after a power cut one gets it."""
    was = slots.c.owner_pid.is_(None) if owner is None else slots.c.owner_start == owner.start
    state = CLAIMED if slot.state == RELEASED else slot.state  # one that ran stays one that ran: it must not be run again
    statement = update(slots).where(slots.c.id == slot.id, slots.c.state == slot.state, was)
    return connection.execute(statement.values(_OWNER.values(this_process()) | {"state": state})).rowcount == 1


def _timetable_of(machine: str) -> ColumnElement[bool]:
    """Slots of a machine. Not by LIKE: SQLite's takes mill-7 and MILL-7 for the same machine."""
    prefix = f"{machine}/"
    return func.substr(slots.c.schedule, 1, len(prefix)) == prefix


def _slot(moment: datetime | str) -> str:
    if isinstance(moment, datetime):
        return utc_text(moment)
    try:
        return utc_text(datetime.fromisoformat(moment))
    except ValueError:
        raise StoreError(f"slot time {moment!r} is not ISO 8601", "write e.g. 2026-11-21T03:00:00Z") from None
