"""Bodies of requests: read completely before any work, and refused as soon as they are too long."""

from __future__ import annotations

from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import BaseRoute
from starlette.types import Message, Receive, Scope

from abbe.service.web.problems import problem

LONGEST_B = 64 * 1024
"""Default size limit, bytes, of the body of a changing request; a route may have its own (``max_body_size``)."""

MOST_FIELDS = 8


async def form_of(request: Request, most: int = MOST_FIELDS, *, blank: bool = False) -> dict[str, str] | None:
    """Fields of a form; with ``blank`` also the empty ones. None: more than ``most`` fields, or the client disconnected."""
    try:
        text = (await request.body()).decode("utf-8", "replace")
        return {key: values[0] for key, values in parse_qs(text, blank, max_num_fields=most).items()}
    except (ValueError, ClientDisconnect):
        return None


class Body:
    """The body of a request, read on demand, limited by ``max_body_size`` of the route or by `LONGEST_B`."""

    def __init__(self, scope: Scope, receive: Receive, route: BaseRoute) -> None:
        own = getattr(route, "max_body_size", None)
        self._longest_b = LONGEST_B if own is None else int(own)
        self._headers, self._receive = Headers(scope=scope), receive
        self._messages: list[Message] = []

    async def refusal(self) -> Response | None:
        """Read the body; return a refusal if it is too long. A too large Content-Length is refused unread."""
        length = self._headers.get("content-length", "")
        if length.isdigit() and int(length) > self._longest_b:
            return self._too_long()
        if length in {"", "0"} and "transfer-encoding" not in self._headers:
            return None  # no body
        size_b, parts = 0, list[bytes]()
        while True:
            message = await self._receive()
            if message["type"] != "http.request":  # the client disconnected: the reader of the body notices
                self._messages = [{"type": "http.request", "body": b"".join(parts), "more_body": True}, message]
                return None
            parts.append(message.get("body", b""))
            size_b += len(parts[-1])
            if size_b > self._longest_b:
                return self._too_long()
            if not message.get("more_body", False):
                self._messages = [{"type": "http.request", "body": b"".join(parts), "more_body": False}]
                return None

    async def receive(self) -> Message:
        """ASGI messages for the application: first the body, then later messages."""
        return self._messages.pop(0) if self._messages else await self._receive()

    def _too_long(self) -> Response:
        return problem(413, f"the body is longer than the {self._longest_b} bytes that this path accepts")
