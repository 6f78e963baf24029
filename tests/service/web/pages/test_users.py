"""Users on the page by HTTP: an admin adds and changes them, each person has an own password and PIN, and the audit says so."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from tests.pages_world import PHRASE, USERS, Served, as_user, filled_once, served

NEW = "a quiet hall in autumn"
FORMS = ("add", "role", "password", "disable", "enable")


@pytest.fixture
def alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A page of its own: these tests change who may log in."""
    with served(filled_once(tmp_path_factory)) as one:
        yield one


def log_in(running: Served, client: httpx.Client, name: str, **secret: str) -> int:
    return client.post("/login", data={"name": name} | secret, headers={"Origin": running.base}).status_code


@pytest.mark.parametrize("name", USERS)
def test_only_an_admin_sees_and_changes_users(running: Served, name: str) -> None:
    admin = USERS[name] == "admin"
    with as_user(running, name) as client:
        assert client.get("/users").status_code == (200 if admin else 403)
        assert client.get("/user?name=olga").status_code == (200 if admin else 403)
        assert ('href="/users"' in client.get("/settings").text) == admin
        for form in FORMS:
            if not admin:
                assert client.post(f"/users/{form}", data={"name": "olga", "role": "admin"}).status_code == 403, form
    assert running.store.people.find("olga").role == "operator"  # type: ignore[union-attr]


def test_a_user_is_added_once_changed_reset_and_disabled(alone: Served) -> None:
    form = {"name": "nora", "role": "operator", "new": NEW, "again": NEW}
    with as_user(alone, "adam") as client:
        assert "nora" not in client.get("/users").text
        assert client.post("/users/add", data=form | {"again": "another"}).status_code == 409
        assert client.post("/users/add", data=form | {"new": "short", "again": "short"}).json()["code"] == "USR-001"
        assert client.post("/users/add", data=form | {"role": "queen"}).json()["code"] == "USR-002"
        assert client.post("/users/add", data=form).status_code == 303
        assert client.post("/users/add", data=form).status_code == 409, "sent twice, added once"
        assert "nora" in client.get("/users").text
        with httpx.Client(base_url=alone.base) as person:
            assert log_in(alone, person, "nora", password=NEW) == 303
            assert client.post("/users/role", data={"name": "nora", "role": "viewer"}).status_code == 303
            assert person.get("/api/v1/session").status_code == 401, "a new role ends the login"
        assert client.post("/users/password", data={"name": "nora", "new": PHRASE, "again": PHRASE}).status_code == 303
        with httpx.Client(base_url=alone.base) as person:
            assert (log_in(alone, person, "nora", password=NEW), log_in(alone, person, "nora", password=PHRASE)) == (401, 303)
            assert client.post("/users/disable", data={"name": "nora"}).status_code == 303
            assert (person.get("/api/v1/session").status_code, log_in(alone, person, "nora", password=PHRASE)) == (401, 401)
            assert client.post("/users/enable", data={"name": "nora"}).status_code == 303
            assert log_in(alone, person, "nora", password=PHRASE) == 303
        assert client.get("/user?name=nobody").status_code == 404
    told = [(r.action, r.target, r.outcome) for r in alone.store.audit.events() if r.who == "user:adam" and r.outcome.startswith("done")]
    assert told == [
        ("POST /users/add", "user nora: add operator", "done 303"),
        ("POST /users/role", "user nora: role viewer", "done 303"),
        ("POST /users/password", "user nora: password", "done 303"),
        ("POST /users/disable", "user nora: disable", "done 303"),
        ("POST /users/enable", "user nora: enable", "done 303"),
    ]
    assert NEW not in str(alone.store.audit.events())


def test_the_last_admin_stays_and_no_refusal_names_a_command(alone: Served) -> None:
    with as_user(alone, "adam") as client:
        for answer in (
            client.post("/users/disable", data={"name": "adam"}),
            client.post("/users/role", data={"name": "adam", "role": "viewer"}),
            client.post("/users/role", data={"name": "nobody", "role": "viewer"}),
        ):
            assert answer.status_code == 409
            assert "abbe user" not in answer.text


def test_a_name_added_twice_at_once_is_added_and_refused(alone: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have looked for the name when either writes: the second is no fault of the store."""
    barrier, work = threading.Barrier(2, timeout=10), alone.store.people.add

    def met(name: str, role: str, password: str) -> int:
        barrier.wait()
        return work(name, role, password)

    monkeypatch.setattr(alone.store.people, "add", met)
    form = {"name": "nora", "role": "operator", "new": NEW, "again": NEW}
    with as_user(alone, "adam") as client, ThreadPoolExecutor(2) as pool:
        answers = pool.map(lambda _: client.post("/users/add", data=form).status_code, range(2))
        assert sorted(answers) == [303, 409]


def test_an_admin_changes_the_own_password_in_the_settings_only(alone: Served) -> None:
    with as_user(alone, "adam") as client:
        answer = client.post("/users/password", data={"name": "adam", "new": NEW, "again": NEW})
        assert (answer.status_code, answer.json()["detail"]) == (409, "your own password can only be changed in the settings")
    token = alone.people.add_token("adam", "ci", ["users"], 1)
    with httpx.Client(base_url=alone.base, headers={"Authorization": f"Bearer {token}"}) as program:
        assert program.post("/users/password", data={"name": "adam", "new": NEW, "again": NEW}).status_code == 409
    assert alone.people.check("adam", PHRASE) is not None


def test_an_own_password_needs_the_present_one_and_ends_every_login(alone: Served) -> None:
    form = {"new": NEW, "again": NEW}
    with as_user(alone, "olga") as client, as_user(alone, "olga") as elsewhere:
        assert client.post("/settings/password", data=form | {"password": "wrong"}).status_code == 403
        assert client.post("/settings/password", data=form | {"password": PHRASE, "again": "x"}).status_code == 409
        assert elsewhere.get("/api/v1/session").status_code == 200
        answer = client.post("/settings/password", data=form | {"password": PHRASE})
        assert (answer.status_code, answer.headers["location"]) == (303, "/login")
        assert elsewhere.get("/api/v1/session").status_code == 401
    with httpx.Client(base_url=alone.base) as person:
        assert (log_in(alone, person, "olga", password=PHRASE), log_in(alone, person, "olga", password=NEW)) == (401, 303)


def test_a_pin_logs_in_where_the_password_did_before_and_nowhere_else(alone: Served) -> None:
    with httpx.Client(base_url=alone.base) as panel, httpx.Client(base_url=alone.base) as strange:
        assert log_in(alone, panel, "olga", password=PHRASE) == 303
        with as_user(alone, "olga") as client:
            for pin in ("12345", "123456", "987654", "111111", "112211", "abcdef", "1234567890123"):
                assert client.post("/settings/pin", data={"password": PHRASE, "pin": pin}).status_code == 409, pin
            assert client.post("/settings/pin", data={"password": "wrong", "pin": "582914"}).status_code == 403
            assert client.post("/settings/pin", data={"password": PHRASE, "pin": "582914"}).status_code == 303
        assert 'value="olga"' in panel.get("/login").text
        assert "olga" not in strange.get("/login").text
        assert log_in(alone, panel, "olga", pin="582915") == 401
        assert log_in(alone, panel, "olga", pin="582914") == 303
        assert log_in(alone, strange, "olga", pin="582914") == 401
        assert log_in(alone, panel, "vera", pin="582914") == 401
        for _ in range(5):
            log_in(alone, panel, "olga", pin="000000")
        assert log_in(alone, panel, "olga", pin="582914") == 429, "a PIN waits as a password does"
        assert log_in(alone, panel, "olga", password=PHRASE) == 303, "the password does not wait for PINs"
    told = [r.outcome for r in alone.store.audit.events() if r.target == "olga, by PIN"]
    assert told == ["refused 401", "done 303"] + ["refused 401"] * 5


def test_ten_wrong_pins_remove_the_pin_and_the_audit_says_so(alone: Served) -> None:
    alone.people.set_pin("olga", "582914")
    alone.auth.recorded_refusals._burst = 0.0  # a flood of refusals: only what was done is recorded
    with httpx.Client(base_url=alone.base) as panel:
        assert log_in(alone, panel, "olga", password=PHRASE) == 303
        for _ in range(10):
            alone.auth.lockout._counts.clear()  # as an hour later
            answer = panel.post("/login", data={"name": "olga", "pin": "000000"}, headers={"Origin": alone.base})
            assert answer.status_code == 401
        assert "it was removed after 10 wrong ones" in answer.text
        assert 'value="olga"' not in answer.text
        assert log_in(alone, panel, "olga", pin="582914") == 401
        assert log_in(alone, panel, "olga", password=PHRASE) == 303
    told = [(r.action, r.outcome) for r in alone.store.audit.events() if r.target == "user olga: PIN removed after 10 wrong ones"]
    assert told == [("POST /login", "done")]


def test_who_proposes_approves_or_manages_has_no_pin_and_a_new_password_removes_it(alone: Served) -> None:
    for name, role in USERS.items():
        with as_user(alone, name) as client:
            answer = client.post("/settings/pin", data={"password": PHRASE, "pin": "582914"})
            assert answer.status_code == (303 if role in {"viewer", "operator"} else 409), role
    with as_user(alone, "adam") as client:
        client.post("/users/role", data={"name": "vera", "role": "approver"})
        client.post("/users/password", data={"name": "olga", "new": NEW, "again": NEW})
    assert alone.people.with_pin() == []
