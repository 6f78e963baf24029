"""Stored state of an unattended service: alarms, slots, heartbeats, messages, replies, audit. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum

from abbe.service.domain.document import Doc, HistoryLine, Row
from abbe.service.domain.measured import Owner
from abbe.service.domain.verification import CheckFailure

BEAT_S = 60.0
"""Time between two heartbeats of a service, s."""
SILENT_AFTER = timedelta(seconds=3 * BEAT_S)
"""A service on another computer counts as not running after this silence."""


class AlarmKind(StrEnum):
    """Kind of an entry. The first five change the alarm itself; the others record the work on it, some of which a person ``ordered``."""

    RAISED = "raised"
    CONTINUED = "held"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    SHELVED = "shelved"
    ORDERED = "ordered"
    BEGUN = "begun"
    MEASURED = "measured"
    DISCOVERED = "discovered"
    PROPOSED = "proposed"
    FAILED = "failed"
    ENDED = "ended"
    PUSHING = "pushing"
    PUSHED = "pushed"


@dataclass(frozen=True, slots=True)
class Signal:
    """One reason why a check raises an alarm: the judged figure with its numbers.

    ``kind``: ``limit`` (above its limit by more than U), ``jump``, ``drift``, ``days`` (few days until the limit). ``baseline``,
    ``baseline_u``: reference value of ``jump`` and its standard uncertainty.
    """

    figure: str
    kind: str
    value: float
    expanded: float
    limit: float
    text: str
    baseline: float | None = None
    baseline_u: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmFacts:
    """Facts of an entry of an alarm. Facts that its kind lacks keep their defaults; ``text``: a sentence for people.

    Of a check: ``recipe``, ``schedule``, its number ``verification``, and its ``signals``. Of a person: ``name``, ``comment`` or
    ``reason``, and the end of a shelving, ``until_utc``. Of an investigation: its ``campaign``, its ``discovery``, the reasons ``against``
    tables (empty: none), ``rms_um`` (rms of what the model leaves beyond noise), ``unnamed`` (something is missing, and no effect was found
    for it), its ``proposal``, the ``code`` of a refusal, the ``cause`` of a failure. Of a push: ``proposal``, ``approval``, the number of
    the push before it, ``after``, and its outcome ``word`` as in `JobOutcome`.
    """

    text: str = ""
    recipe: str = ""
    schedule: str = ""
    verification: int | None = None
    signals: tuple[Signal, ...] = ()
    name: str = ""
    comment: str = ""
    reason: str = ""
    until_utc: datetime | None = None
    campaign: str = ""
    discovery: int | None = None
    against: str = ""
    rms_um: float = 0.0
    unnamed: bool = False
    proposal: int | None = None
    code: str = ""
    cause: CheckFailure | None = None
    approval: int | None = None
    after: int = 0
    word: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmEntryRecord(HistoryLine):
    """One event of a machine's alarm. ``alarm`` counts from 1 for each machine."""

    machine: str
    alarm: int
    kind: AlarmKind
    facts: AlarmFacts


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


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditEntry:
    """The part of an event that people with the permission to read the audit see.

    Parameters
    ----------
    who : str
        ``os:NAME@HOST`` at the command line, ``user:NAME``, ``token:NAME/TOKEN`` or ``anonymous`` on the network.
    action : str
        Command or request, e.g. ``abbe measure``, ``POST /login``.
    target : str
        What it acted on: machine file, user, file, address.
    outcome : str
        ``done``, ``no``, ``refused 403``, or an error code.
    id, utc, digest
        Number, from 1 without a gap; time; SHA-256 of the content and of the previous event's digest. Set when the event is written.
    """

    id: int = 0
    utc: str = ""
    who: str
    action: str
    target: str
    outcome: str
    digest: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditEvent(AuditEntry):
    """A complete event as it is stored.

    ``doc``: options and reasons, no secrets; ``prev``: digest of the previous event; ``key``, ``mac``: name of the secret key, and the
    message authentication code of the digest with this key.
    """

    doc: Doc = field(default_factory=dict)
    prev: str = ""
    key: str = ""
    mac: str = ""
