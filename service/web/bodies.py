"""The body of a request: taken whole, and counted as it comes, before anything is done with it. What is too long is never collected."""

from __future__ import annotations

from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import BaseRoute
from starlette.types import Message, Receive, Scope

from abbe.service.web.problems import problem

LONGEST_B = 64 * 1024
"""Of any request that changes something; a route may have a limit of its own (``max_body_size``)."""


MOST_FIELDS = 8


async def form_of(request: Request) -> dict[str, str] | None:
    """Fields of a short form, whose route limits its length; None: too many fields, or the request was broken off."""
    try:
        text = (await request.body()).decode("utf-8", "replace")
        return {key: values[0] for key, values in parse_qs(text, max_num_fields=MOST_FIELDS).items()}
    except (ValueError, ClientDisconnect):
        return None


class Body:
    """A body that waits until somebody asks for it.

    Parameters
    ----------
    scope, receive
        Of the request.
    route : BaseRoute
        What will answer; its own limit counts, if it has one.
    """

    def __init__(self, scope: Scope, receive: Receive, route: BaseRoute) -> None:
        own = getattr(route, "max_body_size", None)
        self._longest_b = LONGEST_B if own is None else int(own)
        self._headers, self._receive = Headers(scope=scope), receive
        self._taken: list[Message] = []

    async def refusal(self) -> Response | None:
        """Take the body; say why it is not taken. One whose Content-Length is too large is refused unread."""
        length = self._headers.get("content-length", "")
        if length.isdigit() and int(length) > self._longest_b:
            return self._too_long()
        if length in {"", "0"} and "transfer-encoding" not in self._headers:
            return None  # there is none
        size_b, parts = 0, list[bytes]()
        while True:
            message = await self._receive()
            if message["type"] != "http.request":  # the client left: the reader of the body sees that
                self._taken = [{"type": "http.request", "body": b"".join(parts), "more_body": True}, message]
                return None
            parts.append(message.get("body", b""))
            size_b += len(parts[-1])
            if size_b > self._longest_b:
                return self._too_long()
            if not message.get("more_body", False):
                self._taken = [{"type": "http.request", "body": b"".join(parts), "more_body": False}]
                return None

    async def receive(self) -> Message:
        """What the application gets: the body that was taken, then whatever comes."""
        return self._taken.pop(0) if self._taken else await self._receive()

    def _too_long(self) -> Response:
        return problem(413, f"the body is longer than the {self._longest_b} bytes that are taken here")
