"""The page and its JSON over a real store: read only, guarded headers, problems as problems, nothing from elsewhere."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import httpx
import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.core.board import Board
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import Verification
from abbe.service.errors import StoreError
from abbe.service.queries.reader import Reader, read_as
from abbe.service.queries.status import StatusReader
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from abbe.service.web import formatting
from abbe.service.web.app import create_app
from abbe.service.web.document import HEADERS
from abbe.service.web.page import figure_verdict
from abbe.service.web.trend import MANY, Point, trend_svg
from tests.service.core.fakes import STEP, FakeClock, Result, utc

NOW = utc(2026, 11, 21, 9)
WEEKLY = Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "verify")
DEVICES = {"ballbar": "serial:///dev/serial/by-id/usb-bar", "laser": "modbus://127.0.0.1:5021"}
EVIL = '<script>alert("x")</script>'


class Site:
    def __init__(self, store: Store) -> None:
        self.store = store
        self.clock = FakeClock(NOW)
        self.board = Board(DEVICES, self.clock)
        self.due: list[tuple[Schedule, datetime]] = [(WEEKLY, utc(2026, 11, 23, 5))]
        view = StatusReader(Reader(store, "mill-7", self.clock), "0.1.0", self.board, lambda: self.due, "mqtt://127.0.0.1:1883")
        self.client = httpx.AsyncClient(
            transport=httpx.ASGITransport(create_app(view, version="0.1.0"), False), base_url="http://127.0.0.1:8080"
        )

    def keep(self, result: Result | Exception, days_ago: float = 0) -> None:
        at = NOW - timedelta(days=days_ago)
        occasion = verify.Occasion("mill-7", WEEKLY, at)
        if isinstance(result, Exception):
            doc = verify.failed_doc(occasion, result, at, 1.0)
        else:
            doc = {**verify.check_doc(occasion, result), "started_utc": at.isoformat()}
        self.store.verifications.add_with_messages(self.store.machines.add("mill-7", {}), doc, [])


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


@pytest.fixture
async def site(store: Store) -> AsyncIterator[Site]:
    made = Site(store)
    async with made.client:
        yield made


async def test_status_of_a_fresh_service(site: Site) -> None:
    status = (await site.client.get("/api/v1/status")).json()
    assert status["machine"] == "mill-7"
    assert status["job"] is None
    assert [device["state"] for device in status["devices"]] == ["not used yet"] * 2
    assert status["next_due"][0]["due_text"] == "Monday 23 November 06:00, in 2 days"
    assert status["mqtt"] == {"configured": True, "broker": "mqtt://127.0.0.1:1883", "connected": False, "waiting": 0, "dropped": 0}
    assert status["last"] == []


async def test_a_running_check_and_a_device_that_fails(site: Site) -> None:
    revision = (await site.client.get("/api/v1/status")).json()["revision"]
    site.board.job_started(WEEKLY, NOW)
    site.board.job_progress(STEP)
    status = (await site.client.get("/api/v1/status")).json()
    assert status["revision"] != revision
    assert (status["job"]["stage"], status["job"]["done"], status["job"]["eta_s"]) == ("helix", 3, 42)
    assert status["devices"][0]["state"] == "in use"
    page = (await site.client.get("/")).text
    assert "measuring" in page
    assert "revision 3 of 10" not in page
    assert "revolution 3 of 10" in page
    site.board.job_ended(verify.failed_doc(verify.Occasion("m", WEEKLY, NOW), LinkDown(DEVICES["laser"], "read", "gone"), NOW, 1))
    status = (await site.client.get("/api/v1/status")).json()
    assert [device["state"] for device in status["devices"]] == ["not used yet", "fault"]
    assert status["job"] is None


async def test_dropped_alarms_are_shown(site: Site) -> None:
    assert "dropped" not in (await site.client.get("/")).text
    site.board.messages_dropped(1000)
    site.board.messages_dropped(7)
    assert "old alarms dropped: 1007" in (await site.client.get("/")).text
    assert (await site.client.get("/api/v1/status")).json()["mqtt"]["dropped"] == 1007


async def test_verifications_newest_first(site: Site) -> None:
    site.keep(Result(), days_ago=7)
    site.keep(Result(verdict="fail", text="Body diagonal is out."))
    answer = (await site.client.get("/api/v1/verifications?limit=1")).json()["verifications"]
    assert [check["verdict"] for check in answer] == ["fail"]
    assert len((await site.client.get("/api/v1/verifications")).json()["verifications"]) == 2


async def test_the_page_shows_verdicts_figures_and_trend(site: Site) -> None:
    site.keep(Result(), days_ago=14)
    site.keep(LinkDown(DEVICES["laser"], "connect", "refused", "is the laser on?"), days_ago=7)
    site.keep(Result(verdict="fail", values={"body_diagonal_um": 23.4, "helix_rms_um": 2.1}))
    page = (await site.client.get("/")).text
    for piece in ("✖</span> fail", "◐</span> cannot tell", "✔</span> pass", "23.4", "± 1.1", "Body diagonal [µm]", "µm", "DRV-002"):
        assert piece in page, piece
    assert page.count("<svg") == 2
    assert page.count("data-id=") == 3


async def test_empty_states_say_what_to_do(site: Site) -> None:
    site.due = []
    site.board.devices = []
    page = (await site.client.get("/")).text
    assert "abbe " not in page  # no text of the page tells an operator to type a command
    assert "[[schedule]]" in page
    assert "[devices]" in page


async def test_names_from_outside_stay_text(site: Site) -> None:
    site.keep(LinkDown(EVIL, EVIL, EVIL, EVIL))
    site.keep(Result(text=EVIL, campaign=EVIL, values={EVIL: 1.0}))
    page = (await site.client.get("/")).text
    assert "alert(" in page
    assert EVIL not in page


@pytest.mark.parametrize(
    "path", ["/", "/api/v1/status", "/healthz", "/readyz", "/static/page.css", "/static/status.js", "/icon.svg", "/nothing", "/docs"]
)
async def test_headers_on_every_answer(site: Site, path: str) -> None:
    answer = await site.client.get(path)
    assert {name: answer.headers[name] for name in HEADERS} == HEADERS


async def test_the_page_needs_nothing_from_elsewhere_and_no_inline_code(site: Site) -> None:
    site.keep(Result())
    page = (await site.client.get("/")).text
    assert re.findall(r'(?:src|href)="(?![/#])[^"]*"', page) == []
    assert set(re.findall(r"https?://[^\"\s<]+", page)) == {"http://www.w3.org/2000/svg"}
    assert " style=" not in page
    assert "<style" not in page
    assert re.findall(r"\son\w+=", page) == []


@pytest.mark.parametrize(("path", "status"), [("/nothing", 404), ("/api/v1/verifications?limit=0", 422), ("/docs", 404), ("/redoc", 404)])
async def test_errors_are_problem_documents(site: Site, path: str, status: int) -> None:
    answer = await site.client.get(path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == status


async def test_the_icon_is_a_picture(site: Site) -> None:
    assert ElementTree.fromstring((await site.client.get("/icon.svg")).text).tag.endswith("svg")


async def test_nothing_can_be_posted(site: Site) -> None:
    paths = (await site.client.get("/api/v1/openapi.json")).json()["paths"]
    assert {method for path in paths.values() for method in path} == {"get"}
    for path in ("/", "/api/v1/status"):
        assert (await site.client.post(path)).status_code == 405


async def test_a_store_that_is_gone_is_503(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: object) -> None:
        raise StoreError("database is locked")

    monkeypatch.setattr(site.store.pages, "page", gone)
    for path in ("/readyz", "/", "/api/v1/status"):
        answer = await site.client.get(path)
        assert (answer.status_code, answer.json()["code"], answer.headers["retry-after"]) == (503, "STO-001", "5")
    assert (await site.client.get("/healthz")).json() == {"status": "ok"}


async def test_a_foreign_host_name_is_refused(site: Site) -> None:
    assert (await site.client.get("/api/v1/status", headers={"Host": "evil.example"})).status_code == 400


@pytest.mark.parametrize("count", [1, 2, 60])
def test_trend_is_well_formed_for_any_number_of_points(count: int) -> None:
    points = [Point(NOW + timedelta(days=7 * i), 10.0 + i % 5, 1.0, 20.0, ("pass", "fail", "cannot tell")[i % 3]) for i in range(count)]
    root = ElementTree.fromstring(trend_svg('Body "diagonal" <x>', "µm", points, utc(2026, 1, 1).tzinfo))  # type: ignore[arg-type]
    width, height = (float(v) for v in root.attrib["viewBox"].split()[2:])
    for element in root.iter():
        for axis, size in (("x", width), ("cx", width), ("y", height), ("cy", height)):
            assert 0 <= float(element.attrib.get(axis, 0)) <= size
    assert "nan" not in ElementTree.tostring(root, "unicode")


def test_many_points_are_few_paths() -> None:
    verdicts = ("pass", "fail", "cannot tell")
    points = [Point(NOW + timedelta(days=i), 10.0 + i % 5, 1.0, 20.0, verdicts[i % 3], i < 30) for i in range(MANY + 1)]
    root = ElementTree.fromstring(trend_svg("x", "µm", points, utc(2026, 1, 1).tzinfo))  # type: ignore[arg-type]
    found = {one.attrib["class"]: one.attrib["d"].count("M") for one in root.iter() if one.tag.endswith("path")}
    found.pop("limit")
    assert found.pop("bar") == MANY + 1
    assert found == {
        f"many {look}{old}": n for look in ("pass", "fail", "unclear") for old, n in (("", 31 if look == "pass" else 30), (" earlier", 10))
    }


def test_trend_survives_figures_without_size_or_limit() -> None:
    svg = trend_svg("x", "", [Point(NOW, 0.0, 0.0, None, "pass"), Point(NOW, -3.0, 0.0, None, "pass")], utc(2026, 1, 1).tzinfo)  # type: ignore[arg-type]
    assert "limit" not in svg


@pytest.mark.parametrize(
    ("verdict", "diagonal", "helix", "expected"),
    [
        ("fail", 23.4, 1.4, ("fail", "pass")),
        ("pass", 11.0, 1.4, ("pass", "pass")),
        ("cannot tell", 19.5, 1.4, ("cannot tell", "pass")),
        ("cannot tell", 11.0, 1.4, ("cannot tell", "cannot tell")),  # too warm: the reason is not in the figures
    ],
)
def test_a_point_shows_the_verdict_of_its_figure(verdict: str, diagonal: float, helix: float, expected: tuple[str, str]) -> None:
    doc = verify.check_doc(
        verify.Occasion("m", WEEKLY, NOW), Result(verdict=verdict, values={"body_diagonal_um": diagonal, "helix_rms_um": helix})
    )
    check = read_as(Verification, {"id": 1, **doc})
    assert (figure_verdict(check, "body_diagonal_um"), figure_verdict(check, "helix_rms_um")) == expected


def test_words() -> None:
    assert formatting.figure_name("body_diagonal_um") == ("Body diagonal", "µm")
    assert formatting.figure_name("helix_rms_um") == ("Helix RMS", "µm")
    assert formatting.figure_name("odd") == ("Odd", "")
    assert [formatting.number(v) for v in (123.4, 11.84, 0.123, None)] == ["123", "11.8", "0.12", "–"]


async def test_a_skipped_slot_changes_the_revision(site: Site) -> None:
    async def revision() -> str:
        return str((await site.client.get("/api/v1/status")).json()["revision"])

    before, slot = await revision(), utc(2026, 11, 21, 5)
    site.store.slots.claim("another mill/weekly", slot)
    assert await revision() == before, "what happens to another machine is none of this page's business"
    site.store.slots.claim("mill-7/weekly", slot)
    claimed = await revision()
    site.store.slots.finish("mill-7/weekly", slot, "skipped: busy", "something else ran")
    assert len({before, claimed, await revision()}) == 3
    assert await revision() == await revision()


async def test_a_device_says_since_when_so_that_an_open_page_can_go_on_counting(site: Site) -> None:
    site.board.job_started(WEEKLY, NOW)
    site.board.job_ended({"cause": None})
    assert page_of(await site.client.get("/")).count(f'data-since="{NOW.isoformat()}"') == len(DEVICES)


def page_of(answer: httpx.Response) -> str:
    assert answer.status_code == 200
    return answer.text
