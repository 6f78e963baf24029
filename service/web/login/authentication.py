"""Identity of a request, rate limits and audit, as the middleware uses them."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import time
from collections.abc import Callable
from dataclasses import dataclass

from abbe.service.audit.book import AuditBook
from abbe.service.domain.service_records import AuditEvent
from abbe.service.storage.store import Store
from abbe.service.users.lockout import Buckets, Lockout
from abbe.service.users.people import ANONYMOUS, LOCAL_VIEWER, Principal, UserAccounts

COOKIE = "abbe"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address by which visitors reach the service.

    Parameters
    ----------
    port : int
        Port of the service, part of the names of its cookies, since browsers send cookies to every port of a host; 0: not part of them.
    behind_tls : bool
        A reverse proxy on this computer terminates TLS: every request counts as one over TLS, and the last address in its
        ``X-Forwarded-For`` is the visitor's.
    """

    port: int = 0
    behind_tls: bool = False


DEFAULT_ENDPOINT = Endpoint()


class Authenticator:
    """Users, lockout, rate limits and audit of one service.

    ``now_s``: monotonic seconds; ``rate_hz``, ``burst``: allowed requests of one address, per second and at once.
    """

    def __init__(
        self,
        store: Store,
        people: UserAccounts,
        book: AuditBook,
        endpoint: Endpoint = DEFAULT_ENDPOINT,
        *,
        now_s: Callable[[], float] = time.monotonic,
        rate_hz: float = 50.0,
        burst: float = 200.0,
    ) -> None:
        self.store, self.people, self.book = store, people, book
        self._cookie, self.behind_tls = f"{COOKIE}-{endpoint.port}" if endpoint.port else COOKIE, endpoint.behind_tls
        self.lockout = Lockout(now_s)
        self.requests = Buckets(rate_hz, burst, now_s)
        self.recorded_refusals = Buckets(1 / 6, 20.0, now_s)
        """Limits recorded refusals per address: a flood of logins must not fill the audit."""

    def cookie(self, *, tls: bool) -> str:
        """Name of the session cookie. With TLS only this host can set it."""
        return f"__Host-{self._cookie}" if tls else self._cookie

    def device_cookie(self, name: str) -> str:
        """Name of the cookie that marks a browser with an earlier login of this user; several people may share a browser."""
        return f"{self._cookie}-device-{hashlib.sha256(name.encode()).hexdigest()[:8]}"

    async def who(self, bearer: str | None, secret: str | None, *, in_use: bool = True, to_stop: bool = False) -> Principal:
        """Identify the visitor by token, else by cookie; an onlooker while there are no users.

        ``in_use`` False: an automatic refresh, which does not extend the session; ``to_stop``: see `UserAccounts.by_session`.
        """
        return await asyncio.to_thread(self._who, bearer, secret, in_use, to_stop)

    def _who(self, bearer: str | None, secret: str | None, in_use: bool, to_stop: bool) -> Principal:
        if bearer is not None:
            return self.people.by_token(bearer)
        if secret:
            found = self.people.by_session(secret, in_use=in_use, to_stop=to_stop)
            if found is not ANONYMOUS:
                return found
        return ANONYMOUS if self.people.has_users() else LOCAL_VIEWER

    async def ready(self) -> None:
        """Check before a change that the audit is writable. Raises AbbeError if not."""
        await asyncio.to_thread(self.book.ready)

    async def record(self, event: AuditEvent) -> None:
        """Write a record to disk."""
        await asyncio.to_thread(self.book.write, event)


def csrf_token(secret: str) -> str:
    """Token that our pages send with every change; a foreign page cannot read it."""
    return hmac.new(secret.encode(), b"csrf", hashlib.sha256).hexdigest()
