"""What the guard of the routes asks: whose secret this is, whether he may try again, and where it is recorded."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import time
from collections.abc import Callable

from service.audit.book import AuditBook
from service.audit.chain import Event
from service.storage.store import Store
from service.users.lockout import Buckets, Lockout
from service.users.people import NOBODY, ONLOOKER, People, Principal

COOKIE, SECURE_COOKIE = "abbe", "__Host-abbe"


class Door:
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
    rate_hz, burst : float
        Requests of one address a second, and at once.
    """

    def __init__(
        self,
        store: Store,
        people: People,
        book: AuditBook,
        *,
        now_s: Callable[[], float] = time.monotonic,
        rate_hz: float = 50.0,
        burst: float = 200.0,
    ) -> None:
        self.store, self.people, self.book = store, people, book
        self.lockout = Lockout(now_s)
        self.requests = Buckets(rate_hz, burst, now_s)
        self.noise = Buckets(1 / 6, 20.0, now_s)
        """Refusals of one address that are recorded: who hammers at the door may not fill the audit."""

    async def who(self, bearer: str | None, secret: str | None) -> Principal:
        """Who asks: by token if one is given, else by cookie; an onlooker while there are no users at all."""
        return await asyncio.to_thread(self._who, bearer, secret)

    def _who(self, bearer: str | None, secret: str | None) -> Principal:
        if bearer is not None:
            return self.people.by_token(bearer)
        if secret:
            found = self.people.by_session(secret)
            if found is not NOBODY:
                return found
        return NOBODY if self.people.anybody() else ONLOOKER

    async def record(self, event: Event) -> None:
        """Write a record; on return it is on disk."""
        await asyncio.to_thread(self.book.write, event)


def csrf_token(secret: str) -> str:
    """What a page of ours sends back with everything that changes something; a foreign page cannot read it."""
    return hmac.new(secret.encode(), b"csrf", hashlib.sha256).hexdigest()
