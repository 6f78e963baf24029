"""Slots of schedules: one process only claims each, and another adopts it when that process no longer runs."""

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
"""A service ended after claiming the slot and before starting it: the next service takes it."""
NOT_RUN = ("missed", "skipped", "interrupted")
_OWNER = owner_of(slots)
_NO_OWNER: dict[str, object] = {"owner_host": None, "owner_pid": None, "owner_start": None}


class Slots(Repository):
    """Slots of schedules. UNIQUE (schedule, slot) makes each of them one row.

    Arguments ``slot_utc`` are when a slot is due; text is ISO 8601 with time zone.
    """

    def claim(self, schedule: str, slot_utc: datetime | str) -> bool:
        """Claim a slot of a schedule; False if it is taken."""
        values = {"schedule": schedule, "slot_utc": _slot(slot_utc), "state": CLAIMED, "claimed_utc": self._db.now()}

        def work(connection: Connection) -> bool:
            fresh = dialect_insert(connection, slots).values(values | _OWNER.values(this_process()))
            return connection.execute(fresh.on_conflict_do_nothing().returning(slots.c.id)).first() is not None

        return self._db.commit(work)

    def begin(self, schedule: str, slot_utc: datetime | str) -> None:
        """Store that the machine is about to move for a claimed slot: no other process will run it. Raises StoreError if unclaimed."""
        self._mark(schedule, slot_utc, {"state": RUNNING})

    def release(self, schedule: str, slot_utc: datetime | str) -> None:
        """Release a claimed slot that was not started: the next service decides on it. Raises StoreError if unclaimed."""
        self._mark(schedule, slot_utc, _NO_OWNER | {"state": RELEASED})

    def finish(self, schedule: str, slot_utc: datetime | str, state: str, reason: str = "") -> None:
        """Store how a claimed slot ended: ``state``, at most 30 characters (``"done"``), and a sentence. Raises StoreError if unclaimed."""
        self._mark(schedule, slot_utc, {"state": state, "reason": reason, "finished_utc": self._db.now()})

    def adopt(self, schedule: str) -> list[SlotRecord]:
        """Take over the open slots of a schedule whose process no longer runs; only one caller gets each.

        Returns the slots as they were found, in order of time; they belong to this process now.
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
        """Id and state of the last claimed slot of these schedules as one text; empty: none was claimed."""
        found = self._all(SLOT, slots.c.schedule.in_(schedules), newest=True, limit=1)
        return "".join(f"{one.id}-{one.state}" for one in found)

    def last_due(self, schedule: str) -> datetime | None:
        """Due time of the latest claimed slot of a schedule; None: none was claimed."""
        found = self._all(SLOT, slots.c.schedule == schedule, order=slots.c.slot_utc, newest=True, limit=1)
        return datetime.fromisoformat(found[0].slot_utc) if found else None

    def not_run(self, machine: str, limit: int = 20) -> list[SlotRecord]:
        """List the latest slots of a machine that were missed, skipped or interrupted, newest first."""
        states = or_(*(slots.c.state.startswith(word) for word in NOT_RUN))
        return self._all(SLOT, _timetable_of(machine), states, newest=True, limit=limit)

    def counts(self, machine: str) -> dict[str, int]:
        """Number of slots of a machine's timetables by state."""
        query = select(slots.c.state, func.count()).where(_timetable_of(machine)).group_by(slots.c.state)
        return {str(state): int(count) for state, count in self._db.read(lambda connection: connection.execute(query).all())}

    def _mark(self, schedule: str, slot_utc: datetime | str, values: dict[str, object]) -> None:
        key = _slot(slot_utc)
        statement = update(slots).where(slots.c.schedule == schedule, slots.c.slot_utc == key).values(values)
        if self._db.commit(lambda connection: connection.execute(statement).rowcount) != 1:
            raise StoreError(f"slot {key} of schedule {schedule!r} was not claimed")


def _take(connection: Connection, slot: SlotRecord, owner: Owner | None) -> bool:
    """Take a slot only from the owner that was read: of two services that start together after a power cut, one gets it."""
    was = slots.c.owner_pid.is_(None) if owner is None else slots.c.owner_start == owner.start
    state = CLAIMED if slot.state == RELEASED else slot.state  # a slot that ran keeps that state: it must not run again
    statement = update(slots).where(slots.c.id == slot.id, slots.c.state == slot.state, was)
    return connection.execute(statement.values(_OWNER.values(this_process()) | {"state": state})).rowcount == 1


def _timetable_of(machine: str) -> ColumnElement[bool]:
    """Condition for the slots of a machine. Not LIKE: SQLite would match MILL-7 for mill-7."""
    prefix = f"{machine}/"
    return func.substr(slots.c.schedule, 1, len(prefix)) == prefix


def _slot(due: datetime | str) -> str:
    if isinstance(due, datetime):
        return utc_text(due)
    try:
        return utc_text(datetime.fromisoformat(due))
    except ValueError:
        raise StoreError(f"slot time {due!r} is not ISO 8601", "write e.g. 2026-11-21T03:00:00Z") from None
