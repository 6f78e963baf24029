"""The chain of audit records and the proof that it is complete and unchanged. Pure."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence
from dataclasses import dataclass, replace

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.domain.document import GENESIS, canonical


@dataclass(frozen=True, slots=True)
class Anchor:
    """A head of the audit kept outside of the database: id, digest and seal of a record."""

    id: int
    digest: str
    mac: str


def key_name(key: bytes) -> str:
    """Name of a key in a record; it reveals nothing about the key."""
    return hashlib.sha256(b"abbe audit key " + key).hexdigest()[:16]


def mac_of(key: bytes, digest: str) -> str:
    """Seal of a record: without the key a chain cannot be forged."""
    return hmac.new(key, digest.encode(), hashlib.sha256).hexdigest()


def digest_of(event: AuditEvent) -> str:
    """SHA-256 of an event's content and of the digest before it."""
    content = [event.id, event.utc, event.who, event.action, event.target, event.outcome, event.doc, event.prev, event.key]
    return hashlib.sha256(canonical(content)).hexdigest()


def follow(last: AuditEvent | None, utc: str, event: AuditEvent, key: bytes) -> AuditEvent:
    """Turn an event into the record that follows ``last``."""
    number, prev = (1, GENESIS) if last is None else (last.id + 1, last.digest)
    placed = replace(event, id=number, utc=utc, prev=prev, key=key_name(key))
    digest = digest_of(placed)
    return replace(placed, digest=digest, mac=mac_of(key, digest))


def faults(records: Sequence[AuditEvent], anchors: Sequence[Anchor], key: bytes) -> list[str]:
    """All faults of an audit; an empty list: it is complete and unchanged.

    ``records``: all records, in the order of their ids; ``anchors``: the heads kept outside of the database; ``key``: of the seals.
    """
    found, head, own_key = [], GENESIS, key_name(key)
    for number, record in enumerate(records, 1):
        if record.id != number:
            found.append(f"record {number} is missing")
            break
        if record.prev != head:
            found.append(f"record {number} does not follow the one before it")
        if record.digest != _digest_or_none(record):
            found.append(f"record {number} was changed after it was written")
        if record.key != own_key:
            found.append(f"record {number} is sealed with a key that is not here ({record.key})")
        elif not hmac.compare_digest(record.mac, mac_of(key, record.digest)):
            found.append(f"record {number} was not sealed by this service")
        head = record.digest
    return found + _anchor_faults(records, anchors, key)


def _digest_or_none(record: AuditEvent) -> str | None:
    try:
        return digest_of(record)
    except (TypeError, ValueError):  # no longer JSON
        return None


def _anchor_faults(records: Sequence[AuditEvent], anchors: Sequence[Anchor], key: bytes) -> list[str]:
    """Faults found by comparing the records with the heads kept outside of the database."""
    found, stored = [], {record.id: record.digest for record in records}
    for anchor in anchors:
        if not hmac.compare_digest(anchor.mac, mac_of(key, f"{anchor.id} {anchor.digest}")):
            found.append(f"the head kept for record {anchor.id} was not sealed by this service")
        elif anchor.id not in stored:
            found.append(f"the audit ended with record {anchor.id} at least, and holds {len(records)}")
        elif stored[anchor.id] != anchor.digest:
            found.append(f"record {anchor.id} is not the one whose head was kept")
    if records and not anchors:
        found.append("no head was kept outside of the database: the length of the audit is not proved")
    return found


def anchor_of(record: AuditEvent, key: bytes) -> Anchor:
    """The head to keep of a record."""
    return Anchor(record.id, record.digest, mac_of(key, f"{record.id} {record.digest}"))
