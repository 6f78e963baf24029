"""Writes link incidents during a measurement into the campaign's journal, in a task of its own: no link waits for the database."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import Any

from abbe.drivers.errors import NO_RUN, on_behalf_of
from abbe.drivers.links.incidents import Incident, Incidents
from abbe.drivers.links.shielded import run_to_end
from abbe.service.clock import Clock
from abbe.service.devices.session import Session
from abbe.service.sequences.journal import INCIDENT, OUTCOME, Journal

LINKS = {"controller": "controller", "laser": "laser", "ballbar": "ball-bar"}
STILL_OPEN = "open"
"""Outcome of an incident that lasts beyond the end of the measurement."""
MOST_WAITING = 1000
"""Longest queue of lines while the database is locked; further incidents are only counted."""
LAST_LINES_S = 5.0
"""Longest wait at the end of a measurement for the last lines to reach the database."""


def links_of(session: Session) -> dict[str, Incidents]:
    """Return the incident lists of a session's links by device name; devices without one are left out."""
    found = {name: getattr(getattr(session, attribute, None), "incidents", None) for attribute, name in LINKS.items()}
    return {name: one for name, one in found.items() if isinstance(one, Incidents)}


@contextmanager
def run_named(session: Session, name: str) -> Iterator[None]:
    """Attach the run's name to every error and incident in this block, also those outside our requests (heartbeat, pulled cable)."""
    links = links_of(session)
    for one in links.values():
        one.run = name
    try:
        with on_behalf_of(name):
            yield
    finally:
        for one in links.values():
            one.run = NO_RUN


@asynccontextmanager
async def incidents_noted(session: Session, notes: IncidentNotes) -> AsyncIterator[None]:
    """Write every incident of a session's links into the journal while the block lasts.

    The exit waits at most ``LAST_LINES_S`` for the last lines: a locked database must not keep a measurement from ending.
    """
    with ExitStack() as undo:
        links = links_of(session)
        for name, one in links.items():
            before, one.listen = one.listen, partial(notes.hear, name)
            undo.callback(setattr, one, "listen", before)
            if one.open is not None and one.entries:  # it began before the measurement and is still open
                notes.hear(name, one.entries[-1])
        writer = asyncio.create_task(notes.write())
        try:
            yield
        finally:
            undo.close()
            notes.still_open({name for name, one in links.items() if one.open is not None})
            await run_to_end(notes.finish(writer))


class IncidentNotes:
    """A queue of incidents and the task that empties it.

    ``not_written`` counts incidents missing from the journal: the queue was full, or the database took none until the end.
    """

    def __init__(self, journal: Journal, clock: Clock) -> None:
        self.not_written = 0
        self._journal, self._clock = journal, clock
        self._waiting: deque[dict[str, Any]] = deque()
        self._latest: dict[str, dict[str, Any]] = {}
        self._news, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()

    def hear(self, link: str, entry: Incident) -> None:
        """Queue an incident; returns at once. Call it in the event loop."""
        at = self._clock.utc() - timedelta(seconds=max(time.monotonic() - entry.host_s, 0.0))
        line: dict[str, Any] = {
            "phase": entry.kind,
            "link": link,
            "code": entry.code,
            "device": entry.device,
            "run": entry.run,
            "text": entry.text,
        }
        line |= {"at_utc": at.isoformat(timespec="milliseconds"), "host_s": entry.host_s}
        line |= {"state": entry.state, "times": entry.times} if entry.kind == OUTCOME else {}
        self._put(link, line)

    def still_open(self, links: set[str]) -> None:
        """Record the outcome "open" for links whose incident lasts beyond the end of the measurement."""
        now = {"phase": OUTCOME, "state": STILL_OPEN, "at_utc": self._clock.utc().isoformat(timespec="milliseconds")}
        for link in sorted(links & self._latest.keys()):
            self._put(link, self._latest[link] | now | {"host_s": time.monotonic()})

    def _put(self, link: str, line: dict[str, Any]) -> None:
        self._latest[link] = line
        if len(self._waiting) >= MOST_WAITING:
            self.not_written += 1
            return
        self._waiting.append(line)
        self._empty.clear()
        self._news.set()

    async def write(self) -> None:
        """Write queued lines in order until cancelled. A line that the database refuses is counted and left out."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._waiting:
                try:
                    await self._journal.add(INCIDENT, **self._waiting[0])
                except Exception:  # noqa: BLE001 - a note about a link must not end a measurement
                    self.not_written += 1
                self._waiting.popleft()
            self._empty.set()

    async def finish(self, writer: asyncio.Task[None]) -> None:
        """Wait up to ``LAST_LINES_S`` for the last lines, then end the task."""
        with suppress(TimeoutError):
            async with asyncio.timeout(LAST_LINES_S):
                waited = asyncio.create_task(self._empty.wait())
                try:
                    await asyncio.wait({waited, writer}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    waited.cancel()
        self.not_written += len(self._waiting)
        writer.cancel()
        await asyncio.wait({writer})
