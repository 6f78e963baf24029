"""The screens of the alarms by HTTP: the line on every screen, acknowledging with a comment, shelving for a time, and who may."""

from __future__ import annotations

import re

import httpx
import pytest

from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.queries.status import AlarmSummary, alarms
from tests.pages_world import USERS, Served, as_user


def newest(running: Served) -> AlarmSummary:
    return alarms(running.store, running.filled.machine, every=True)[0]


def raised(running: Served) -> int:
    """A new alarm beside those of the world; its number."""
    machine = running.filled.machine
    first = next(e for e in running.store.alarms.entries(machine) if e.kind == "raised")
    return running.store.alarms.append(machine, None, 0, first.kind, first.facts).alarm


def line_of(page: str) -> str:
    found = re.search(r'<p class="line (.*?)</p>', page, re.DOTALL)
    return "" if found is None else re.sub(r"<[^>]*>", " ", found[1])


def test_the_most_urgent_unseen_alarm_stands_on_every_screen(running: Served) -> None:
    with as_user(running, "olga") as client:
        for path in ("/", "/runs", "/new", "/alarms"):
            line = line_of(client.get(path).text)
            assert line.startswith('bad"'), path
            assert "active" in line
            assert "is above its limit of 20 µm" in line
    with as_user(running, "olga", **{"Accept-Language": "de"}) as german:
        assert "liegt über der Grenze von 20 µm" in line_of(german.get("/runs").text)


def test_seen_with_a_comment_and_refused_a_second_time(running: Served) -> None:
    number = raised(running)
    with as_user(running, "olga") as client:
        answer = client.post("/alarm/acknowledge", data={"number": str(number), "comment": "spindle warmed up"})
        assert (answer.status_code, answer.headers["location"]) == (303, f"/alarm?id={number}")
        one = newest(running)
        assert (one.state, one.acknowledged_by, one.comment) == ("acknowledged", "olga", "spindle warmed up")
        page = client.get(f"/alarm?id={number}").text
        assert "spindle warmed up" in page
        assert "active, acknowledged" in page
        again = client.post("/alarm/acknowledge", data={"number": str(number)})
        assert (again.status_code, again.json()["code"]) == (409, "ALM-010")
    record = running.store.audit.events(1)[0]
    assert (record.who, record.action, record.target) == ("user:olga", "POST /alarm/acknowledge", f"alarm {number}")


def test_shelved_for_a_time_with_a_reason_and_taken_back(running: Served) -> None:
    number = raised(running)

    def shelve(client: httpx.Client, **form: str) -> httpx.Response:
        return client.post("/alarm/shelve", data={"number": str(number)} | form)

    with as_user(running, "olga") as client:
        for wrong in ({"hours": "8"}, {"hours": "200", "reason": "long"}, {"hours": "-1", "reason": "back"}):
            assert shelve(client, **wrong).status_code == 409, wrong
        for wrong in ({"reason": "no hours"}, {"hours": "nan", "reason": "x"}, {"hours": "inf", "reason": "x"}):
            assert shelve(client, **wrong).status_code == 422, wrong
        before = re.search(r"(\d+) alarms", client.get("/runs").text)
        assert shelve(client, hours="8", reason="guide is being scraped").status_code == 303
        after = re.search(r"(\d+) alarms", client.get("/runs").text)
        assert before is not None
        assert after is not None
        assert int(after[1]) == int(before[1]) - 1, "a shelved alarm asks for nothing"
        page = client.get(f"/alarm?id={number}").text
        assert "shelved until" in page
        assert "guide is being scraped" in page
        assert newest(running).is_shelved(running.store.utcnow())
        assert shelve(client, hours="0").status_code == 303
        assert not newest(running).is_shelved(running.store.utcnow())


@pytest.mark.parametrize("name", USERS)
def test_who_may(running: Served, name: str) -> None:
    may = Permission.ACKNOWLEDGE in ALLOWED[Role(USERS[name])]
    number = raised(running)
    with as_user(running, name) as client:
        assert client.post("/alarm/acknowledge", data={"number": str(number)}).status_code == (303 if may else 403)
        assert client.post("/alarm/shelve", data={"number": "999", "hours": "1", "reason": "r"}).status_code == (404 if may else 403)
        assert ('action="/alarm/shelve"' in client.get(f"/alarm?id={number}").text) == may


def test_what_is_over_and_seen_is_history(running: Served) -> None:
    with as_user(running, "anna") as client:
        assert "over, not acknowledged" in client.get("/alarm?id=1").text
        assert client.post("/alarm/acknowledge", data={"number": "1", "comment": "repaired"}).status_code == 303
        over = client.get("/alarms").text.partition('id="h-over"')[2]
        assert 'href="/alarm?id=1"' in over
        assert "repaired" in over
        assert client.get("/alarm?id=999").status_code == 404
