"""The measurement that supports the table in force: a check, the push that wrote the table, or none since the table changed.

A verdict belongs to the table that was in force during its runs. It lapses as soon as another table comes into force: by a push, a
rollback, an acceptance or an unknown writer. Home page, fleet, trends, reports, MQTT, OPC UA and MTConnect all use this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, computed_field

from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushEntry, PushState
from abbe.service.domain.results import VerificationRecord
from abbe.service.errors import StoreError
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import KIND, JournalView

LATEST_CHECKS = 20
"""Number of latest checks among which the last completed measurement is searched."""
STRANGE_TABLE = "CMP-010"
"""Code of the alarm for a table in force that the journal does not expect."""

VerifiedState = Literal["verified", "unverified", "unknown"]
VerifiedReason = Literal["check", "push", "rollback", "accepted", "changed", "other", "open", "never", "journal"]

_TEXTS: dict[str, str] = {
    "check": "checked with the table in force: check {number} of {when}",
    "push": "verified by push {number} of {when}, which measured before and after; not checked since",
    "rollback": "unverified since the rollback of {when} (push {number})",
    "accepted": "unverified since a person accepted the table at {when}",
    "changed": "unverified since the table in force was changed from outside",
    "other": "unverified: check {number} of {when} was measured with another table than the one in force",
    "open": "unverified: push {number} of {when} is not finished",
    "never": "not checked yet",
    "journal": "unknown: the push journal was changed after it was written",
}


@dataclass(frozen=True, slots=True)
class VerifiedBy:
    """The measurement that supports the table in force. Every display shows this record.

    Parameters
    ----------
    state : "verified", "unverified" or "unknown"
        Whether a measurement supports the table in force. Verified by a check means measured, not passed.
    why : str
        ``check``, ``push``: what measured it. ``rollback``, ``accepted``, ``changed``, ``other``, ``open``: the event that made it
        unverified. ``never``, ``journal``: why the state is unknown.
    number : int
        Number of the check or push; 0 for none.
    utc : datetime or None
        Time of that check or event; None for never.
    crc : int or None
        CRC-32 of the table in force by the push journal; None without a push, or if unknown.
    since : datetime or None
        When that table came into force by the journal; None without a push. Earlier checks are of another table.
    changes : tuple of datetime
        All times at which a table came into force.
    """

    state: VerifiedState
    why: VerifiedReason
    number: int = 0
    utc: datetime | None = None
    crc: Annotated[int | None, Field(exclude=True)] = None
    since: datetime | None = None
    changes: tuple[datetime, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the verdict of a check may be shown as the verdict of the machine."""
        return self.why in ("check", "never")

    @computed_field  # type: ignore[prop-decorator]
    @property
    def text(self) -> str:
        """One line for people: ``unverified since the rollback of 2026-11-23 02:10 UTC (push 3)``."""
        return _TEXTS[self.why].format(number=self.number, when=minute(self.utc))

    @computed_field  # type: ignore[prop-decorator]
    @property
    def table_crc(self) -> str | None:
        """CRC-32 of the table in force, hexadecimal; None if unknown."""
        return None if self.crc is None else f"{self.crc:08X}"

    def as_doc(self) -> Doc:
        """JSON value for messages, without the times of all changes."""
        utc = None if self.utc is None else self.utc.isoformat()
        return {"state": self.state, "why": self.why, "number": self.number, "utc": utc, "table_crc": self.table_crc, "text": self.text}

    def verdict(self, verdict: str) -> str:
        """Return the verdict of the last check if it holds; otherwise the verification state (`state`)."""
        return verdict if self.holds else self.state


def measure_now(machine_file: Path) -> str:
    """Return the command that verifies the machine of a machine file."""
    return f"abbe measure -m {machine_file} --recipe quick-check"


def minute(utc: datetime | None) -> str:
    """Time to the minute for messages; empty for None."""
    return "" if utc is None else f"{utc:%Y-%m-%d %H:%M} UTC"


def strange_table(attention: Sequence[str]) -> bool:
    """Whether the attention texts contain the alarm of an unexpected table in force."""
    return any(text.startswith(f"{STRANGE_TABLE}:") for text in attention)


def verified_by(store: Store, machine: str, *, control: str = "", strange: bool = False) -> VerifiedBy:
    """Verification state of a machine from its push journal and its last checks.

    Parameters
    ----------
    machine : str
        Name of the machine.
    control : str
        Identity of its control; empty: unknown, use the journal last used under this name.
    strange : bool
        The controller holds a table that the journal does not expect (`strange_table`). The last heartbeat of the machine's service is
        used as well.

    Raises
    ------
    StoreError
        The database does not answer. A changed journal is a state ("unknown"), not an error.
    """
    journal = JournalView.read(store, machine, control, origins=False)
    if not journal.sound:
        return VerifiedBy("unknown", "journal")
    checks = store.verifications.of_machine(machine, LATEST_CHECKS)
    return _of_journal(store, journal, checks, strange=strange or _reported_strange(store, machine, journal, checks))


def _reported_strange(store: Store, machine: str, journal: JournalView, checks: Sequence[VerificationRecord]) -> bool:
    """Whether the last heartbeat of the machine's service reports a strange table, and since then neither the table changed nor a check
    found the expected table.
    """
    heartbeat = store.heartbeats.of_machine(machine)
    if heartbeat is None or not strange_table(heartbeat.doc.get("attention") or []):
        return False
    heartbeat_utc = datetime.fromisoformat(heartbeat.seen_utc)
    last = _last_measured(checks)
    if last is not None and _measured_with(store, last, journal.wanted[0], heartbeat_utc):
        return False
    return all(datetime.fromisoformat(e.utc) <= heartbeat_utc for e in journal.changes)


def _of_journal(store: Store, journal: JournalView, checks: Sequence[VerificationRecord], *, strange: bool) -> VerifiedBy:
    """Verification state from a journal and checks (newest first)."""
    crc, settled = journal.wanted
    changed = journal.changes
    changes = tuple(datetime.fromisoformat(e.utc) for e in changed)
    known: dict[str, Any] = {"crc": crc, "since": changes[-1] if changes else None, "changes": changes}
    if not settled:
        return VerifiedBy("unverified", "open", journal.entries[-1].push, datetime.fromisoformat(journal.entries[-1].utc), **known)
    last = _last_measured(checks)
    if strange:
        return VerifiedBy("unverified", "changed", **known)
    if last is not None and (not changes or started(last) > changes[-1] or _measured_with(store, last, crc, changes[-1])):
        table = table_of(store, last)
        other = crc is not None and table is not None and table != crc
        return VerifiedBy("unverified" if other else "verified", "other" if other else "check", last.id, started(last), **known)
    if changed:
        return _since(store, journal, changed[-1], known)
    return VerifiedBy("unknown", "never", **known)


def _since(store: Store, journal: JournalView, change: PushEntry, known: dict[str, Any]) -> VerifiedBy:
    """State after a change of table without a later check: decided by the kind of change."""
    if change.state is PushState.ACCEPTED:
        return VerifiedBy("unverified", "accepted", change.push, datetime.fromisoformat(change.utc), **known)
    number = journal.facts(change.push).table
    if number and _kind(store, number) == KIND:
        return VerifiedBy("unverified", "rollback", change.push, datetime.fromisoformat(change.utc), **known)
    return VerifiedBy("verified", "push", change.push, datetime.fromisoformat(change.utc), **known)


def _kind(store: Store, table: int) -> str:
    try:
        return str(store.tables.get(table).doc.get("kind", "push"))
    except StoreError:  # a table without a document counts as unmeasured
        return KIND


def measured(record: VerificationRecord) -> bool:
    """Whether a stored verification is a completed check of the machine (not one of a push)."""
    return not record.doc.get("push") and bool(record.doc.get("values"))


def of_push_taken_back(record: VerificationRecord) -> bool:
    """Whether a verification belongs to a push that was not kept: the verified table is then not in force."""
    return bool(record.doc.get("push")) and record.verdict != "pass"


def _last_measured(checks: Sequence[VerificationRecord]) -> VerificationRecord | None:
    return next((one for one in checks if measured(one)), None)


def _measured_with(store: Store, record: VerificationRecord, crc: int | None, since: datetime) -> bool:
    """Whether a check began after ``since`` with the table ``crc`` in force."""
    return crc is not None and began(store, record) > since and table_of(store, record) == crc


def began(store: Store, record: VerificationRecord) -> datetime:
    """Return when a check's campaign began, after any acceptance by `--accept-table`; without a campaign, when the check began."""
    if record.campaign_id is None:
        return started(record)
    return datetime.fromisoformat(store.campaigns.find(record.campaign_id).created_utc)


def started(record: VerificationRecord) -> datetime:
    """Return when a check started, which is when it read the table in force; if that was not recorded, the time of its record."""
    return datetime.fromisoformat(record.doc.get("started_utc") or record.utc)


def table_of(store: Store, record: VerificationRecord) -> int | None:
    """CRC-32 of the table in force during a check; None if not recorded."""
    crc = record.doc.get("table_crc")
    if crc is None and record.campaign_id is not None:
        crc = store.campaigns.find(record.campaign_id).doc.get("table_crc")
    return None if crc is None else int(crc)
