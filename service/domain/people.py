"""Stored users, sessions and tokens: secrets as digests or hashes only. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Row


@dataclass(frozen=True, slots=True, kw_only=True)
class UserRecord(Row):
    """A user. ``pin``: hash; None: no PIN. ``disabled_utc``: no login since then. Users are never deleted: the audit names them."""

    name: str
    role: str
    password: str = field(repr=False)
    pin: str | None = field(default=None, repr=False)
    disabled_utc: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionRecord(Row):
    """A login of a user. ``digest``: SHA-256 of the secret in the cookie."""

    user_id: int
    digest: str = field(repr=False)
    seen_utc: str
    ended_utc: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TokenRecord(Row):
    """A token of a program. Its scopes limit it to some rights of its user."""

    user_id: int
    name: str
    prefix: str
    digest: str = field(repr=False)
    scopes: list[str]
    expires_utc: str
    revoked_utc: str | None = None
