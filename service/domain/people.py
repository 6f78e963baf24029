"""Stored users, sessions and tokens: secrets as digests or hashes only. One record is one row."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class UserRecord:
    """A user. ``disabled_utc``: no login since then. Users are never deleted: the audit names them."""

    id: int
    name: str
    role: str
    password: str = field(repr=False)
    disabled_utc: str | None
    created_utc: str


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """A login of a user. ``digest``: SHA-256 of the secret in the cookie."""

    id: int
    user_id: int
    digest: str = field(repr=False)
    created_utc: str
    seen_utc: str
    ended_utc: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TokenRecord:
    """A token of a program, with those rights of its user that its scopes name. The database gives ``id`` and ``created_utc``."""

    id: int = 0
    user_id: int
    name: str
    prefix: str
    digest: str = field(repr=False)
    scopes: list[str]
    created_utc: str = ""
    expires_utc: str
    revoked_utc: str | None = None
