"""The screens over a real store by HTTP: who may see and approve what, how heavy they are, and what is not there."""

from __future__ import annotations

import re

import httpx
import pytest

from abbe.service.clock import SystemClock
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.users.lockout import LoginOrigin
from abbe.service.web.app import create_app
from abbe.service.web.login.access import route_permissions
from abbe.service.web.login.auth_middleware import CSRF_HEADER
from tests.pages_world import PHRASE, PROPOSER, USERS, Filled, Served, as_user, screens

PART = re.compile(r'<(?:script|link rel="stylesheet")[^>]* (?:src|href)="([^"]+)"')
HEAVIEST = 150_000
SVG = re.compile(r"<svg.*?</svg>", re.DOTALL)
SIGNED = {"clear": "yes", "password": PHRASE}


@pytest.fixture
def filled(running: Served) -> Filled:
    return running.filled


def addresses(running: Served) -> list[str]:
    return [*screens(running.filled), "/run", "/result", "/volume", "/whatif", "/budget", "/discovery", "/proposal", "/plots.css"]


@pytest.fixture(scope="module")
def answers(running: Served) -> dict[str, httpx.Response]:
    """Every screen as an approver gets it, who sees more of it than anybody else."""
    with as_user(running, "anna") as client:
        found = {path: client.get(path) for path in addresses(running)}
    assert {path: one.status_code for path, one in found.items() if one.status_code != 200} == {}
    return found


@pytest.fixture(scope="module")
def pages(answers: dict[str, httpx.Response]) -> dict[str, str]:
    return {path: one.text for path, one in answers.items()}


def test_every_screen_is_light_with_its_scripts_and_styles(running: Served, answers: dict[str, httpx.Response]) -> None:
    """As they come over the wire. A store of a year is weighed in a browser by `tests/system/test_weights.py`, in the long run."""
    parts = {path: set(PART.findall(one.text)) for path, one in answers.items()}
    with as_user(running, "anna") as client:
        own = {path: client.get(path).num_bytes_downloaded for path in set().union(*parts.values())}
    found = {path: one.num_bytes_downloaded + sum(own[part] for part in parts[path]) for path, one in answers.items()}
    assert min(own.values()) > 0
    assert {path: size for path, size in found.items() if not 1_000 < size <= HEAVIEST} == {}


@pytest.mark.parametrize("name", USERS)
def test_every_role_sees_the_screens_that_it_may(running: Served, name: str) -> None:
    """The right to each route is asked of everybody in `tests/service/users/test_access.py`; here the bar leads nowhere else."""
    allowed = ALLOWED[Role(USERS[name])]
    with as_user(running, name) as client:
        links = set(re.findall(r'<a href="(/[a-z]*)"', client.get("/runs").text))
        for path in links:
            assert client.get(path).status_code == 200, path
        assert client.get("/audit").status_code == (200 if Permission.AUDIT in allowed else 403)
    assert ("/audit" in links) == (Permission.AUDIT in allowed)


def test_every_screen_has_one_place_in_the_bar(running: Served, pages: dict[str, str]) -> None:
    with as_user(running, "adam") as client:
        own = {path: client.get(path).text for path in ("/live", "/diagnostics")}
    for path, page in (pages | own).items():
        if path != "/plots.css":
            assert page.partition("</nav>")[0].count('aria-current="page"') == 1, path


def test_nobody_sees_a_screen_without_logging_in(running: Served) -> None:
    with httpx.Client(base_url=running.base, timeout=60) as client:
        for path in addresses(running):
            assert client.get(path).status_code == 401, path
            assert client.get(path, headers={"Accept": "text/html"}).headers["location"] == "/login"


@pytest.mark.parametrize("name", USERS)
def test_who_may_approve(running: Served, filled: Filled, name: str) -> None:
    may = Permission.APPROVE in ALLOWED[Role(USERS[name])]
    form = {"number": str(filled.proposals[2]), "hours": "1"} | SIGNED
    before = len(running.store.proposals.approvals(filled.proposals[2]))
    with as_user(running, name) as client:
        answer = client.post("/proposal/approve", data=form)
        assert answer.status_code == (303 if may else 403)
        for wrong in ({CSRF_HEADER: "0" * 64}, {"Origin": "http://evil.example"}):
            assert client.post("/proposal/approve", data=form, headers=wrong).status_code == 403
    told = running.store.proposals.approvals(filled.proposals[2])
    assert len(told) == before + may
    if may:
        to = f"/proposal?id={filled.proposals[2]}&push=ask"
        assert (told[-1].name, told[-1].login, answer.headers["location"]) == (name, f"user:{name}", to)


@pytest.mark.parametrize(
    ("form", "status"),
    [
        ({}, 422),
        ({"number": "x", "hours": "1"}, 422),
        ({"number": "1", "hours": "nan"}, 422),
        ({"number": "1", "hours": "0"}, 422),
        ({"number": "1", "hours": "721"}, 422),
        ({"number": "-1", "hours": "1"}, 422),
        ({"number": "99", "hours": "1"}, 404),
        ({"number": "1", "hours": "1"}, 409),  # it has reasons against it
        ({"number": "1", "hours": "1", "more": "x" * 5000}, 413),
        ({str(k): "x" for k in range(20)}, 422),
    ],
)
def test_what_cannot_be_approved_says_why(running: Served, form: dict[str, str], status: int) -> None:
    with as_user(running, "anna") as client:
        answer = client.post("/proposal/approve", data=SIGNED | form)
    assert answer.status_code == status
    assert answer.json()["detail"]
    assert running.store.proposals.approvals(1) == []


def test_an_approval_is_a_signature(running: Served, filled: Filled) -> None:
    """The person who is logged in signs with the password, and says that the space is clear; neither is taken for granted."""
    number, before = filled.proposals[2], len(running.store.proposals.approvals(filled.proposals[2]))
    form = {"number": str(number), "hours": "1"}
    with as_user(running, "anna") as client:
        assert client.post("/proposal/approve", data=form | {"password": PHRASE}).status_code == 422
        answer = client.post("/proposal/approve", data=form | {"clear": "yes", "password": "not hers"})
        assert (answer.status_code, "nothing was signed" in answer.json()["detail"]) == (403, True)
        assert len(running.store.proposals.approvals(number)) == before
    running.auth.lockout.succeeded("anna", LoginOrigin("127.0.0.1", "", local=True))


def test_the_proposer_cannot_be_the_second_person(running: Served, filled: Filled) -> None:
    """By the rule of the command line; here he has even got the role of an approver since."""
    running.people.set_role(PROPOSER, "approver")
    try:
        with as_user(running, PROPOSER) as client:
            answer = client.post("/proposal/approve", data={"number": str(filled.proposals[2]), "hours": "1"} | SIGNED)
    finally:
        running.people.set_role(PROPOSER, "metrologist")
    assert answer.status_code == 409
    assert "second person" in answer.json()["detail"]
    assert all(a.name != PROPOSER for a in running.store.proposals.approvals(filled.proposals[2]))


@pytest.mark.parametrize(
    "path", ["/run?id=999", "/result?id=999", "/volume?id=999", "/whatif?id=999", "/budget?id=999", "/discovery?id=999", "/proposal?id=999"]
)
def test_what_is_not_there_is_told_on_a_screen(running: Served, path: str) -> None:
    with as_user(running, "vera") as client:
        answer = client.get(path)
        assert (answer.status_code, "999" in answer.text, "<nav" in answer.text) == (404, True, True)
        assert client.get(path.replace("999", "x")).status_code == 422
        assert client.get(path.replace("999", "0")).status_code == 422


def test_runs_are_filtered(running: Served) -> None:
    with as_user(running, "vera") as client:

        def labels(query: str) -> list[str]:
            return re.findall(r'data-run="\d+"><th scope="row"><a href="[^"]*">([^<]*)<', client.get(f"/runs{query}").text)

        everything = labels("")
        assert len(everything) == 17 + 1 + 4
        assert labels("?test=laser_linear") == ["lineZ0", "lineY0", "lineX0"]
        assert labels("?state=stopped") == ["late"]
        assert set(labels("?campaign=c1")) == {"r01", "r02", "r03", "r04"}
        assert labels("?campaign=nothing") == []


def test_the_result_names_all_21_motions_and_those_that_do_not_show(running: Served, filled: Filled) -> None:
    with as_user(running, "vera") as client:
        page = client.get(f"/result?id={filled.solution}").text
        (report,) = re.findall(r'href="(/api/v1/reports/campaign/\d+)"', page)
        assert client.get(report).content.startswith(b"%PDF")
    motions = re.findall(r'data-motion="(\w+)"', page)
    assert len(set(motions)) == len(motions) == 21
    doc = running.store.solutions.get(filled.solution).doc
    hidden = [name for name, told in doc["motions"].items() if told["status"] == "not observable"]
    assert page.count("not observable</td>") == len(hidden) > 3
    named = re.search(r"Not shown by themselves: ([^.]*)\.", page)
    assert named is not None
    assert set(named.group(1).split(", ")) == set(hidden)
    picture = SVG.findall(page)[0]
    assert not any(f">{name}<" in picture for name in hidden)


def test_a_changed_proposal_is_shown_as_changed(running: Served) -> None:
    doc = running.store.proposals.get(running.filled.proposals[0]).doc
    number = running.store.proposals.add(running.filled.machine, running.filled.solution, doc | {"by": "somebody"}, "0" * 64)
    with as_user(running, "anna") as client:
        answer = client.get(f"/proposal?id={number}")
        assert (answer.status_code, "changed after it was stored" in answer.text) == (409, True)
        assert client.get("/proposals").status_code == 200
        assert client.post("/proposal/approve", data={"number": str(number), "hours": "1"} | SIGNED).status_code == 503


def test_screens_hold_no_inline_code(running: Served, pages: dict[str, str]) -> None:
    for path in screens(running.filled):
        page = pages[path]
        assert " style=" not in page, path
        assert "<style" not in page, path
        assert re.findall(r"\son\w+=", page) == [], path
        assert re.findall(r"<script(?![^>]* src=\"/static/)", page) == [], path
        assert set(re.findall(r"https?://[^\"\s<]+", page)) <= {"http://www.w3.org/2000/svg"}, path


def test_a_language_is_kept_by_a_cookie(running: Served) -> None:
    with as_user(running, "vera", **{"Accept-Language": "ja"}) as client:
        assert '<html lang="ja"' in client.get("/runs").text
        answer = client.get("/runs?campaign=june&lang=de")
        assert '<html lang="de"' in answer.text
        assert "lang=ko" in client.get("/login").text
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith("abbe_lang=de;")
        assert "HttpOnly" in cookie
        evil = client.get("/runs?lang=%22%3E%3Cscript%3E")
        assert '<html lang="ja"' in evil.text
        assert "set-cookie" not in evil.headers


def test_every_address_says_what_it_needs(running: Served) -> None:
    view = StatusReader(Reader(running.store, "m", SystemClock()), "0", running.board, list, "")
    app = create_app(view, version="0", auth=running.auth)
    own = {path: need for _, path, need in route_permissions(app.routes)}
    assert all(need is not None for need in own.values())
    assert own["/run"] is Permission.READ
    assert own["/audit"] is Permission.AUDIT
    assert own["/proposal/approve"] is Permission.APPROVE
