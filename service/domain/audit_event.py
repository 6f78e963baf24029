"""An audit event: who did what to which target, when, and with what outcome."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc


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
