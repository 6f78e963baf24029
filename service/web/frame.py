"""What surrounds every screen: in which language, for whom, and where one can go. Known for the time of one request."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.rendering.numbers import Unit
from abbe.service.users.roles import Permission
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
"""What a reader chooses by the query of any screen: the cookie that keeps it, and what there is. Display only."""
Screen = tuple[str, str, Permission, tuple[str, ...]]
SCREENS: tuple[Screen, ...] = (
    ("/", "nav.home", Permission.READ, ("/",)),
    ("/live", "nav.live", Permission.READ, ("/live", "/new")),
    ("/runs", "nav.runs", Permission.READ, ("/runs", "/run", "/compare")),
    ("/results", "nav.results", Permission.READ, ("/results", "/result", "/volume", "/whatif", "/budget")),
    ("/proposals", "nav.proposals", Permission.READ, ("/proposals", "/proposal", "/table")),
    ("/trends", "nav.trends", Permission.READ, ("/trends",)),
)
MORE: tuple[Screen, ...] = (
    ("/discoveries", "nav.discovery", Permission.READ, ("/discoveries", "/discovery")),
    ("/schedule", "nav.schedule", Permission.READ, ("/schedule",)),
    ("/fleet", "nav.fleet", Permission.READ, ("/fleet",)),
    ("/devices", "nav.devices", Permission.READ, ("/devices",)),
    ("/settings", "nav.settings", Permission.READ, ("/settings", "/diagnostics")),
    ("/audit", "nav.audit", Permission.AUDIT, ("/audit",)),
)
"""In the bar, and behind its last entry. Address, word, what it needs, and the addresses under which it is the present one."""


@dataclass(frozen=True, slots=True)
class Link:
    """One entry of the navigation bar; ``here``: the present screen."""

    href: str
    text: str
    here: bool


@dataclass(frozen=True, slots=True)
class Frame:
    """The surroundings of one answer.

    Parameters
    ----------
    lang : str
        Language of the words.
    path : str
        Address of the screen.
    query : tuple of pairs of str
        Its query, without the language.
    visit : Visit, optional
        Who asks.
    theme, units : str
        As the reader chose them.
    there : frozenset of str, optional
        Addresses that are answered; a screen that is not among them is not in the bar. None: not known, all of them.
    """

    lang: str = DEFAULT
    path: str = "/"
    query: tuple[tuple[str, str], ...] = ()
    visit: Visit | None = None
    theme: str = THEMES[0]
    units: str = units.METRIC
    there: frozenset[str] | None = None

    @property
    def who(self) -> str:
        """Name of the person with this session; empty without one."""
        return self.visit.principal.name.partition(":")[2] if self.visit is not None and self.visit.secret else ""

    @property
    def csrf(self) -> str:
        """What a form of this page sends back; empty without a session."""
        return csrf_token(self.visit.secret) if self.visit is not None and self.visit.secret else ""

    def may(self, need: Permission) -> bool:
        """Whether the visitor has a right."""
        return self.visit is not None and need in self.visit.principal.permissions

    def links(self, screens: Sequence[Screen] = SCREENS) -> list[Link]:
        """The existing screens that the visitor may see."""
        shown = [one for one in screens if self.may(one[2]) and (self.there is None or one[0] in self.there)]
        return [Link(href, self.say(word), self.path in own) for href, word, _, own in shown]

    def more(self) -> list[Link]:
        """The same behind the last entry of the bar."""
        return self.links(MORE)

    def length(self, value: float | str | None, unit: str = "µm", decimals: int | None = None) -> str:
        """A number in the reader's unit; ``decimals`` as in `units.shown`."""
        return units.shown(value, unit, self.units, decimals)

    def unit(self, unit: str = "µm") -> str:
        """The reader's unit for one of ours."""
        return units.unit_in(unit, self.units)

    def with_u(self, value: float | None, u: float | None, unit: str = "µm") -> tuple[str, str]:
        """A value and U (k = 2) of its standard uncertainty, rounded together in the reader's unit."""
        return units.rounded(value, u, unit, self.units)

    def drawn(self, unit: str = "µm") -> Unit:
        """The reader's unit for a picture or a script."""
        return units.drawn_in(unit, self.units)

    def languages(self) -> list[tuple[str, str, str]]:
        """Code, name and address of this very screen in each language."""
        return [(code, name, f"{self.path}?{urlencode([*self.query, ('lang', code)])}") for code, name in NAMES.items()]

    def say(self, key: str, **values: object) -> str:
        """A text in the reader's language."""
        return language.say(self.lang, key, **values)

    def state(self, group: str, word: str) -> str:
        """A stored state in the reader's language; as it is where it has no translation."""
        return language.known(self.lang, f"{group}.{word}", word)


_NOW: ContextVar[Frame] = ContextVar("frame")
_NONE = Frame()


def current() -> Frame:
    """The frame of the request that is being answered."""
    return _NOW.get(_NONE)


def template_words() -> dict[str, Callable[..., Any]]:
    """What every template may call: ``t`` for a text, ``state`` for a stored state, ``frame`` for the surroundings."""
    return {
        "t": lambda key, **values: current().say(key, **values),
        "state": lambda group, word: current().state(group, word),
        "frame": current,
        "unit": lambda unit="µm": current().unit(unit),
        "span_words": lambda: {key: language.catalogue(current().lang)[key] for key in language.SPAN_KEYS},
    }


class Framed:
    """Finds out the language of every request and remembers the one that was asked for. Pure ASGI, inside of the guard."""

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute] = (), *, behind_tls: bool = False) -> None:
        self._app, self._routes, self._behind_tls = app, routes, behind_tls
        self._there: frozenset[str] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        if self._there is None and self._routes:
            self._there = frozenset(str(getattr(route, "path", "")) for route in self._routes)
        asked = {name: value for name in CHOICES if (value := request.query_params.get(name, "")) in CHOICES[name][1]}
        kept = {name: value for name, (cookie, there) in CHOICES.items() if (value := request.cookies.get(cookie, "")) in there}
        chosen = {"lang": language.wanted(request.headers.get("accept-language", "")), "theme": THEMES[0], "units": units.METRIC}
        chosen |= kept | asked
        query = tuple((k, v) for k, v in request.query_params.multi_items() if k != "lang")
        visit = scope.get("state", {}).get("visit")
        token = _NOW.set(Frame(chosen["lang"], scope["path"], query, visit, chosen["theme"], chosen["units"], self._there))
        try:
            keep = asked if scope["method"] == "GET" else {}
            secure = is_tls(request, behind_tls=self._behind_tls)
            await self._app(scope, receive, _remembering(send, keep, secure=secure) if keep else send)
        finally:
            _NOW.reset(token)


def _remembering(send: Send, asked: Mapping[str, str], *, secure: bool) -> Send:
    """Keep what was asked for, if the answer is a screen: a probe or a program that asks for a document gets no cookie."""
    more = "; Secure" if secure else ""

    async def with_cookie(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in asked.items() if headers.get("content-type", "").startswith("text/html") else ():
                headers.append("set-cookie", f"{CHOICES[name][0]}={value}; Path=/; Max-Age={YEAR_S}; SameSite=Lax; HttpOnly{more}")
        await send(message)

    return with_cookie
