"""People: roles with their permissions, and the stored users, sessions and tokens: secrets as digests or hashes only.

A role may do only what `ALLOWED` lists. One record is one row.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from abbe.service.domain.document import Row


class Role(StrEnum):
    """The role of a person; each person has one."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    METROLOGIST = "metrologist"
    APPROVER = "approver"
    ADMIN = "admin"


class Permission(StrEnum):
    """A permission; also a scope of tokens."""

    READ = "read"
    MEASURE = "measure"
    STOP = "stop"
    ACKNOWLEDGE = "acknowledge"
    SOLVE = "solve"
    PROPOSE = "propose"
    APPROVE = "approve"
    CONFIGURE = "configure"
    AUDIT = "audit"
    USERS = "users"


_OPERATOR = frozenset({Permission.READ, Permission.MEASURE, Permission.STOP, Permission.ACKNOWLEDGE})
ALLOWED: dict[Role, frozenset[Permission]] = {
    Role.VIEWER: frozenset({Permission.READ}),
    Role.OPERATOR: _OPERATOR,
    Role.METROLOGIST: _OPERATOR | {Permission.SOLVE, Permission.PROPOSE},
    # Approvers judge what others propose: one who also measures and proposes would judge their own work. They stop the pushes they order.
    Role.APPROVER: frozenset({Permission.READ, Permission.STOP, Permission.ACKNOWLEDGE, Permission.APPROVE, Permission.AUDIT}),
    # Manages users and settings. Neither proposes nor approves a table.
    Role.ADMIN: frozenset({Permission.READ, Permission.CONFIGURE, Permission.AUDIT, Permission.USERS}),
}


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
