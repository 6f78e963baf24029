"""What the JSON interface says of users and of the audit."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from abbe.service.domain.audit_event import AuditEntry


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class Me(_Answer):
    """Who asks. ``csrf_token`` is empty for tokens and onlookers."""

    name: str
    role: str
    permissions: list[str]
    csrf_token: str


class User(_Answer):
    """A user, without anything secret."""

    name: str
    role: str
    created_utc: str
    disabled_utc: str | None


class Users(_Answer):
    """All users."""

    users: list[User]


class AuditList(_Answer):
    """Records, oldest first."""

    records: list[AuditEntry]
