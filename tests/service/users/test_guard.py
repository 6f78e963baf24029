"""What a changing request leaves behind when it ends badly, how long a session lives, whose cookie is whose, and a proxy in front."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from starlette.responses import StreamingResponse

from abbe.service.domain.people import Permission
from abbe.service.errors import AbbeError, StoreError
from abbe.service.users.people import IDLE, Passwords
from abbe.service.web.app import as_in_host_header, create_app
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import CSRF_HEADER
from abbe.service.web.login.authentication import Authenticator, Endpoint
from tests.service.users.conftest import PHRASE, World
from tests.service.users.test_access import BASE, OWN, Gate, app_of, gate, log_in

__all__ = ["gate"]  # the fixture


def behind(world: World, endpoint: Endpoint) -> tuple[FastAPI, Authenticator]:
    auth = Authenticator(world.store, world.people, world.book, endpoint, now_s=world.clock.monotonic_s)
    return app_of(world, auth), auth


@asynccontextmanager
async def client_of(app: FastAPI, base: str = BASE, **more: Any) -> AsyncIterator[httpx.AsyncClient]:
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False, **more), base_url=base) as client:
        yield client


def cookie(jar: dict[str, str]) -> dict[str, str]:
    return {"Cookie": "; ".join(f"{name}={value}" for name, value in jar.items())} if jar else {}


def told(world: World) -> list[tuple[str, str, str]]:
    return [(r.who, r.action, r.outcome) for r in world.store.audit.events()]


async def test_a_change_that_ends_in_a_defect_is_recorded(gate: Gate) -> None:
    errors: list[BaseException] = [ZeroDivisionError(), AbbeError("no"), StoreError("gone"), asyncio.CancelledError()]

    @gate.app.post("/api/v1/bad")
    @needs(Permission.USERS)
    async def bad() -> None:
        raise errors[0]

    headers = gate.session("a-admin")
    outcomes = []
    for _ in range(3):
        answer = await gate.ask("POST", "/api/v1/bad", headers=headers)
        outcomes.append((answer.status_code, told(gate.world)[-1][2]))
        errors.pop(0)
    assert outcomes == [(500, "failed: ZeroDivisionError"), (500, "failed 500"), (503, "failed 503")]
    with pytest.raises(asyncio.CancelledError):
        await gate.ask("POST", "/api/v1/bad", headers=headers)
    assert told(gate.world)[-1] == ("user:a-admin", "POST /api/v1/bad", "failed: CancelledError")
    assert len(told(gate.world)) == 4
    assert gate.world.book.verify() == []


async def test_a_change_whose_answer_breaks_off_is_recorded_as_that(gate: Gate) -> None:
    @gate.app.post("/api/v1/half")
    @needs(Permission.USERS)
    async def half() -> StreamingResponse:
        async def pieces() -> AsyncIterator[bytes]:
            yield b"half"
            raise ZeroDivisionError

        return StreamingResponse(pieces())

    await gate.ask("POST", "/api/v1/half", headers=gate.session("a-admin"))
    assert [outcome for _, _, outcome in told(gate.world)] == ["done 200", "failed: ZeroDivisionError after the answer had begun"]


async def test_defects_are_recorded_however_many(gate: Gate) -> None:
    """Refusals of one address are thinned out; what may have changed something is not."""
    gate.auth.recorded_refusals._burst = 1.0

    @gate.app.post("/api/v1/bad")
    @needs(Permission.USERS)
    async def bad() -> None:
        raise ZeroDivisionError

    headers = gate.session("a-admin")
    for _ in range(5):
        await gate.ask("POST", "/api/v1/bad", headers=headers)
        await gate.ask("POST", "/api/v1/bad", headers={**headers, CSRF_HEADER: ""})
    outcomes = [outcome for _, _, outcome in told(gate.world)]
    assert outcomes.count("failed: ZeroDivisionError") == 5
    assert outcomes.count("refused 403") == 1


async def test_what_could_not_be_recorded_is_not_begun(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    done = []

    @gate.app.post("/api/v1/change")
    @needs(Permission.USERS)
    async def change() -> str:
        done.append(1)
        return "done"

    headers = gate.session("a-admin")
    head = gate.world.book.head_file
    head.mkdir()
    answer = await gate.ask("POST", "/api/v1/change", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (503, "AUD-001")
    assert answer.json()["detail"].startswith("not done, since it could not be recorded: ")
    assert done == []
    head.rmdir()
    assert (await gate.ask("POST", "/api/v1/change", headers=headers)).status_code == 200
    assert done == [1]


async def test_a_form_that_is_none_is_no_defect(gate: Gate) -> None:
    for body in (b"a=1&" * 40, b"&" * 40, b"name=%ed%a0%80&password=%ff", b"=" * 100 + b"&x" * 9):
        answer = await gate.ask("POST", "/login", content=body, headers=OWN)
        assert answer.status_code in {401, 413}, body
    assert {outcome for _, _, outcome in told(gate.world)} <= {"refused 401", "refused 413"}


async def test_who_goes_away_in_the_middle_of_a_login_is_no_defect(gate: Gate) -> None:
    messages = iter([{"type": "http.request", "body": b"name=a", "more_body": True}, {"type": "http.disconnect"}])
    sent: list[Any] = []

    async def receive() -> Any:
        return next(messages)

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": "/login", "scheme": "http", "client": ("127.0.0.1", 1), "query_string": b""}
    headers = [(b"host", b"127.0.0.1:8080"), (b"origin", BASE.encode())]
    await gate.app({**scope, "headers": headers, "root_path": "", "http_version": "1.1"}, receive, send)
    assert sent[0]["status"] == 413
    assert [outcome for _, _, outcome in told(gate.world)] == ["refused 413"]


async def test_a_page_that_refreshes_itself_does_not_keep_its_session_alive(gate: Gate) -> None:
    asks = {
        "the status, as the page asks it": ("/api/v1/status", {"X-Abbe-Active": "0"}, 401),
        "the status, by another program": ("/api/v1/status", {}, 401),
        "the page, asked for by itself": ("/", {"X-Abbe-Active": "0"}, 401),
        "the status, after a click": ("/api/v1/status", {"X-Abbe-Active": "1"}, 200),
        "the page, by a person": ("/", {}, 200),
    }
    for what, (path, more, status) in asks.items():
        headers = gate.session("a-viewer") | more
        for _ in range(9):
            gate.world.clock.later(minutes=5)
            last = (await gate.ask("GET", path, headers=headers)).status_code
        assert last == status, what
    headers = gate.session("a-viewer")
    gate.world.clock.later(seconds=IDLE.total_seconds() - 1)
    assert (await gate.ask("GET", "/api/v1/status", headers=headers)).status_code == 200


async def test_the_page_has_a_way_out_for_who_is_logged_in(gate: Gate) -> None:
    page = (await gate.ask("GET", "/", headers=gate.session("a-viewer"))).text
    assert '<button id="logout" type="submit"' in page
    assert 'href="/settings">a-viewer</a>' in page
    assert "/static/send.js" in page
    assert 'id="logout"' not in (await gate.ask("GET", "/", headers=gate.token("a-viewer", "t", ["read"]))).text
    async with client_of(app_of(gate.world, None)) as client:
        assert 'id="logout"' not in (await client.get("/")).text


async def test_nothing_about_a_machine_is_kept_by_a_browser(gate: Gate) -> None:
    headers = gate.session("a-admin")
    for path, kept in {
        "/": "no-store",
        "/api/v1/status": "no-store",
        "/api/v1/users": "no-store",
        "/login": "no-store",
        "/nothing": "no-store",
        "/static/page.css": "no-cache",
        "/icon.svg": "no-cache",
    }.items():
        answer = await gate.ask("GET", path, headers=headers)
        assert answer.headers["cache-control"] == kept, path
        assert "strict-transport-security" not in answer.headers


@pytest.mark.parametrize("endpoint", [Endpoint(), Endpoint(8080, behind_tls=True)])
async def test_tls_is_said_to_be_here_to_stay(world: World, endpoint: Endpoint) -> None:
    app, _ = behind(world, endpoint)
    async with client_of(app, "http://127.0.0.1" if endpoint.behind_tls else "https://127.0.0.1") as client:
        for path in ("/healthz", "/nothing", "/static/page.css"):
            assert (await client.get(path)).headers["strict-transport-security"] == "max-age=31536000", path


async def test_two_services_on_one_host_do_not_log_each_other_out(world: World) -> None:
    """Browsers send a cookie to every port of a host: here one jar for both, as a browser has it."""
    world.people.add("ana", "admin", PHRASE)
    (first, _), (second, auth) = behind(world, Endpoint(8080)), behind(world, Endpoint(8081))
    jar: dict[str, str] = {}

    async def ask(app: FastAPI, port: int, method: str, path: str, **more: Any) -> httpx.Response:
        base = f"http://127.0.0.1:{port}"
        async with client_of(app, base) as client:
            answer = await client.request(method, path, headers={"Origin": base, **cookie(jar), **more.pop("headers", {})}, **more)
        jar.update(answer.cookies)
        return answer

    form = {"name": "ana", "password": PHRASE}
    for app, port in ((first, 8080), (second, 8081)):
        assert (await ask(app, port, "POST", "/login", data=form)).status_code == 303
    assert {"abbe-8080", "abbe-8081"} <= jar.keys()
    for app, port in ((first, 8080), (second, 8081)):
        assert (await ask(app, port, "GET", "/api/v1/status")).status_code == 200
    token = (await ask(second, 8081, "GET", "/api/v1/session")).json()["csrf_token"]
    assert (await ask(second, 8081, "POST", "/logout", headers={CSRF_HEADER: token})).status_code == 303
    assert (await ask(first, 8080, "GET", "/api/v1/status")).status_code == 200
    assert auth.cookie(tls=True) == "__Host-abbe-8081"


async def test_behind_a_proxy_with_tls_cookies_are_secure_and_origins_https(world: World) -> None:
    world.people.add("ana", "admin", PHRASE)
    app, _ = behind(world, Endpoint(8080, behind_tls=True))
    form = {"name": "ana", "password": PHRASE}
    async with client_of(app, "http://localhost") as client:
        for origin, status in (("http://localhost", 403), ("https://evil.example", 403), ("https://localhost", 303)):
            answer = await client.post("/login", data=form, headers={"Origin": origin})
            assert answer.status_code == status, origin
        cookies = answer.headers.get_list("set-cookie")
        assert [c.partition("=")[0] for c in cookies] == ["__Host-abbe-8080", "abbe-8080-device-24d4b96f"]
        assert all(word in c for c in cookies for word in ("Secure", "HttpOnly", "SameSite=strict"))


async def test_behind_a_proxy_the_visitor_is_who_the_proxy_says_last(world: World) -> None:
    seen = []
    for endpoint, came_from in (
        (Endpoint(1, behind_tls=True), "127.0.0.1"),
        (Endpoint(1), "127.0.0.1"),
        (Endpoint(1, behind_tls=True), "192.0.2.7"),
    ):
        app, _ = behind(world, endpoint)

        @app.get("/api/v1/whence")
        @needs(Permission.READ)
        async def whence(request: Request) -> str:
            return str(request.state.visit.address)

        async with client_of(app, client=(came_from, 1)) as client:
            for said in ("198.51.100.9", "10.0.0.1, 198.51.100.9", "nonsense", "2001:db8::1", ""):
                seen.append((await client.get("/api/v1/whence", headers={"X-Forwarded-For": said})).json())
    assert seen[:5] == ["198.51.100.9", "198.51.100.9", "127.0.0.1", "2001:db8::1", "127.0.0.1"]
    assert set(seen[5:10]) == {"127.0.0.1"}  # nobody said that there is a proxy
    assert set(seen[10:]) == {"192.0.2.7"}  # past the proxy


async def test_an_address_with_colons_is_a_name_as_well(world: World) -> None:
    given = ["::1", "[fd00:0::5]", "FD00::6", "192.0.2.1", "abbe.plant"]
    assert [as_in_host_header(host) for host in given] == ["[::1]", "[fd00::5]", "[fd00::6]", "192.0.2.1", "abbe.plant"]
    app = create_app(_view(world), version="0.1.0", hosts=given, auth=None)
    async with client_of(app) as client:
        for host in ("[::1]:8080", "[fd00::5]", "[fd00::6]:8080", "192.0.2.1:1", "Abbe.Plant"):
            assert (await client.get("/healthz", headers={"Host": host})).status_code == 200, host
        for host in ("fd00::5", "[fd00::7]", "evil.example"):
            assert (await client.get("/healthz", headers={"Host": host})).status_code == 400, host


def _view(world: World) -> Any:
    from abbe.service.core.board import Board
    from abbe.service.queries.reader import Reader
    from abbe.service.queries.status import StatusReader

    return StatusReader(Reader(world.store, "mill-7", world.clock), "0.1.0", Board({}, world.clock), lambda: [], "")


async def test_guesses_from_ever_new_addresses_do_not_keep_a_user_out(world: World) -> None:
    """He gets in by a browser he has used before, also from a new address after a restart, and at the computer itself."""
    world.people.add("ana", "operator", PHRASE)
    form = {"name": "ana", "password": PHRASE}
    app, _ = behind(world, Endpoint())
    async with client_of(app, client=("192.0.2.1", 1)) as client:
        first = await client.post("/login", data=form, headers=OWN)
        assert first.status_code == 303
    device = first.cookies["abbe-device-24d4b96f"]
    assert device not in str(world.store.audit.events())
    app, _ = behind(world, Endpoint())  # started again: nothing is remembered
    begin = world.people.passwords.hashes
    for n in range(300):
        async with client_of(app, client=(f"10.1.{n // 200}.{n % 200}", 1)) as client:
            await client.post("/login", data={"name": "ana", "password": f"guess number {n}"}, headers=OWN)
        world.clock.later(seconds=0.2)
    assert world.people.passwords.hashes - begin <= 10  # in a minute
    for address, cookies, status in (
        ("198.51.100.1", {}, 429),
        ("198.51.100.1", {"abbe-device-24d4b96f": device}, 303),
        ("10.1.0.1", {"abbe-device-24d4b96f": device}, 303),  # behind the same address as one who guesses
        ("127.0.0.1", {}, 303),
        ("198.51.100.2", {"abbe-device-24d4b96f": device[:-1] + ("0" if device[-1] != "0" else "1")}, 429),
        ("198.51.100.2", {"abbe-device-24d4b96f": "x" * 97}, 429),
    ):
        async with client_of(app, client=(address, 1)) as client:
            answer = await client.post("/login", data=form, headers=OWN | cookie(cookies))
            assert answer.status_code == status, (address, cookies)
    for n in range(9):  # a stolen device is a place to guess from like any other
        async with client_of(app, client=(f"10.9.0.{n}", 1)) as client:
            known = OWN | cookie({"abbe-device-24d4b96f": device})
            answer = await client.post("/login", data={"name": "ana", "password": "x"}, headers=known)
    assert answer.status_code == 429
    for n in range(8):  # whoever guesses for long is not let to make strangers wait for long
        world.clock.later(seconds=61)
        async with client_of(app, client=(f"10.10.0.{n}", 1)) as client:
            assert (await client.post("/login", data={"name": "ana", "password": "x"}, headers=OWN)).status_code == 401
    world.clock.later(seconds=61)
    async with client_of(app, client=("198.51.100.3", 1)) as client:
        assert (await client.post("/login", data=form, headers=OWN)).status_code == 303  # and a stranger waits a minute, not 15


async def test_a_known_browser_is_forgotten_with_the_password(world: World) -> None:
    world.people.add("ana", "operator", PHRASE)
    world.people.add("bob", "operator", PHRASE)
    device = world.people.new_device(world.people.get("ana"))
    assert world.people.device_of("ana", device)
    assert world.people.device_of("bob", device) == world.people.device_of("nobody", device) == ""
    world.people.set_password("ana", PHRASE + "!")
    assert world.people.device_of("ana", device) == ""


async def test_a_browser_stays_known_when_the_login_makes_a_new_hash(world: World) -> None:
    world.people.add("ana", "operator", PHRASE)
    world.people.passwords = Passwords(memory_kib=128, passes=1)
    ana = world.people.check("ana", PHRASE)
    assert ana is not None
    assert world.people.device_of("ana", world.people.new_device(ana)) != ""


async def test_a_known_browser_keeps_its_id_and_its_90_days_begin_anew_with_each_login_by_password(gate: Gate) -> None:
    people, clock = gate.world.people, gate.world.clock
    first = (await log_in(gate, "a-viewer", PHRASE)).cookies["abbe-device-677529ba"]
    clock.later(days=89)
    gate.client.cookies.set("abbe-device-677529ba", first, path="/login", domain="127.0.0.1")
    second = (await log_in(gate, "a-viewer", PHRASE)).cookies["abbe-device-677529ba"]
    assert people.device_of("a-viewer", second) == people.device_of("a-viewer", first) != ""
    clock.later(days=2)
    assert people.device_of("a-viewer", second) != ""
    assert people.device_of("a-viewer", first) == "", "the browser keeps a cookie as long as it likes"
    label, end_s, seal = first.split(".")
    assert people.device_of("a-viewer", f"{label}.{int(end_s) + 999_999}.{seal}") == ""
    gate.client.cookies.set("abbe-device-677529ba", second, path="/login", domain="127.0.0.1")
    people.set_pin("a-viewer", "582914")
    by_pin = await gate.ask("POST", "/login", data={"name": "a-viewer", "pin": "582914"}, headers=OWN)
    assert (by_pin.status_code, "abbe-device-677529ba" in by_pin.cookies) == (303, False)
    assert "abbe-device-a5c643bc" in (await log_in(gate, "a-operator", PHRASE)).cookies
