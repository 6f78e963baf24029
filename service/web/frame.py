"""The frame of every screen: language, visitor and navigation. It exists for the time of one request."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.domain.people import Permission
from abbe.service.rendering.numbers import Unit
from abbe.service.users.people import LOCAL_VIEWER
from abbe.service.web import language, units
from abbe.service.web.language import DEFAULT, NAMES
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.login.authentication import csrf_token
from abbe.service.web.login.origin import is_tls

YEAR_S = 31_536_000
THEMES = ("auto", "light", "dark")
CHOICES: Mapping[str, tuple[str, Collection[str]]] = {
    "lang": ("abbe_lang", tuple(NAMES)),
    "theme": ("abbe_theme", THEMES),
    "units": ("abbe_units", units.SYSTEMS),
}
"""Display options that a reader sets in the query of any screen: cookie and allowed values."""
Screen = tuple[str, str, Permission, tuple[str, ...]]
SCREENS: tuple[Screen, ...] = (
    ("/", "nav.home", Permission.READ, ("/", "/check")),
    ("/alarms", "nav.alarms", Permission.READ, ("/alarms", "/alarm")),
    ("/live", "nav.live", Permission.READ, ("/live", "/new")),
    ("/runs", "nav.runs", Permission.READ, ("/runs", "/run", "/compare")),
    ("/results", "nav.results", Permission.READ, ("/results", "/result", "/motions", "/volume", "/whatif", "/budget")),
    ("/proposals", "nav.proposals", Permission.READ, ("/proposals", "/proposal", "/table")),
    ("/trends", "nav.trends", Permission.READ, ("/trends",)),
)
MORE: tuple[Screen, ...] = (
    ("/discoveries", "nav.discovery", Permission.READ, ("/discoveries", "/discovery")),
    ("/schedule", "nav.schedule", Permission.READ, ("/schedule",)),
    ("/fleet", "nav.fleet", Permission.READ, ("/fleet",)),
    ("/devices", "nav.devices", Permission.READ, ("/devices",)),
    ("/settings", "nav.settings", Permission.READ, ("/settings", "/diagnostics", "/users", "/user", "/machine", "/administration")),
    ("/audit", "nav.audit", Permission.AUDIT, ("/audit",)),
)
"""Screens in the navigation bar, and behind its last entry: address, key of the text, permission, and addresses that select the entry."""


@dataclass(frozen=True, slots=True)
class Link:
    """One entry of the navigation bar; ``here``: it is the current screen."""

    href: str
    text: str
    here: bool


@dataclass(frozen=True, slots=True)
class Frame:
    """Language, visitor and display options of one response.

    ``path``, ``query``: address of the screen, without the language; ``paths``: existing addresses, the only ones that the navigation bar
    shows; None: all.
    """

    lang: str = DEFAULT
    path: str = "/"
    query: tuple[tuple[str, str], ...] = ()
    visit: Visit | None = None
    theme: str = THEMES[0]
    units: str = units.METRIC
    paths: frozenset[str] | None = None

    @property
    def who(self) -> str:
        """Name of the person with this session; empty if there is no session."""
        return self.visit.principal.name.partition(":")[2] if self.visit is not None and self.visit.secret else ""

    @property
    def csrf(self) -> str:
        """CSRF token for the forms of this page; empty without a session."""
        return csrf_token(self.visit.secret) if self.visit is not None and self.visit.secret else ""

    def may(self, need: Permission) -> bool:
        """Whether the visitor has a permission."""
        return self.visit is not None and need in self.visit.principal.permissions

    @property
    def without_users(self) -> bool:
        """Whether there is no user at all, so that everybody may look and nobody may change anything."""
        return self.visit is not None and self.visit.principal == LOCAL_VIEWER

    def links(self, screens: Sequence[Screen] = SCREENS) -> list[Link]:
        """The existing screens that the visitor may see."""
        shown = [one for one in screens if self.may(one[2]) and (self.paths is None or one[0] in self.paths)]
        return [Link(href, self.translate(key), self.path in own) for href, key, _, own in shown]

    def more(self) -> list[Link]:
        """Links to the screens that the last entry of the navigation opens."""
        return self.links(MORE)

    def length(self, value: float | str | None, unit: str = "µm", decimals: int | None = None) -> str:
        """A number in the reader's unit; arguments as in `units.shown`."""
        return units.shown(value, unit, self.units, decimals)

    def unit(self, unit: str = "µm") -> str:
        """Symbol of the reader's unit."""
        return units.unit_in(unit, self.units)

    def with_u(self, value: float | None, u: float | None, unit: str = "µm") -> tuple[str, str]:
        """A value and U = 2 u, rounded together in the reader's unit."""
        return units.rounded(value, u, unit, self.units)

    def drawn(self, unit: str = "µm") -> Unit:
        """The reader's unit for a picture or a script."""
        return units.drawn_in(unit, self.units)

    def languages(self) -> list[tuple[str, str, str]]:
        """Code, name and address of this screen in each language."""
        return [(code, name, f"{self.path}?{urlencode([*self.query, ('lang', code)])}") for code, name in NAMES.items()]

    def translate(self, key: str, **values: object) -> str:
        """A text in the reader's language."""
        return language.translate(self.lang, key, **values)

    def state(self, group: str, state: str) -> str:
        """A stored state in the reader's language, unchanged without a translation."""
        return language.translate_or(self.lang, f"{group}.{state}", state)


_NOW: ContextVar[Frame] = ContextVar("frame")
_NONE = Frame()


def current() -> Frame:
    """The frame of the current request."""
    return _NOW.get(_NONE)


def template_functions() -> dict[str, Callable[..., Any]]:
    """Functions for every template: ``t`` translates a text, ``state`` a stored state, ``frame`` is `current`."""
    return {
        "t": lambda key, **values: current().translate(key, **values),
        "state": lambda group, state: current().state(group, state),
        "frame": current,
        "unit": lambda unit="µm": current().unit(unit),
        "span_words": lambda: {key: language.catalogue(current().lang)[key] for key in language.SPAN_KEYS},
    }


class FrameMiddleware:
    """Sets the frame of every request and stores chosen display options in cookies. Pure ASGI, inside the auth middleware."""

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute] = (), *, behind_tls: bool = False) -> None:
        self._app, self._routes, self._behind_tls = app, routes, behind_tls
        self._paths: frozenset[str] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on within its frame."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        if self._paths is None and self._routes:
            self._paths = frozenset(str(getattr(route, "path", "")) for route in self._routes)
        chosen_now, frame = _frame_of(request, self._paths)
        token = _NOW.set(frame)
        try:
            keep = chosen_now if scope["method"] == "GET" else {}
            secure = is_tls(request, behind_tls=self._behind_tls)
            await self._app(scope, receive, _remembering(send, keep, secure=secure) if keep else send)
        finally:
            _NOW.reset(token)


def _frame_of(request: HTTPConnection, paths: frozenset[str] | None) -> tuple[dict[str, str], Frame]:
    """The options that a request chooses, and its frame."""
    chosen_now = {name: value for name in CHOICES if (value := request.query_params.get(name, "")) in CHOICES[name][1]}
    stored = {name: value for name, (cookie, allowed) in CHOICES.items() if (value := request.cookies.get(cookie, "")) in allowed}
    chosen = {"lang": language.preferred(request.headers.get("accept-language", "")), "theme": THEMES[0], "units": units.METRIC}
    chosen |= stored | chosen_now
    query = tuple((k, v) for k, v in request.query_params.multi_items() if k != "lang")
    visit = request.scope.get("state", {}).get("visit")
    path = request.scope["path"]
    return chosen_now, Frame(chosen["lang"], path, query, visit, chosen["theme"], chosen["units"], paths)


def language_of(request: HTTPConnection) -> str:
    """Return the language that the request chooses, else the one in its cookie, else the one that its header prefers."""
    return _frame_of(request, None)[1].lang


@contextmanager
def frame_for(request: HTTPConnection) -> Iterator[None]:
    """Set the frame of a request that is answered outside of `FrameMiddleware`."""
    token = _NOW.set(_frame_of(request, None)[1])
    try:
        yield
    finally:
        _NOW.reset(token)


def _remembering(send: Send, chosen: Mapping[str, str], *, secure: bool) -> Send:
    """Set the cookies if the response is a screen; health checks and programs get no cookie."""
    more = "; Secure" if secure else ""

    async def with_cookie(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in chosen.items() if headers.get("content-type", "").startswith("text/html") else ():
                headers.append("set-cookie", f"{CHOICES[name][0]}={value}; Path=/; Max-Age={YEAR_S}; SameSite=Lax; HttpOnly{more}")
        await send(message)

    return with_cookie
