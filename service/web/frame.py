"""What surrounds every screen: in which language, for whom, and where one can go. Known for the time of one request."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.users.roles import Permission
from service.web import language
from service.web.door import csrf_token
from service.web.guard import Visit
from service.web.language import DEFAULT, NAMES

COOKIE = "abbe_lang"
YEAR_S = 31_536_000
SCREENS = (
    ("/", "nav.home", Permission.READ, ("/",)),
    ("/runs", "nav.runs", Permission.READ, ("/runs", "/run")),
    ("/results", "nav.results", Permission.READ, ("/results", "/result")),
    ("/discoveries", "nav.discovery", Permission.READ, ("/discoveries", "/discovery")),
    ("/proposals", "nav.proposals", Permission.READ, ("/proposals", "/proposal")),
    ("/trends", "nav.trends", Permission.READ, ("/trends",)),
    ("/schedule", "nav.schedule", Permission.READ, ("/schedule",)),
    ("/audit", "nav.audit", Permission.AUDIT, ("/audit",)),
)
"""Address, word, what it needs, and the addresses under which it is the present one."""


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
    """

    lang: str = DEFAULT
    path: str = "/"
    query: tuple[tuple[str, str], ...] = ()
    visit: Visit | None = None

    @property
    def who(self) -> str:
        """Name of whoever is logged in with a session; empty otherwise."""
        return self.visit.principal.name.partition(":")[2] if self.visit is not None and self.visit.secret else ""

    @property
    def csrf(self) -> str:
        """What a form of this page sends back; empty without a session."""
        return csrf_token(self.visit.secret) if self.visit is not None and self.visit.secret else ""

    def may(self, need: Permission) -> bool:
        """Whether whoever asks has a right."""
        return self.visit is not None and need in self.visit.principal.permissions

    def links(self) -> list[Link]:
        """The screens that whoever asks may see."""
        return [Link(href, self.say(word), self.path in own) for href, word, need, own in SCREENS if self.may(need)]

    def languages(self) -> list[tuple[str, str, str]]:
        """Code, name and address of this very screen in each language."""
        return [(code, name, f"{self.path}?{urlencode([*self.query, ('lang', code)])}") for code, name in NAMES.items()]

    def say(self, key: str, **values: object) -> str:
        """A text in the reader's language."""
        return language.say(self.lang, key, **values)

    def state(self, group: str, word: str) -> str:
        """A stored state in the reader's language; as it is where nobody has translated it."""
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
        "span_words": lambda: {key: language.catalogue(current().lang)[key] for key in language.SPAN_KEYS},
    }


class Framed:
    """Finds out the language of every request and remembers the one that was asked for. Pure ASGI, inside of the guard."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        asked = request.query_params.get("lang", "")
        asked = asked if asked in NAMES else ""
        kept = request.cookies.get(COOKIE, "")
        chosen = asked or (kept if kept in NAMES else language.wanted(request.headers.get("accept-language", "")))
        query = tuple((k, v) for k, v in request.query_params.multi_items() if k != "lang")
        token = _NOW.set(Frame(chosen, scope["path"], query, scope.get("state", {}).get("visit")))
        try:
            await self._app(scope, receive, _remembering(send, asked) if asked else send)
        finally:
            _NOW.reset(token)


def _remembering(send: Send, asked: str) -> Send:
    async def with_cookie(message: Message) -> None:
        if message["type"] == "http.response.start":
            cookie = f"{COOKIE}={asked}; Path=/; Max-Age={YEAR_S}; SameSite=Lax; HttpOnly"
            MutableHeaders(scope=message).append("set-cookie", cookie)
        await send(message)

    return with_cookie
