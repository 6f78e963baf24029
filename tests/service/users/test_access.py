"""Every route by everybody, made from the route table; and what a foreign page, a guesser and a flood are answered."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, WebSocket
from fastapi.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from abbe.service.core.board import Board
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import ConfigError
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import create_app
from abbe.service.web.document import HEADERS
from abbe.service.web.listening import check_exposure
from abbe.service.web.login.access import MUTATING, PUBLIC, Open, needs, route_permissions
from abbe.service.web.login.auth_middleware import CSRF_HEADER, AuthMiddleware
from abbe.service.web.login.authentication import COOKIE, Authenticator, csrf_token
from tests.service.users.conftest import PHRASE, World

BASE = "http://127.0.0.1:8080"
OWN = {"Origin": BASE}


@dataclass
class Somebody:
    """Who asks: headers, what he may do, and the status he is refused with."""

    name: str
    headers: dict[str, str]
    allowed: frozenset[Permission]
    refused: int


@dataclass
class Gate:
    world: World
    app: FastAPI
    auth: Authenticator
    client: httpx.AsyncClient

    def session(self, name: str) -> dict[str, str]:
        secret = self.world.people.begin(self.world.people.get(name))
        return {"Cookie": f"{COOKIE}={secret}", CSRF_HEADER: csrf_token(secret), **OWN}

    def token(self, name: str, title: str, scopes: list[str], days: float = 5.0) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.world.people.add_token(name, title, scopes, days)}"}

    async def ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        answer = await self.client.request(method, path, **more)
        assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS, path
        return answer


def app_of(world: World, auth: Authenticator | None, *, api: bool = False) -> FastAPI:
    board = Board({}, world.clock)
    none: list[tuple[Schedule, Any]] = []
    view = StatusReader(Reader(world.store, "mill-7", world.clock), "0.1.0", board, lambda: none, "")
    return create_app(view, version="0.1.0", auth=auth, api=Sources(reader=view.reader) if api else None)


def with_one_route_for_each_right(app: FastAPI) -> None:
    """What is to come: routes that change something, one for each right."""
    for need in Permission:
        for method in ("POST", "DELETE"):

            @needs(need)
            async def change() -> PlainTextResponse:
                return PlainTextResponse("changed")

            app.add_api_route(f"/api/v1/test/{need}", change, methods=[method], include_in_schema=False)


@pytest.fixture
async def gate(world: World) -> AsyncIterator[Gate]:
    for role in Role:
        world.people.add(f"a-{role}", role, PHRASE)
    world.people.add("a-second-admin", "admin", PHRASE)
    auth = Authenticator(world.store, world.people, world.book, now_s=world.clock.monotonic_s, rate_hz=1e6, burst=1e6)
    auth.recorded_refusals._burst = 1e6
    app = app_of(world, auth)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url=BASE) as client:
        yield Gate(world, app, auth, client)


def everybody(gate: Gate) -> list[Somebody]:
    people, clock = gate.world.people, gate.world.clock
    expired_token = gate.token("a-admin", "old", ["read", "users"], days=0.5)
    old_session = gate.session("a-operator")
    clock.later(days=1)
    revoked_session = gate.session("a-admin")
    people.end(revoked_session["Cookie"].partition("=")[2])
    revoked_token = gate.token("a-admin", "gone", ["read", "users"])
    people.revoke_token("a-admin", "gone")
    disabled = gate.session("a-second-admin")
    people.disable("a-second-admin")
    none: frozenset[Permission] = frozenset()
    out = [Somebody(str(role), gate.session(f"a-{role}"), ALLOWED[role], 403) for role in Role]
    out += [Somebody(f"token of {role}", gate.token(f"a-{role}", "all", sorted(ALLOWED[role])), ALLOWED[role], 403) for role in Role]
    out.append(Somebody("token that only reads", gate.token("a-admin", "reads", ["read"]), frozenset({Permission.READ}), 403))
    for name, headers in (
        ("anonymous", OWN),
        ("revoked session", revoked_session),
        ("disabled user", disabled),
        ("expired token", expired_token),
        ("revoked token", revoked_token),
        ("token of nobody", {"Authorization": "Bearer abbe_000000000000_" + "A" * 43}),
    ):
        out.append(Somebody(name, dict(headers), none, 401))
    out.append(Somebody("expired session", dict(old_session), frozenset({Permission.STOP}), 401))  # a stop asks for no fresh login
    return out


async def behind(scope: Scope, receive: Receive, send: Send) -> None:
    """Stands for every route: the request got past the auth."""
    await Response(status_code=204)(scope, receive, send)


async def test_every_route_by_everybody(gate: Gate) -> None:
    """Pages and interface, at the auth alone; `test_api_rights` asks the whole application once for each route."""
    app = app_of(gate.world, gate.auth, api=True)
    with_one_route_for_each_right(app)
    table = [cell for cell in route_permissions(app.routes) if cell[1] not in {"/login", "/logout", "/static"}]
    asserted = 0
    transport = httpx.ASGITransport(AuthMiddleware(behind, app.routes, gate.auth), False)
    async with httpx.AsyncClient(transport=transport, base_url=BASE) as client:
        for somebody in everybody(gate):
            for method, path, need in table:
                answer = await client.request(method, path.replace("{number}", "1").replace("{kind}", "run"), headers=somebody.headers)
                wanted = 204 if need is PUBLIC or need in somebody.allowed else somebody.refused
                assert answer.status_code == wanted, (somebody.name, method, path, answer.status_code)
                asserted += 1
    assert asserted == len(table) * 18
    assert len([path for _, path, _ in table if path.startswith("/api/v1")]) >= 32 + 2 * len(Permission)


async def test_logout_by_everybody(gate: Gate) -> None:
    for somebody in everybody(gate):
        answer = await gate.ask("POST", "/logout", headers=somebody.headers)
        assert answer.status_code == (303 if Permission.READ in somebody.allowed else 401), somebody.name


async def test_every_route_says_what_it_needs(gate: Gate) -> None:
    undeclared = [(method, path) for method, path, need in route_permissions(gate.app.routes) if need is None]
    assert undeclared == []
    public = {path for _, path, need in route_permissions(gate.app.routes) if isinstance(need, Open)}
    assert public == {"/icon.svg", "/manifest.webmanifest", "/sw.js", "/healthz", "/readyz", "/static", "/login"}
    without = app_of(gate.world, None)
    assert all(need is not None for _, _, need in route_permissions(without.routes))


async def test_a_route_without_a_declaration_is_shut_and_found(gate: Gate) -> None:
    @gate.app.get("/api/v1/new")
    async def new() -> str:
        return "open"

    assert [(method, path) for method, path, need in route_permissions(gate.app.routes) if need is None] == [("GET", "/api/v1/new")]
    for headers in (gate.session("a-admin"), gate.token("a-admin", "t", ["users"]), {}):
        assert (await gate.ask("GET", "/api/v1/new", headers=headers)).status_code == 403


async def test_every_changing_route_refuses_foreign_pages(gate: Gate) -> None:
    """A session's cookie alone is not enough: the page that sends it has to be ours, and know the session's token."""
    with_one_route_for_each_right(gate.app)
    tried = 0
    foreign = ("http://evil.example", "null", "http://127.0.0.1:8081", "http://127.0.0.1:8080.evil.example", "http://[", "file://", "")
    sessions = {role: gate.session(f"a-{role}") for role in Role}
    for method, path, need in route_permissions(gate.app.routes):
        if method not in MUTATING:
            continue
        good = sessions[next(role for role in Role if need is PUBLIC or need in ALLOWED[role])]
        bad = [{**good, "Origin": origin} for origin in foreign]
        bad += [{k: v for k, v in good.items() if k != "Origin"}, {**good, "Sec-Fetch-Site": "cross-site"}]
        if need is not PUBLIC:
            bad += [{k: v for k, v in good.items() if k != CSRF_HEADER}, {**good, CSRF_HEADER: "0" * 64}, {**good, CSRF_HEADER: ""}]
        for headers in bad:
            answer = await gate.ask(method, path, headers=headers)
            assert answer.status_code == 403, (method, path, headers)
            tried += 1
    assert tried > 200
    token = {**gate.token("a-admin", "t", ["users"]), "Origin": "http://evil.example"}
    assert (await gate.ask("POST", "/api/v1/test/users", headers=token)).status_code == 403


async def test_every_changing_route_leaves_one_record(gate: Gate) -> None:
    with_one_route_for_each_right(gate.app)
    for headers in (gate.session("a-admin"), gate.token("a-viewer", "t", ["read"]), OWN):
        for method, path, _ in sorted(route_permissions(gate.app.routes), key=lambda cell: cell[1] == "/logout"):
            before = len(gate.world.store.audit.events())
            status = (await gate.ask(method, path, headers=headers)).status_code
            new = gate.world.store.audit.events()[before:]
            assert len(new) == (1 if method in MUTATING else 0), (method, path)
            if new and path != "/login":
                assert new[0].action == f"{method} {path}"
                assert new[0].outcome == f"{'done' if status < 400 else 'refused'} {status}"
                assert new[0].target == path
    assert gate.world.book.verify() == []
    assert {r.who for r in gate.world.store.audit.events()} == {"user:a-admin", "token:a-viewer/t", "anonymous"}


async def log_in(gate: Gate, name: str, password: str, **headers: str) -> httpx.Response:
    return await gate.ask("POST", "/login", data={"name": name, "password": password}, headers={**OWN, **headers})


async def test_login_rotates_the_session_and_logout_ends_it(gate: Gate) -> None:
    answer = await log_in(gate, "a-operator", PHRASE)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"]
    for word in ("HttpOnly", "SameSite=strict", "Path=/"):
        assert word in cookie
    first = answer.cookies[COOKIE]
    assert (await gate.ask("GET", "/")).status_code == 200
    me = (await gate.ask("GET", "/api/v1/session")).json()
    assert (me["name"], me["role"], me["csrf_token"]) == ("user:a-operator", "operator", csrf_token(first))
    second = (await log_in(gate, "a-operator", PHRASE)).cookies[COOKIE]
    assert second != first
    gate.client.cookies.clear()
    assert (await gate.ask("GET", "/", headers={"Cookie": f"{COOKIE}={first}"})).status_code == 401
    known = {"Cookie": f"{COOKIE}={second}", CSRF_HEADER: csrf_token(second), **OWN}
    assert (await gate.ask("POST", "/logout", headers=known)).status_code == 303
    assert (await gate.ask("GET", "/", headers=known)).status_code == 401
    who = [(r.who, r.target, r.outcome) for r in gate.world.store.audit.events()]
    assert who == [
        ("user:a-operator", "a-operator", "done 303"),
        ("user:a-operator", "a-operator", "done 303"),
        ("user:a-operator", "/logout", "done 303"),
    ]


async def test_a_person_is_sent_to_the_login_page(gate: Gate) -> None:
    answer = await gate.ask("GET", "/", headers={"Accept": "text/html"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/login")
    page = (await gate.ask("GET", "/login")).text
    assert 'method="post" action="/login"' in page
    assert " style=" not in page


async def test_guessing_is_slowed_and_told_from_nothing(gate: Gate) -> None:
    """A user that exists and one that does not are answered alike, and a thousand tries are few hashes."""
    answers = {}
    for name in ("a-operator", "nobody"):
        gate.auth.lockout.__init__(gate.world.clock.monotonic_s)  # type: ignore[misc]
        begin = gate.world.people.passwords.hashes
        answers[name] = [await log_in(gate, name, f"guess number {n}") for n in range(30)]
        assert gate.world.people.passwords.hashes - begin == 5
    codes = [[a.status_code for a in answers[name]] for name in answers]
    assert codes[0] == codes[1] == [401] * 5 + [429] * 25
    assert [a.text for a in answers["a-operator"]] == [a.text for a in answers["nobody"]]
    assert answers["nobody"][-1].headers["retry-after"] == "2"
    told = " ".join(r.target for r in gate.world.store.audit.events())
    assert "nobody" not in told  # people type their password where the name belongs
    gate.world.clock.later(seconds=3)
    gate.auth.lockout.__init__(gate.world.clock.monotonic_s)  # type: ignore[misc]
    assert (await log_in(gate, "a-operator", PHRASE)).status_code == 303


async def test_guesses_at_once_are_no_more_than_guesses_one_by_one(gate: Gate) -> None:
    begin = gate.world.people.passwords.hashes
    await asyncio.gather(*(log_in(gate, "a-admin", f"guess {n}") for n in range(60)))
    assert gate.world.people.passwords.hashes - begin == 5
    assert gate.world.people.passwords.most_at_a_time <= 2


async def test_a_login_is_a_short_form(gate: Gate) -> None:
    assert (await log_in(gate, "a-admin", "x" * 10_000)).status_code == 413
    for body in (
        b"",
        b"name=a&name=b",
        b"\xff\xfe",
        b"name",
        b"&" * 5,
        b"a=1&" * 7,
        b"name=%00%0a&password=%00",
        b"name=" + b"%F0%9F%94%A5" * 200,
    ):
        answer = await gate.ask("POST", "/login", content=body, headers=OWN)
        assert answer.status_code in {401, 429}, body


async def test_a_flood_from_one_address_is_turned_away(world: World) -> None:
    world.people.add("root", "admin", PHRASE)
    auth = Authenticator(world.store, world.people, world.book, now_s=world.clock.monotonic_s)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app_of(world, auth), False), base_url=BASE) as client:
        codes = [(await client.get("/healthz")).status_code for _ in range(300)]
        assert codes == [200] * 200 + [429] * 100
        world.clock.later(seconds=4)
        assert (await client.get("/healthz")).status_code == 200
        refused = [(await client.post("/logout", headers=OWN)).status_code for _ in range(100)]
        assert set(refused) == {401}
    assert len(world.store.audit.events()) == 20  # who hammers at the auth does not fill the audit


async def test_without_users_everybody_may_look_and_nobody_may_change(world: World) -> None:
    auth = Authenticator(world.store, world.people, world.book, now_s=world.clock.monotonic_s)
    app = app_of(world, auth)
    with_one_route_for_each_right(app)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url=BASE) as client:
        for method, path, need in route_permissions(app.routes):
            if path in {"/static", "/login"}:
                continue
            status = (await client.request(method, path, headers=OWN)).status_code
            expected = 401 if method in MUTATING else 200 if need in {PUBLIC, Permission.READ} else 403
            assert status == expected, (method, path)
        world.people.add("root", "admin", PHRASE)  # from now on one has to be somebody
        assert (await client.get("/")).status_code == 401


async def test_a_change_that_cannot_be_recorded_is_not_answered_as_done(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    headers = gate.session("a-admin")
    monkeypatch.setattr(gate.world.book, "head_file", gate.world.book.head_file.parent)  # a folder cannot be written to
    answer = await gate.ask("POST", "/logout", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (503, "AUD-001")


async def test_a_stop_does_not_wait_for_the_audit(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    with_one_route_for_each_right(gate.app)
    headers = gate.session("a-operator")
    monkeypatch.setattr(gate.world.book, "head_file", gate.world.book.head_file.parent)
    assert (await gate.ask("POST", "/api/v1/test/measure", headers=headers)).status_code == 503
    assert (await gate.ask("POST", "/api/v1/test/stop", headers=headers)).text == "changed"


@pytest.mark.parametrize(("origin", "opened"), [(BASE, True), ("http://evil.example", False), (None, False)])
async def test_a_web_socket_opens_for_our_own_page_only(gate: Gate, origin: str | None, opened: bool) -> None:
    @gate.app.websocket("/api/v1/live")
    @needs(Permission.READ)
    async def live(socket: WebSocket) -> None:
        await socket.accept()
        await socket.close()

    cookie = gate.session("a-viewer")["Cookie"]
    headers = [(b"host", b"127.0.0.1:8080"), (b"cookie", cookie.encode())]
    headers += [(b"origin", origin.encode())] if origin else []
    sent: list[str] = []

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message["type"])

    scope = {
        "type": "websocket",
        "path": "/api/v1/live",
        "headers": headers,
        "query_string": b"",
        "client": ("127.0.0.1", 1),
        "scheme": "ws",
    }
    await gate.app({**scope, "root_path": "", "subprotocols": []}, receive, send)
    assert sent == (["websocket.accept", "websocket.close"] if opened else ["websocket.close"])


async def test_a_defect_has_the_headers_too(gate: Gate) -> None:
    @gate.app.get("/api/v1/defect")
    @needs(PUBLIC)
    async def defect() -> None:
        raise ZeroDivisionError

    assert (await gate.ask("GET", "/api/v1/defect")).status_code == 500


async def test_a_foreign_name_of_this_computer_is_refused_also_at_the_login(gate: Gate) -> None:
    answer = await gate.ask(
        "POST", "/login", data={"name": "a", "password": "b"}, headers={"Host": "evil.example", "Origin": "http://evil.example"}
    )
    assert answer.status_code == 400


@pytest.mark.parametrize(
    ("host", "names", "admins", "tls", "why"),
    [
        ("127.0.0.1", (), 0, "no", None),
        ("::1", (), 0, "no", None),
        ("localhost", (), 0, "no", None),
        ("127.0.0.1", ("localhost", "[::1]"), 0, "no", None),
        ("0.0.0.0", (), 0, "own", "no user who is admin"),
        ("192.168.1.5", (), 0, "own", "no user who is admin"),
        ("127.0.0.1", ("abbe.plant",), 0, "proxy", "names 'abbe.plant' can be reached .* no user who is admin"),
        ("127.0.0.1", ("abbe.plant",), 1, "no", "in clear - .*behind_tls"),
        ("127.0.0.1", ("abbe.plant",), 1, "proxy", None),
        ("127.0.0.1", ("abbe.plant",), 1, "own", None),
        ("::", (), 3, "no", "in clear"),
        ("abbe.plant", (), 3, "no", "in clear"),
        ("0.0.0.0", ("abbe.plant",), 3, "proxy", "in clear"),  # also past the proxy
        ("0.0.0.0", (), 3, "own", None),
    ],
)
def test_where_the_page_may_listen(host: str, names: tuple[str, ...], admins: int, tls: str, why: str | None) -> None:
    given = {"tls": tls == "own", "names": names, "behind_tls": tls == "proxy"}
    if why is None:
        check_exposure(host, lambda: admins, **given)
        return
    with pytest.raises(ConfigError, match=why):
        check_exposure(host, lambda: admins, **given)


def test_only_an_admin_who_can_log_in_counts(world: World) -> None:
    """Anybody else could shut nobody out, and give nobody a right."""
    assert world.store.people.active_admins() == 0
    for role in Role:
        if role is not Role.ADMIN:
            world.people.add(f"a-{role}", role, PHRASE)
    assert world.store.people.active_admins() == 0
    world.people.add("ana", "admin", PHRASE)
    world.people.add("bob", "admin", PHRASE)
    assert world.store.people.active_admins() == 2
    world.people.disable("bob")
    assert world.store.people.active_admins() == 1
    world.store.people.change(world.people.get("ana").id, password="")
    assert world.store.people.active_admins() == 0
