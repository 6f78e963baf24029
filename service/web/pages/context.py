"""Common context of the screens: templates, authentication, status and read model; and the response with a screen."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo
from typing import Annotated, TypeVar
from zoneinfo import ZoneInfo

from fastapi import Query
from fastapi.responses import HTMLResponse
from jinja2 import Environment
from pydantic import AfterValidator

from abbe.service.domain.machine import Rules
from abbe.service.errors import NotStored
from abbe.service.queries.reader import Reader, storable
from abbe.service.queries.status import Status, StatusSource
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.storage.store import Store
from abbe.service.web import formatting
from abbe.service.web.login.authentication import Authenticator
from abbe.service.web.strip import strip_of

T = TypeVar("T")
Number = Annotated[int | None, Query(ge=1, le=LARGEST)]
"""Number of an object in the query of a screen; None: the newest."""


@dataclass(frozen=True, slots=True)
class PageContext:
    """Sources of the screens. ``rules``: limits and certificates of the machine file, so that a screen judges as the report does.

    ``pushes_itself``: the service itself pushes approved tables, and takes no order to push; ``recipes``: checks that a schedule may name.
    """

    env: Environment
    auth: Authenticator
    source: StatusSource
    reader: Reader
    rules: Rules = field(default_factory=Rules)
    pushes_itself: bool = False
    recipes: tuple[str, ...] = ()

    @property
    def store(self) -> Store:
        """The open store."""
        return self.auth.store

    async def show(self, template: str, status: int = 200, /, **values: object) -> HTMLResponse:
        """Respond with a screen; its times are in the zone of the timetable."""
        now = await self.source.status()
        zone = zone_of(now)
        values = (
            {"now": now.now_utc, "pushes_itself": self.pushes_itself}
            | values
            | {"bar": strip_of(now), "machine": now.machine, "zone": zone, "stamp": lambda text: stamp(text, zone)}
        )
        return HTMLResponse(self.env.get_template(template).render(**values), status)

    async def missing(self, what: str, number: int) -> HTMLResponse:
        """Respond that an object does not exist (404)."""
        return await self.show("missing.html", 404, what=what, number=number)

    async def read(self, work: Callable[..., T], *arguments: object) -> T:
        """Run a function that reads the store in a thread."""
        return await asyncio.to_thread(work, *arguments)


def can_be_stored(text: str) -> str:
    """Return a text of a query unchanged. Raises ValueError if a database cannot store it, since then no object has this name."""
    if not storable(text):
        raise ValueError("the name has characters that cannot be stored")
    return text


Text = Annotated[str, Query(max_length=200), AfterValidator(can_be_stored)]
"""A name or another text in the query of a screen."""


def zone_of(status: Status) -> tzinfo:
    """Time zone of the screens: that of the schedule that is due first, else UTC."""
    return ZoneInfo(status.next_due[0].timezone) if status.next_due else UTC


def stamp(text: str | datetime | None, zone: tzinfo) -> str:
    """A stored time in a time zone; a dash for none; any other text unchanged."""
    if text is None or text == "":
        return "–"
    try:
        time = text if isinstance(text, datetime) else datetime.fromisoformat(text)
    except ValueError:
        return str(text)
    return formatting.stamp(time, zone) if time.tzinfo is not None else str(text)


def find_or_none(work: Callable[[int], T], number: int) -> T | None:
    """The stored object with a number; None if there is none. Other errors propagate."""
    try:
        return work(number)
    except NotStored:
        return None
