"""An event of the audit: who did what, when, on what, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.service.domain.document import Doc


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditEntry:
    """What people with the right to read the audit see of an event.

    Parameters
    ----------
    who : str
        ``os:NAME@HOST`` at the command line, ``user:NAME``, ``token:NAME/TOKEN`` or ``anonymous`` on the network.
    action : str
        ``abbe measure``, ``POST /login``.
    target : str
        Machine file, user, file, address.
    outcome : str
        ``done``, ``no``, ``refused 403``, a code of an error.
    id, utc, digest
        Its number, from 1 without a gap, its time, and the SHA-256 of its content and of the digest before it. Given when it is written.
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
    """An event with everything that is stored of it.

    Parameters
    ----------
    doc : dict
        More of it: options, reasons. No secrets.
    prev : str
        Digest of the event before it.
    key, mac : str
        Name of the key, and the seal over the digest that it makes.
    """

    doc: Doc = field(default_factory=dict)
    prev: str = ""
    key: str = ""
    mac: str = ""
