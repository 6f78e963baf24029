"""Roles and their permissions. A role may do only what this table lists."""

from __future__ import annotations

from enum import StrEnum


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
