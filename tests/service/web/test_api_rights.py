"""Every route answers who may, the document against the routes, and payloads that mean something elsewhere."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterator
from urllib.parse import quote

import httpx
import pytest

from abbe.service.domain.people import ALLOWED, Role
from abbe.service.web.login.access import MUTATING, PUBLIC, Need, route_permissions
from abbe.service.web.problems import MEDIA_TYPE
from tests.service.web.api_bench import Plant, app_of, served

BASE = "http://127.0.0.1:8080"
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
PAYLOADS = (
    "../../../../etc/passwd", "..%2f..%2fetc%2fpasswd", "....//....//etc/passwd", "..\\..\\windows\\win.ini", "/etc/passwd", "file:///etc/passwd",
    "\\\\host\\share", "%00", "1%00", "a\0b", "'", "''", "' OR '1'='1", "1; DROP TABLE runs; --", "1' UNION SELECT password FROM users --",
    "\") OR (\"1\"=\"1", "1 OR SLEEP(5)", "${jndi:ldap://x/a}", "{{7*7}}", "<script>alert(1)</script>", "%3Cscript%3E",
    "\r\nSet-Cookie: a=b",
    "%0d%0aX-Evil:%201", "١٢٣", "½", "1e3", "0x1", "-1", "0", "2147483648", "9" * 400, "NaN", "Infinity", "null", "true", "🔥" * 50,
    "\u202e1",
    "é" * 500, "A" * 20_000, "%ff%fe", "%c0%ae%c0%ae/", "\ud7ff", "1,2", "[]", "{}", "=cmd|'/C calc'!A0", " 1 ", "+1",
)  # fmt: skip


def filled(path: str, number: str = "1") -> str:
    return path.replace("{number}", number).replace("{kind}", "run")


def table_of(plant: Plant) -> list[tuple[str, str, Need | None]]:
    return [cell for cell in route_permissions(plant.app.routes) if cell[1] not in {"/login", "/logout", "/static"}]


async def test_every_route_answers_who_may(plant: Plant) -> None:
    """The whole application, by session and by token: without content 404, without a body 422, and the auth first.

    Every role, and visitors without any right, at the auth: `tests/service/users/test_access.py`.
    """
    async with httpx.AsyncClient(transport=httpx.ASGITransport(plant.app, False), base_url=BASE) as client:
        sessions = {role: {**plant.session(role), "Origin": BASE} for role in Role}
        tokens = {role: plant.token(role) for role in Role}
        for number, (method, path, need) in enumerate(table_of(plant)):
            role = next(role for role in Role if need is PUBLIC or need in ALLOWED[role])
            headers = (sessions, tokens)[number % 2][role]
            answer = await client.request(method, filled(path, "999"), headers=headers)
            assert answer.status_code in ({422} if method in MUTATING else {200, 404, 409}), (role, method, path, answer.text)
            if need is not PUBLIC:
                assert (await client.request(method, filled(path, "999"), headers={"Origin": BASE})).status_code == 401, (method, path)


async def test_the_document_declares_every_route_and_every_status(plant: Plant) -> None:
    document = plant.app.openapi()
    routes = {(method, path): need for method, path, need in route_permissions(plant.app.routes)}
    api = {cell for cell in routes if cell[1].startswith("/api/v1") and cell[1] != "/api/v1/openapi.json"}
    declared = {(method.upper(), path) for path, methods in document["paths"].items() for method in methods}
    assert declared == api | {("GET", "/healthz"), ("GET", "/readyz")}
    assert not {"HTTPValidationError", "ValidationError"} & set(document["components"]["schemas"])
    for method, path in declared:
        operation = document["paths"][path][method.lower()]
        answers, need = operation["responses"], routes[method, path]
        wanted = {"400", "429", "500", "503"} | ({"401", "403"} if need is not PUBLIC else set())
        wanted |= {"422"} if operation.get("parameters") else set()
        wanted |= {"404"} if "{" in path else set()
        wanted |= {"409", "413"} if method in MUTATING else set()
        assert wanted <= set(answers), (method, path)
        assert all(MEDIA_TYPE in answer["content"] for status, answer in answers.items() if status >= "400"), (method, path)
        assert operation.get("security") == (None if need is PUBLIC else [{"token": []}, {"session": []}])
        assert operation.get("x-permission") == (None if need is PUBLIC else need.value)
        assert answers["200"]["content"], (method, path)
        for answer in answers["200"]["content"].values():
            assert answer["schema"] not in ({}, {"type": "object", "additionalProperties": True}), f"{path} answers anything"


async def test_without_users_and_without_audit_it_only_shows(plant: Plant) -> None:
    app = app_of(plant.store, plant.clock, None)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url=BASE) as client:
        assert (await client.get("/api/v1/runs")).status_code == 200
        answer = await client.post("/api/v1/proposals/2/approve", json={}, headers={"Idempotency-Key": "k", "Origin": BASE})
        assert answer.status_code == 401


@pytest.fixture(scope="module")
def address(plant: Plant) -> Iterator[str]:
    with served(plant.app) as url:
        yield url


def content(plant: Plant) -> str:
    """Digest of everything that is kept, but for the audit and for when somebody was last seen."""
    import sqlite3

    with sqlite3.connect(plant.url.removeprefix("sqlite:///")) as connection:
        tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        kept = [t for t in tables if t not in {"audit", "sessions", "api_tokens"}]
        assert {"runs", "users", "approvals", "rejections"} <= set(kept)
        rows = [(t, connection.execute(f"SELECT * FROM {t} ORDER BY 1").fetchall()) for t in kept]
    connection.close()
    return hashlib.sha256(repr(rows).encode()).hexdigest()


def test_payloads_have_no_effect(plant: Plant, address: str) -> None:
    """Payloads in every parameter of every route: each of them with ABBE_TEST_LONG=1, else a sixth in turn. Counted."""
    before, sent = content(plant), Counter[int]()
    headers = plant.token("approver")
    document, number = plant.app.openapi(), 0
    with httpx.Client(base_url=address, headers=headers, timeout=30) as client:
        for path, methods in document["paths"].items():
            for method, operation in methods.items():
                for parameter in operation.get("parameters", []):
                    number += 1
                    for payload in PAYLOADS if LONG else PAYLOADS[number % 6 :: 6]:
                        where, name = parameter["in"], parameter["name"]
                        target = filled(path.replace(f"{{{name}}}", quote(payload, safe="%") if where == "path" else f"{{{name}}}"))
                        if where == "header":
                            given = {name: payload.encode().replace(b"\r\n", b"").replace(b"\0", b"").strip()}
                            answer = client.request(method, target, headers=given, json={"hours": "x"})
                        else:
                            query = {name: payload} if where == "query" else {}
                            more = {"json": {"hours": "x"}, "headers": {"Idempotency-Key": "p"}} if method == "post" else {}
                            answer = client.request(method, target, params=query, **more)
                        sent[answer.status_code] += 1
                        assert answer.status_code < 500, (method, target, name, payload[:50], answer.text)
                        assert "root:" not in answer.text
                        assert "x-evil" not in answer.headers
                        if answer.status_code >= 400 and "json" in answer.headers["content-type"]:
                            assert re.fullmatch(r"[A-Z]{3}-\d{3}", answer.json()["code"])
                            assert len(answer.text) < 3000
    assert content(plant) == before
    assert set(sent) <= {200, 303, 307, 400, 404, 405, 409, 413, 422}, sent
    assert sum(sent.values()) >= (50 if LONG else 8) * len(PAYLOADS), sent
