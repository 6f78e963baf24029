"""What the middleware asks: whose secret this is, whether another try is allowed, and where it is recorded."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import time
from collections.abc import Callable
from dataclasses import dataclass

from abbe.service.audit.book import AuditBook
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.storage.store import Store
from abbe.service.users.lockout import Buckets, Lockout
from abbe.service.users.people import NOBODY, ONLOOKER, People, Principal

COOKIE = "abbe"


@dataclass(frozen=True, slots=True)
class Front:
    """How visitors get to the page.

    Parameters
    ----------
    port : int
        Where the service listens; in the name of its cookies, since browsers send cookies to every port of a host. 0: not in it.
    behind_tls : bool
        A reverse proxy on this computer takes the TLS off: every request counts as one over TLS, and the last address in its
        ``X-Forwarded-For`` is the visitor's.
    """

    port: int = 0
    behind_tls: bool = False


ALONE = Front()


class Authenticator:
    """Users, lockout, rate limits and audit of one service.

    Parameters
    ----------
    store : Store
        Users and audit are read from and written to it.
    people : People
        The users.
    book : AuditBook
        The audit.
    now_s : callable
        Monotonic seconds.
    front : Front
        How visitors get here.
    rate_hz, burst : float
        Requests of one address a second, and at once.
    """

    def __init__(
        self,
        store: Store,
        people: People,
        book: AuditBook,
        front: Front = ALONE,
        *,
        now_s: Callable[[], float] = time.monotonic,
        rate_hz: float = 50.0,
        burst: float = 200.0,
    ) -> None:
        self.store, self.people, self.book = store, people, book
        self._cookie, self.behind_tls = f"{COOKIE}-{front.port}" if front.port else COOKIE, front.behind_tls
        self.lockout = Lockout(now_s)
        self.requests = Buckets(rate_hz, burst, now_s)
        self.noise = Buckets(1 / 6, 20.0, now_s)
        """Refusals of one address that are recorded: who floods the login must not fill the audit."""

    def cookie(self, *, tls: bool) -> str:
        """Name of the cookie of a session. With TLS only this host can set it."""
        return f"__Host-{self._cookie}" if tls else self._cookie

    def device_cookie(self) -> str:
        """Name of the cookie of a browser in which somebody has logged in."""
        return f"{self._cookie}-device"

    async def who(self, bearer: str | None, secret: str | None, *, in_use: bool = True) -> Principal:
        """Who asks: by token if one is given, else by cookie; an onlooker while there are no users at all.

        ``in_use`` False: a page that refreshes itself asks, which does not keep its session alive.
        """
        return await asyncio.to_thread(self._who, bearer, secret, in_use)

    def _who(self, bearer: str | None, secret: str | None, in_use: bool) -> Principal:
        if bearer is not None:
            return self.people.by_token(bearer)
        if secret:
            found = self.people.by_session(secret, in_use=in_use)
            if found is not NOBODY:
                return found
        return NOBODY if self.people.anybody() else ONLOOKER

    async def ready(self) -> None:
        """Make sure that a record can be written, before something is done.

        Raises
        ------
        AbbeError
            It cannot.
        """
        await asyncio.to_thread(self.book.ready)

    async def record(self, event: AuditEvent) -> None:
        """Write a record; on return it is on disk."""
        await asyncio.to_thread(self.book.write, event)


def csrf_token(secret: str) -> str:
    """What a page of ours sends back with everything that changes something; a foreign page cannot read it."""
    return hmac.new(secret.encode(), b"csrf", hashlib.sha256).hexdigest()
