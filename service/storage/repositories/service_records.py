"""Records of the service itself: alarms, messages for the broker, slots of schedules, heartbeats, stored replies, and the audit.

Alarms and audit are append-only. An alarm entry is stored together with its messages; each audit event is chained to the one before it.
Only one process can claim a slot; another adopts the slot when that process no longer runs.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, Connection, delete, func, or_, select, text, update
from sqlalchemy.exc import IntegrityError

from abbe.service.clock import utc_text
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import Owner, this_process
from abbe.service.domain.service_records import (
    AlarmEntryRecord,
    AlarmFacts,
    AlarmKind,
    AuditEvent,
    HeartbeatRecord,
    OutboxRecord,
    ReplyRecord,
    SlotRecord,
)
from abbe.service.errors import StoreError
from abbe.service.storage.database import (
    ALARM_ENTRY,
    AUDIT,
    HEARTBEAT,
    OUTBOX,
    REPLY,
    SLOT,
    Repository,
    dialect_insert,
    insert_row,
    owner_of,
)
from abbe.service.storage.tables import alarm_entries, audit, heartbeats, outbox, replies, slots


class Outbox(Repository):
    """Messages for the broker."""

    def add(self, topic: str, payload: bytes | str) -> int:
        """Put a message into the outbox; it stays until it is sent. Text is stored as UTF-8."""
        data = payload.encode() if isinstance(payload, str) else payload
        return self._add(outbox, topic=topic, payload=data, created_utc=self._db.now())

    def add_document(self, topic: str, doc: Doc) -> None:
        """Put a JSON message into the outbox."""
        self._db.commit(lambda connection: queue_message(connection, topic, doc, self._db.now()))

    def count(self) -> int:
        """Number of messages that wait for the broker."""
        query = select(func.count()).select_from(outbox).where(outbox.c.sent_utc.is_(None))
        return int(self._db.read(lambda connection: connection.execute(query).scalar_one()))

    def pending(self, limit: int = 100) -> list[OutboxRecord]:
        """List unsent messages in the order in which they were added."""
        return self._all(OUTBOX, outbox.c.sent_utc.is_(None), limit=limit)

    def done(self, message_id: int) -> None:
        """Mark a message as sent; a second call changes nothing."""
        statement = update(outbox).where(outbox.c.id == message_id, outbox.c.sent_utc.is_(None)).values(sent_utc=self._db.now())
        self._db.commit(lambda connection: connection.execute(statement))

    def prune(self, keep: int, at_most: int = 1000) -> int:
        """Delete sent messages, oldest first; return how many.

        The newest ``keep`` stay, at least one, because a database that numbers by "largest id plus one" would reuse an id. One call deletes
        at most ``at_most``; call again while it returns that number.
        """
        sent = select(outbox.c.id).where(outbox.c.sent_utc.is_not(None))
        newest = sent.order_by(outbox.c.id.desc()).limit(max(keep, 1))
        old = sent.where(outbox.c.id < select(func.min(newest.subquery().c.id)).scalar_subquery()).order_by(outbox.c.id).limit(at_most)
        return int(self._db.commit(lambda connection: connection.execute(delete(outbox).where(outbox.c.id.in_(old))).rowcount))

    def shed(
        self, topics: Sequence[str], most: int, down_to: int, notice: Callable[[int, str, str], tuple[str, bytes]] | None = None
    ) -> int:
        """Drop the oldest waiting messages of some topics if more than ``most`` of them wait; return how many were dropped.

        Parameters
        ----------
        topics : sequence of str
            Topics whose messages may be dropped.
        down_to : int
            How many of the newest messages stay; at least one.
        notice : callable, optional
            Makes topic and payload of a message about the loss, from the number of dropped messages and the times of the oldest and the
            newest. The message is queued in the same transaction, so that no loss is silent.
        """
        waiting = (outbox.c.sent_utc.is_(None), outbox.c.topic.in_(topics))

        def work(connection: Connection) -> int:
            count = int(connection.execute(select(func.count()).where(*waiting)).scalar_one())
            if count <= most:
                return 0
            kept = connection.execute(select(outbox.c.id).where(*waiting).order_by(outbox.c.id.desc()).limit(max(down_to, 1))).scalars()
            surplus = (*waiting, outbox.c.id < min(kept))
            span = connection.execute(select(func.min(outbox.c.created_utc), func.max(outbox.c.created_utc)).where(*surplus)).one()
            dropped = int(connection.execute(delete(outbox).where(*surplus)).rowcount)
            if notice is not None:
                topic, payload = notice(dropped, *span)
                insert_row(connection, outbox, topic=topic, payload=payload, created_utc=self._db.now())
            return dropped

        return self._db.commit(work)


def queue_message(connection: Connection, topic: str, doc: Doc, now: str) -> None:
    """Put a JSON message into the outbox within a transaction."""
    payload = json.dumps(doc, ensure_ascii=False, allow_nan=False).encode()
    insert_row(connection, outbox, topic=topic, payload=payload, created_utc=now)


class Alarms(Repository):
    """Alarms of machines."""

    def append(
        self, machine: str, alarm: int | None, seq: int, kind: AlarmKind, facts: AlarmFacts, messages: Sequence[tuple[str, Doc]] = ()
    ) -> AlarmEntryRecord:
        """Append an entry to an alarm and queue its messages for the broker in one transaction; return the entry.

        Parameters
        ----------
        alarm : int or None
            None: begin the machine's next alarm. 0 collects entries that belong to no alarm.
        seq : int
            Number of the last entry that the caller has read, plus one, so that a decision on stale data is refused.
        messages : sequence of (topic, document)
            Each document gets the number of the alarm.

        Raises
        ------
        StoreError
            Another process wrote this entry meanwhile.
        """

        def work(connection: Connection) -> AlarmEntryRecord:
            last = select(func.coalesce(func.max(alarm_entries.c.alarm), 0)).where(alarm_entries.c.machine == machine)
            number = alarm if alarm is not None else int(connection.execute(last).scalar_one()) + 1
            entry = AlarmEntryRecord(machine=machine, alarm=number, seq=seq, kind=kind, facts=facts, utc=self._db.now())
            try:
                entry_id = insert_row(connection, alarm_entries, **ALARM_ENTRY.values(entry, "id"))
            except IntegrityError:
                raise StoreError(
                    f"another process changed alarm {number} of {machine} meanwhile", "look at the alarm, then try again"
                ) from None
            for topic, message in messages:
                queue_message(connection, topic, {"alarm": number, **message}, self._db.now())
            return replace(entry, id=entry_id)

        return self._db.commit(work)

    def entries(self, machine: str) -> list[AlarmEntryRecord]:
        """Read all entries of a machine's alarms in the order of writing."""
        return self._all(ALARM_ENTRY, alarm_entries.c.machine == machine)


class Heartbeats(Repository):
    """Heartbeats of the services that use this database."""

    def put(self, machine: str, doc: Doc) -> None:
        """Write the present state of this process as the service of a machine."""
        values = {"doc": doc, "seen_utc": self._db.now(), **owner_of(heartbeats).values(this_process())}

        def work(connection: Connection) -> None:
            statement = dialect_insert(connection, heartbeats).values(machine=machine, **values)
            connection.execute(statement.on_conflict_do_update(index_elements=[heartbeats.c.machine], set_=values))

        self._db.commit(work)

    def all(self) -> dict[str, HeartbeatRecord]:
        """The latest state of each service, by machine."""
        return {one.machine: one for one in self._all(HEARTBEAT, order=heartbeats.c.machine)}

    def of_machine(self, machine: str) -> HeartbeatRecord | None:
        """The latest state of a machine's service; None if it never ran."""
        return self._first(HEARTBEAT, heartbeats.c.machine == machine)


REPLY_KEPT = timedelta(days=7)
"""How long an answer is stored."""
REPLY_ABANDONED = timedelta(minutes=1)
"""A request without an answer for this long has died with its process; its key is free again."""


class Replies(Repository):
    """Answers by idempotency key. A key belongs to its sender (``who``): two people may use the same text."""

    def claim(self, who: str, key: str, digest: str) -> ReplyRecord | None:
        """Claim a key for the request with this digest. If the key is used, return its stored reply; None: now `keep` or `drop` the key."""

        def work(connection: Connection) -> ReplyRecord | None:
            now = self._db.utcnow()
            old = replies.c.created_utc < utc_text(now - REPLY_KEPT)
            dead = replies.c.status.is_(None) & (replies.c.created_utc < utc_text(now - REPLY_ABANDONED))
            connection.execute(delete(replies).where(old | dead))
            row = connection.execute(REPLY.select().where(replies.c.who == who, replies.c.key == key)).first()
            if row is not None:
                return REPLY.read(row)
            try:
                with connection.begin_nested():
                    insert_row(connection, replies, who=who, key=key, digest=digest, created_utc=utc_text(now))
            except IntegrityError:  # another process was first (PostgreSQL) and is working on the request
                return ReplyRecord(digest, None, None)
            return None

        return self._db.commit(work)

    def keep(self, who: str, key: str, status: int, body: str) -> None:
        """Store the answer to the request of a claimed key."""
        statement = update(replies).where(replies.c.who == who, replies.c.key == key).values(status=status, body=body)
        self._db.commit(lambda connection: connection.execute(statement))

    def drop(self, who: str, key: str) -> None:
        """Release a key whose request was not completed."""
        statement = delete(replies).where(replies.c.who == who, replies.c.key == key, replies.c.status.is_(None))
        self._db.commit(lambda connection: connection.execute(statement))


CLAIMED = "claimed"
RUNNING = "running"
RELEASED = "released"
"""State of a slot whose service ended after claiming and before starting it: the next service takes it."""
NOT_RUN = ("missed", "skipped", "interrupted")
_OWNER = owner_of(slots)
_NO_OWNER: dict[str, object] = {"owner_host": None, "owner_pid": None, "owner_start": None}


class Slots(Repository):
    """Slots of schedules, one row for each schedule and due time.

    Argument ``slot_utc``: when a slot is due; text is ISO 8601 with time zone.
    """

    def claim(self, schedule: str, slot_utc: datetime | str) -> bool:
        """Claim a slot of a schedule; False if it is taken."""
        values = {"schedule": schedule, "slot_utc": _slot(slot_utc), "state": CLAIMED, "claimed_utc": self._db.now()}

        def work(connection: Connection) -> bool:
            fresh = dialect_insert(connection, slots).values(values | _OWNER.values(this_process()))
            return connection.execute(fresh.on_conflict_do_nothing().returning(slots.c.id)).first() is not None

        return self._db.commit(work)

    def begin(self, schedule: str, slot_utc: datetime | str) -> None:
        """Store that a claimed slot starts, so that no other process runs it. Raises StoreError if unclaimed."""
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
    """Condition for the slots of a machine. LIKE is not used, because SQLite would match MILL-7 for mill-7."""
    prefix = f"{machine}/"
    return func.substr(slots.c.schedule, 1, len(prefix)) == prefix


def _slot(due: datetime | str) -> str:
    if isinstance(due, datetime):
        return utc_text(due)
    try:
        return utc_text(datetime.fromisoformat(due))
    except ValueError:
        raise StoreError(f"slot time {due!r} is not ISO 8601", "write e.g. 2026-11-21T03:00:00Z") from None


class Audit(Repository):
    """The audit of this database."""

    def append(self, make: Callable[[AuditEvent | None, str], AuditEvent]) -> AuditEvent:
        """Append the event that ``make(last event, present UTC)`` returns. Other processes wait meanwhile, so the chain never forks."""

        def work(connection: Connection) -> AuditEvent:
            if self._db.is_postgresql:  # on SQLite BEGIN IMMEDIATE has shut out others already
                connection.execute(text("LOCK TABLE audit IN EXCLUSIVE MODE"))
            last = connection.execute(AUDIT.select().order_by(audit.c.id.desc()).limit(1)).first()
            event = make(None if last is None else AUDIT.read(last), self._db.now())
            insert_row(connection, audit, **AUDIT.values(event))
            return event

        return self._db.commit(work)

    def events(self, last: int | None = None) -> list[AuditEvent]:
        """Read the audit, oldest first; only the ``last`` events if given."""
        return self._all(AUDIT, newest=True, limit=last)[::-1]
