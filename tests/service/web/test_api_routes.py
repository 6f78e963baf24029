"""What the interface answers is what the store holds; pages end; what is not there is told."""

from __future__ import annotations

import json
import struct
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from abbe.service.runs.columns import load_run
from abbe.service.web.catalogue import entries, page
from tests.project.test_project import ROOT
from tests.service.web.api_bench import CHECKS, SAMPLES, Plant, bar_samples

BASE = "http://127.0.0.1:8080"


@pytest.fixture
async def client(plant: Plant) -> AsyncIterator[httpx.AsyncClient]:
    transport = httpx.ASGITransport(plant.app, False)
    async with httpx.AsyncClient(transport=transport, base_url=f"{BASE}/api/v1", headers=plant.token("viewer")) as opened:
        yield opened


async def got(client: httpx.AsyncClient, path: str, **params: Any) -> Any:
    answer = await client.get(path, params=params)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def code(client: httpx.AsyncClient, path: str, **params: Any) -> tuple[int, str]:
    answer = await client.get(path, params=params)
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == answer.status_code
    assert body["type"] == f"urn:abbe:error:{body['code']}"
    return answer.status_code, body["code"]


async def test_pages_have_every_run_once_newest_first(client, plant):
    seen, cursor = [], None
    while True:
        part = await got(client, "/runs", limit=3, **({} if cursor is None else {"cursor": cursor}))
        seen += [run["number"] for run in part["runs"]]
        if (cursor := part["next_cursor"]) is None:
            break
        assert len(part["runs"]) == 3
    assert seen == [run.id for run in reversed(plant.store.runs.all())]


async def test_filters_reach_the_read_model(client):
    """What they do is held by tests/service/queries/test_measured.py."""
    found = (await got(client, "/runs", campaign="c2", role="identify", machine="VMC-1"))["runs"]
    assert [(run["run_id"], run["status"]) for run in found] == [("r03", "failed"), ("r02", "aborted"), ("r01", "complete")]
    assert (await got(client, "/runs", status="failed", test="laser_linear"))["runs"] == found[:1]


async def test_samples_are_those_that_were_stored(client, plant):
    run = plant.store.runs.find("c2/r01").id
    told = await got(client, f"/runs/{run}")
    assert told["channels"] == [{"channel": "bar", "codec": "bar/1", "chunks": 11, "samples": SAMPLES}]
    assert told["gaps"] == 1
    whole = bar_samples()
    for first, limit in ((0, 1000), (95, 10), (100, 100), (1039, 1000), (1040, 5), (5000, 5)):
        part = await got(client, f"/runs/{run}/samples", first=first, limit=limit)
        wanted = whole[first : first + limit]
        assert (part["count"], part["total"], part["first"]) == (len(wanted), SAMPLES, first)
        assert part["bar"]["seq"] == [one.seq for one in wanted]
        assert part["bar"]["reading_nm"] == [one.reading_nm for one in wanted]
        answer = await client.get(f"/runs/{run}/samples.bin", params={"first": first, "limit": limit})
        assert [tuple(row) for row in struct.iter_unpack("<IQiH", answer.content)] == [
            (one.seq, one.device_us, one.reading_nm, one.status) for one in wanted
        ]
        assert answer.headers["abbe-total"] == str(SAMPLES)


async def test_laser_records_and_columns(client, plant):
    run = plant.store.runs.find("c2/r03").id
    part = await got(client, f"/runs/{run}/samples", channel="laser", first=20)
    assert [record["t_s"] for record in part["records"]] == [20.0, 21.0, 22.0, 23.0, 24.0]
    assert (part["count"], part["total"], part["records"][0]["note"]) == (5, 25, "é")
    bar = plant.store.runs.find("c2/r01").id
    columns = await got(client, f"/runs/{bar}/columns", first=10, limit=5)
    whole = load_run(plant.store, bar).columns.to_document()
    assert columns["columns"]["x_mm"] == whole["x_mm"][10:15]
    assert columns["total"] == len(whole["x_mm"])
    sealed = plant.store.runs.find("c1/r04").id
    assert (await got(client, f"/runs/{sealed}/columns"))["columns"]["deviation_mm"] is None


@pytest.mark.parametrize(
    ("path", "params", "wanted"),
    [
        ("/runs/999", {}, (404, "STO-002")),
        ("/runs/0", {}, (404, "WEB-404")),
        ("/runs/-1", {}, (404, "WEB-404")),
        ("/runs/r01", {}, (404, "WEB-404")),
        ("/runs/99999999999999999999", {}, (404, "WEB-404")),
        ("/runs/1/samples", {}, (404, "STO-002")),
        ("/runs/1/samples", {"channel": "columns"}, (404, "STO-002")),
        ("/runs/1/samples", {"limit": 10_001}, (422, "WEB-422")),
        ("/runs/1/samples", {"first": -1}, (422, "WEB-422")),
        ("/runs", {"limit": 0}, (422, "WEB-422")),
        ("/runs", {"cursor": "x"}, (422, "WEB-422")),
        ("/solutions/1", {}, (409, "STO-003")),
        ("/trends", {"after": "yesterday"}, (422, "WEB-422")),
        ("/reports/run/999", {}, (404, "STO-002")),
        ("/reports/shoe/1", {}, (404, "WEB-404")),
        ("/reports/run/1", {"form": "doc"}, (422, "WEB-422")),
        ("/reports/push/1", {"machine": "nobody"}, (404, "STO-002")),
        ("/proposals/5", {}, (409, "STO-003")),
        ("/proposals/2/diff", {"with": 77}, (404, "STO-002")),
        ("/nothing", {}, (404, "WEB-404")),
    ],
)
async def test_what_is_not_there_is_told_with_its_code(client, path, params, wanted):
    assert await code(client, path, **params) == wanted


async def test_a_run_that_cannot_be_evaluated_is_told(client, plant):
    for label in ("c2/r03", "c2/r04 '; DROP"):
        assert await code(client, f"/runs/{plant.store.runs.find(label).id}/columns") == (409, "STO-003")


async def test_machines_campaigns_and_what_was_made_of_them(client, plant):
    machines = (await got(client, "/machines"))["machines"]
    assert [machine["name"] for machine in machines] == ["other mill", "VMC-1"]
    assert machines[0]["description"] is None
    assert machines[1]["description"]["stroke_mm"]["X"] == [0, 600]
    campaign = await got(client, "/campaigns/1")
    assert (campaign["name"], campaign["machine"], len(campaign["runs"])) == ("c1", "VMC-1", 4)
    assert campaign["discoveries"] == [1]
    assert set(campaign["solutions"]) == {1, 2}
    found = await got(client, "/solutions/2")
    stored = plant.store.solutions.get(2).doc
    assert found["document"]["not_observable"] == stored["not_observable"]
    assert len(found["document"]["not_observable"]) > 0
    u = {name: one["u"] for name, one in found["document"]["parameters"].items()}
    assert u == {name: one["u"] for name, one in stored["parameters"].items()}
    discovery = await got(client, "/discoveries/1")
    assert [state["state"] for state in discovery["states"]][-1] == "EXPLAINED"
    assert discovery["answer"]["effects"][0]["name"] == "backlash"


async def test_checks_trends_and_timetable(client):
    """What they say is held by tests/service/queries/test_status.py."""
    checks = (await got(client, "/checks", limit=5))["verifications"]
    assert await got(client, f"/checks/{checks[0]['id']}") == checks[0]
    trends = (await got(client, "/trends"))["figures"]
    assert [(one["figure"], one["checks"]) for one in trends] == [("body_diagonal_um", CHECKS)]
    later = (await got(client, "/trends", after="2026-11-05T00:00:00Z"))["figures"]
    assert later[0]["checks"] == CHECKS - 4
    daily, hours = (await got(client, "/schedules"))["schedules"]
    assert (daily["cron"], daily["next_due_utc"]) == ("0 6 * * *", "2026-11-23T05:00:00Z")
    assert hours["next_due_utc"] == "2026-11-22T16:00:00Z"
    assert [device["role"] for device in (await got(client, "/devices"))["devices"]] == ["cnc"]
    assert [recipe["name"] for recipe in (await got(client, "/recipes"))["recipes"]] == ["quick-check", "verification"]


async def test_proposals_and_journal(client, plant):
    """Where they stand is held by the tests of service/queries and of proposals."""
    found = {one["number"]: one for one in (await got(client, "/proposals"))["proposals"]}
    detail = await got(client, "/proposals/4")
    assert found[4].items() <= detail.items()
    assert (detail["two_people"], detail["by"], detail["reasons"]) == (True, "a-approver", [])
    assert len((await got(client, "/proposals/2/diff"))["tables"]) == 9
    same = await got(client, "/proposals/2/diff", **{"with": 3})
    assert {curve["largest_change_um"] for curve in same["tables"]} == {0.0}
    entries_ = (await got(client, "/pushes", push=1))["entries"]
    assert [entry["state"] for entry in entries_] == ["REJECTED", "SNAPSHOT"]
    assert entries_[0]["prev"] == entries_[1]["digest"]
    assert (await got(client, f"/pushes/{entries_[1]['number']}"))["doc"]["base_bank"] == 0


@pytest.mark.parametrize("kind", ["run", "campaign", "verification", "discovery", "push"])
async def test_reports_in_every_form(client, kind):
    begins = {"pdf": b"%PDF-", "html": b"<!doctype html>", "csv": b"", "json": b"{"}
    for form, begin in begins.items():
        answer = await client.get(f"/reports/{kind}/1", params={"form": form})
        assert answer.status_code == 200, answer.text
        assert answer.content.lower().startswith(begin.lower())
        assert answer.headers["content-disposition"].startswith('attachment; filename="')
        assert answer.headers["content-disposition"].endswith(f'.{form}"')
        assert answer.content == (await client.get(f"/reports/{kind}/1", params={"form": form})).content
    assert json.loads((await client.get(f"/reports/{kind}/1", params={"form": "json"})).text)["kind"] == kind


async def test_codes_are_one_catalogue_and_one_page(client):
    told = (await got(client, "/errors"))["errors"]
    assert [one["code"] for one in told] == [one.code for one in entries()]
    assert len(told) == len({one["code"] for one in told}) > 60
    assert all(one["description"] for one in told)
    assert (ROOT / "docs" / "reference" / "error-codes.md").read_text(encoding="utf-8") == page(), (
        "python -m abbe.service.web.catalogue > docs/reference/error-codes.md"
    )
