"""What every screen of the store is made with: templates, authentication and the status; and how a screen is answered."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo
from typing import TypeVar
from zoneinfo import ZoneInfo

from fastapi.responses import HTMLResponse
from jinja2 import Environment

from abbe.service.errors import NotStored
from abbe.service.queries.reader import Reader, storable
from abbe.service.queries.status import Status, StatusSource
from abbe.service.report.report_parts import Rules
from abbe.service.storage.store import Store
from abbe.service.web import words
from abbe.service.web.login.authentication import Authenticator

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PageContext:
    """Where the screens get everything from.

    Parameters
    ----------
    env : Environment
        The templates; they escape everything.
    auth : Authenticator
        Its store is read, and its users approve.
    source : StatusSource
        How things stand now.
    reader : Reader
        The read model.
    rules : Rules
        Limits and certificates of the machine file: a screen judges as the report does.
    """

    env: Environment
    auth: Authenticator
    source: StatusSource
    reader: Reader
    rules: Rules = field(default_factory=Rules)

    @property
    def store(self) -> Store:
        """The open store."""
        return self.auth.store

    async def show(self, template: str, status: int = 200, /, **values: object) -> HTMLResponse:
        """Answer with a screen; times stand in the zone of the timetable."""
        moment = await self.source.status()
        zone = zone_of(moment)
        values |= {"machine": moment.machine, "zone": zone, "stamp": lambda text: stamp(text, zone)}
        return HTMLResponse(self.env.get_template(template).render(**values), status)

    async def missing(self, what: str, number: int) -> HTMLResponse:
        """Answer that there is no such thing."""
        return await self.show("missing.html", 404, what=what, number=number)

    async def read(self, work: Callable[..., T], *arguments: object) -> T:
        """Run something that reads the store, beside the event loop."""
        return await asyncio.to_thread(work, *arguments)


def can_be_stored(text: str) -> str:
    """A text of a query, unless no database could hold it.

    Raises
    ------
    ValueError
        It has a NUL or half of a character: nothing has such a name.
    """
    if not storable(text):
        raise ValueError("nothing can have this name: it has characters that cannot be stored")
    return text


def zone_of(status: Status) -> tzinfo:
    """The zone of the times on the screens: that of the first schedule, else UTC."""
    return ZoneInfo(status.next_due[0].timezone) if status.next_due else UTC


def stamp(text: str | datetime | None, zone: tzinfo) -> str:
    """A stored time as people of the zone write it down; a dash for none, and as it is where it is no time."""
    if text is None or text == "":
        return "–"
    try:
        moment = text if isinstance(text, datetime) else datetime.fromisoformat(text)
    except ValueError:
        return str(text)
    return words.stamp(moment, zone) if moment.tzinfo is not None else str(text)


def found(work: Callable[[int], T], number: int) -> T | None:
    """What the store has under a number; None where it has nothing. That it cannot be read is still an error."""
    try:
        return work(number)
    except NotStored:
        return None
