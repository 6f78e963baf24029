"""Users and tokens without their secrets, and the audit."""

from __future__ import annotations

from dataclasses import dataclass, fields

from abbe.service.domain.service_records import AuditEvent
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True, kw_only=True)
class UserSummary:
    """A user without secrets."""

    name: str
    role: str
    disabled_utc: str | None
    created_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TokenSummary:
    """A token without its secret. ``user``: its owner; ``prefix``: the beginning of its text."""

    user: str
    token: str
    prefix: str
    scopes: list[str]
    expires_utc: str
    revoked_utc: str | None


def users(store: Store) -> list[UserSummary]:
    """Return all users."""
    return [UserSummary(**{one.name: getattr(user, one.name) for one in fields(UserSummary)}) for user in store.people.all()]


def tokens(store: Store) -> list[TokenSummary]:
    """Return all tokens with their owners."""
    return [
        TokenSummary(
            user=owner.name,
            token=one.name,
            prefix=one.prefix,
            scopes=one.scopes,
            expires_utc=one.expires_utc,
            revoked_utc=one.revoked_utc,
        )
        for one, owner in store.people.tokens()
    ]


def audit(store: Store, limit: int) -> list[AuditEvent]:
    """Return the newest records of the audit, oldest first."""
    return store.audit.events(limit)
