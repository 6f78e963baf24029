"""How long a body may be at which route, for whom it is read at all, and that nothing is done for one that is too long."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator

import pytest

from abbe.service.web.bodies import LONGEST_B
from abbe.service.web.login.access import MUTATING, route_permissions
from abbe.service.web.problems import MEDIA_TYPE
from tests.service.web.api_bench import Plant
from tests.service.web.test_table_orders import BODY, PATH, Desk, desk
from tests.system.test_serve_bodies import BY_FORM

__all__ = ["desk"]  # the fixture

ROLLBACK_B = 4096


async def pieces(size_b: int, each_b: int = 1000) -> AsyncIterator[bytes]:
    """A body of unknown length, as the client's library sends it: in chunks."""
    for at in range(0, size_b, each_b):
        yield b" " * min(each_b, size_b - at)


def changing(desk: Desk) -> list[tuple[str, str]]:
    return [(method, path) for method, path, _ in route_permissions(desk.app.routes) if method in MUTATING]


async def test_every_route_that_changes_something_has_a_limit(desk: Desk, plant: Plant) -> None:
    table = changing(desk)
    document = desk.app.openapi()
    declared = {path for path, methods in document["paths"].items() if "post" in methods}
    assert {path for _, path in table} == declared | set(BY_FORM)
    assert {method for method, _ in table} == {"POST"}
    for path in declared:
        assert list(document["paths"][path]["post"]["responses"]["413"]["content"]) == [MEDIA_TYPE]
    asked, everybody = len(desk.asked), [plant.token("viewer"), plant.token("admin"), plant.session("approver")]
    for _, path in table:
        target = path.replace("{job}", "0123456789ab").replace("{prompt}", "1").replace("{number}", "1")
        for who in everybody:
            for sent in (b" " * (LONGEST_B + 1), pieces(LONGEST_B + 1)):
                answer = await desk.client.post(target, headers=who, content=sent)
                assert (answer.status_code, answer.json()["code"]) == (413, "WEB-413"), (path, who)
                assert answer.headers["content-type"] == MEDIA_TYPE
    assert len(desk.asked) == asked, "nothing has reached the core"


async def test_nothing_of_a_body_is_read_for_somebody_unknown(desk: Desk) -> None:
    async def never() -> AsyncIterator[bytes]:
        raise AssertionError("it was read")
        yield b""

    for _, path in changing(desk):
        if path != "/login":
            assert (await desk.client.post(path, content=never())).status_code == 401


async def test_what_fits_arrives_whole_however_it_is_cut(desk: Desk, plant: Plant) -> None:
    body = json.dumps(BODY).encode()

    async def cut(size_b: int) -> AsyncIterator[bytes]:
        yield body[:10]
        yield body[10:-1]
        async for piece in pieces(size_b - len(body)):
            yield piece
        yield body[-1:]

    headers = {**plant.token("approver"), "Content-Type": "application/json", "Idempotency-Key": "cut"}
    asked = len(desk.asked)
    assert (await desk.client.post(PATH, content=cut(ROLLBACK_B), headers=headers)).status_code == 202
    assert (desk.asked[asked].push, desk.asked[asked].reason) == (BODY["push"], BODY["reason"])  # type: ignore[union-attr]
    assert (await desk.client.post(PATH, content=cut(ROLLBACK_B + 1), headers=headers)).status_code == 413
    assert len(desk.asked) == asked + 1


@pytest.mark.parametrize("size_b", [ROLLBACK_B + 1, LONGEST_B])
async def test_a_route_may_have_a_limit_of_its_own(desk: Desk, plant: Plant, size_b: int) -> None:
    for path in (PATH, "/login"):
        for sent in (b" " * size_b, pieces(size_b)):
            answer = await desk.client.post(path, content=sent, headers=plant.token("approver"))
            assert answer.status_code == 413
            assert f"{ROLLBACK_B} bytes" in answer.json()["detail"]
