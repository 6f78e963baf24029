"""Users without their secrets, and the audit."""

from __future__ import annotations

from dataclasses import dataclass, fields

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True, kw_only=True)
class UserSummary:
    """A user without secrets."""

    name: str
    role: str
    disabled_utc: str | None
    created_utc: str


def users(store: Store) -> list[UserSummary]:
    """All users."""
    return [UserSummary(**{one.name: getattr(user, one.name) for one in fields(UserSummary)}) for user in store.people.all()]


def audit(store: Store, limit: int) -> list[AuditEvent]:
    """The newest records of the audit, oldest first."""
    return store.audit.events(limit)
