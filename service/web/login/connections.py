"""HTTP connections with time limits: idle or endless requests are dropped, so that other visitors are served.

uvicorn only ends connections that are idle after an answer, and refuses everybody above a number of connections. Here every request has a
deadline, and above `MOST_CONNECTIONS` the connection that has been silent longest is dropped.
"""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.flow_control import service_unavailable
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS_S = 10.0
"""Longest time, s, from the connection, or from the previous answer, to the end of a request's headers."""
BODY_S = 20.0
"""Longest time, s, from the headers to the end of the body: forms are short."""
LINGER_S = 2.0
"""Time, s, for which the rest of a refused body is read and discarded: a client that is cut off while sending may never read the answer."""
READ_S = 30.0
"""Longest time, s, that an answer may wait after the client stops reading."""
MOST_CONNECTIONS = 200
MOST_BUSY = 100


class TimeLimitedProtocol(H11Protocol):
    """HTTP protocol of one connection, with a time limit for every wait."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._waits_for: Any = None
        self._wait: asyncio.TimerHandle | None = None
        self._reader_wait: asyncio.TimerHandle | None = None
        self._whole_app = self.app
        self._upgraded = False
        self.silent_since_s = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request; above `MOST_CONNECTIONS` drop the connection that has been silent longest."""
        super().connection_made(transport)
        self._watch()
        if len(self.connections) > MOST_CONNECTIONS:
            others = [one for one in self.connections if isinstance(one, TimeLimitedProtocol) and one is not self and not one.is_busy()]
            if others:
                min(others, key=lambda one: one.silent_since_s).drop()
            else:
                self.drop()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel all timers."""
        super().connection_lost(exc)
        self._stop_waiting()
        self._watch_reader(stopped=False)

    def data_received(self, data: bytes) -> None:
        """Receive data; only complete requests count as busy."""
        # The limit counts complete requests, not idle connections or slow senders.
        busy = sum(isinstance(one, TimeLimitedProtocol) and one.is_busy() for one in self.connections)
        self.app = service_unavailable if busy >= MOST_BUSY else self._whole_app
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request. Wait only `LINGER_S` for the rest of a request that was answered early."""
        self.silent_since_s = self.loop.time()
        super().on_response_complete()
        self._watch()
        if self._waits_for is h11.SEND_BODY:
            self._wait_for(h11.SEND_BODY, LINGER_S)

    def pause_writing(self) -> None:
        """Start the time limit for a client that stopped reading."""
        super().pause_writing()
        self._watch_reader(stopped=True)

    def resume_writing(self) -> None:
        """End that time limit: the client reads again."""
        super().resume_writing()
        self._watch_reader(stopped=False)

    def is_busy(self) -> bool:
        """Whether a complete request is being answered."""
        # Before the first request there is no cycle, contrary to uvicorn's types.
        return self._waits_for is None and getattr(self.cycle, "response_complete", True) is False

    def drop(self) -> None:
        """Close at once, without a closing message."""
        self._stop_waiting()
        self._watch_reader(stopped=False)
        self.connections.discard(self)
        self.transport.abort()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over to the WebSocket protocol, which has limits of its own."""
        self._upgraded = True
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def _watch(self) -> None:
        """Start the time limit for the client's next step; partial data does not extend it."""
        if self._upgraded:
            return
        state = self.conn.their_state
        if self.transport.is_closing():
            state = h11.CLOSED
        if state is self._waits_for:
            return
        self._stop_waiting()
        wait_s = {h11.IDLE: HEADERS_S, h11.SEND_BODY: BODY_S}.get(state)
        if wait_s is not None:
            self._wait_for(state, wait_s)

    def _wait_for(self, state: Any, wait_s: float) -> None:
        self._stop_waiting()
        self._waits_for = state
        self._wait = self.loop.call_later(wait_s, self.drop)

    def _stop_waiting(self) -> None:
        self._waits_for = None
        if self._wait is not None:
            self._wait.cancel()
            self._wait = None

    def _watch_reader(self, *, stopped: bool) -> None:
        if self._reader_wait is not None:
            self._reader_wait.cancel()
            self._reader_wait = None
        if stopped:
            self._reader_wait = self.loop.call_later(READ_S, self.drop)
