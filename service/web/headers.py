"""Security headers on every response, errors included. Pure ASGI: a middleware that wraps requests in tasks breaks cancellation."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    # Not "no-referrer": with it browsers send "Origin: null" along with our own login form, and nobody can log in.
    "Referrer-Policy": "same-origin",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
KEPT = ("/static/", "/icon.svg")
"""What is the same for everybody: browsers may keep it, and ask whether it is still the same. Nothing else is kept anywhere."""
HSTS = "max-age=31536000"
"""A year; only ever sent over TLS, and of no effect for a page that is asked for by address instead of by name."""


class SecurityHeaders:
    """Adds `HEADERS` to whatever the application answers, how long it may be kept, and that TLS is here to stay.

    Parameters
    ----------
    app : ASGI application
        What answers.
    behind_tls : bool
        A reverse proxy takes the TLS off.
    """

    def __init__(self, app: ASGIApp, *, behind_tls: bool = False) -> None:
        self._app, self._behind_tls = app, behind_tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and put the headers on the answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers["Cache-Control"] = "no-cache" if scope["path"].startswith(KEPT) else "no-store"
                if self._behind_tls or scope.get("scheme") == "https":
                    headers["Strict-Transport-Security"] = HSTS
            await send(message)

        await self._app(scope, receive, with_headers)
