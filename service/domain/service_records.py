"""Stored state of an unattended service: alarms, slots, heartbeats, messages, replies. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from abbe.service.domain.document import Doc, HistoryRow, Row
from abbe.service.domain.measured import Owner


class AlarmKind(StrEnum):
    """Kind of an entry. The first five change the alarm itself, the others record the service's work on it."""

    RAISED = "raised"
    CONTINUED = "held"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    SHELVED = "shelved"
    BEGUN = "begun"
    MEASURED = "measured"
    DISCOVERED = "discovered"
    PROPOSED = "proposed"
    FAILED = "failed"
    ENDED = "ended"
    PUSHING = "pushing"
    PUSHED = "pushed"


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmEntryRecord(HistoryRow):
    """One event of a machine's alarm. ``alarm`` counts from 1 for each machine."""

    machine: str
    alarm: int
    kind: AlarmKind


@dataclass(frozen=True, slots=True)
class SlotRecord:
    """One slot of a schedule and its outcome. ``reason``: a sentence about ``state``; ``finished_utc``: None while the slot is open."""

    id: int
    schedule: str
    slot_utc: str
    state: str
    reason: str
    claimed_utc: str
    finished_utc: str | None


@dataclass(frozen=True, slots=True)
class HeartbeatRecord:
    """The latest heartbeat of a machine's service."""

    machine: str
    doc: Doc
    seen_utc: str
    owner: Owner


@dataclass(frozen=True, slots=True, kw_only=True)
class OutboxRecord(Row):
    """A message that waits for the broker."""

    topic: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class ReplyRecord:
    """The answer to the request that came with an idempotency key; ``status`` None: the request is still in progress."""

    digest: str
    status: int | None
    body: str | None


@dataclass(frozen=True, slots=True)
class StoreHealth:
    """State of a database.

    ``file``: SQLite file, else empty; ``size_b``: bytes with the write-ahead log; ``since_utc``: when the first machine was stored.
    """

    revision: str
    wanted_revision: str
    file: str
    size_b: int
    since_utc: str | None
    outbox: int
    outbox_oldest_utc: str | None
