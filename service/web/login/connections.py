"""Connections that say nothing, or say it for ever, are let go; a visitor who asks is served while they come.

uvicorn ends a connection that is idle after an answer, and refuses everybody once so many are connected. Here a request has to come to its
end in time, and when there are too many connections the one that has been silent longest makes room.
"""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.flow_control import service_unavailable
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS_S = 10.0
"""From the connection, or from the answer before it, to the end of a request's headers."""
BODY_S = 20.0
"""To the end of its body: forms are short."""
LINGER_S = 2.0
"""So long the rest of a body that was refused is thrown away as it comes: who is cut off while he sends may never read the answer."""
READ_S = 30.0
"""So long an answer may wait for its reader, from when he stops reading."""
MOST_CONNECTIONS = 200
MOST_AT_WORK = 100


class PatientProtocol(H11Protocol):
    """HTTP of one connection, with an end to each wait."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._waits_for: Any = None
        self._wait: asyncio.TimerHandle | None = None
        self._reader_wait: asyncio.TimerHandle | None = None
        self._whole_app = self.app
        self._upgraded = False
        self.silent_since_s = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Make room, and wait for a request."""
        super().connection_made(transport)
        self._watch()
        if len(self.connections) > MOST_CONNECTIONS:
            others = [one for one in self.connections if isinstance(one, PatientProtocol) and one is not self and not one.at_work()]
            if others:
                min(others, key=lambda one: one.silent_since_s).let_go()
            else:
                self.let_go()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        super().connection_lost(exc)
        self._stop_waiting()
        self._watch_reader(stopped=False)

    def data_received(self, data: bytes) -> None:
        """Take what came; a piece of a request is no request."""
        # Refused by number are those who have asked, not those who are there, or are asking slowly.
        busy = sum(isinstance(one, PatientProtocol) and one.at_work() for one in self.connections)
        self.app = service_unavailable if busy >= MOST_AT_WORK else self._whole_app
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request; for the rest of one that was answered before it ended, not long."""
        self.silent_since_s = self.loop.time()
        super().on_response_complete()
        self._watch()
        if self._waits_for is h11.SEND_BODY:
            self._wait_for(h11.SEND_BODY, LINGER_S)

    def pause_writing(self) -> None:
        """The reader does not read."""
        super().pause_writing()
        self._watch_reader(stopped=True)

    def resume_writing(self) -> None:
        """He reads."""
        super().resume_writing()
        self._watch_reader(stopped=False)

    def at_work(self) -> bool:
        """Tell whether a whole request is being answered."""
        # Before the first request there is no cycle, whatever uvicorn's types say.
        return self._waits_for is None and getattr(self.cycle, "response_complete", True) is False

    def let_go(self) -> None:
        """Close at once: a client that does not read gets no closing message either."""
        self._stop_waiting()
        self._watch_reader(stopped=False)
        self.connections.discard(self)
        self.transport.abort()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """From here on it is a WebSocket's connection, with waits of its own."""
        self._upgraded = True
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def _watch(self) -> None:
        """Wait for what the visitor has to say next; pieces of it do not make the wait longer."""
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
        self._wait = self.loop.call_later(wait_s, self.let_go)

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
            self._reader_wait = self.loop.call_later(READ_S, self.let_go)
