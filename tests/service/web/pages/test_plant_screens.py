"""Machines, devices, settings and diagnostics over a real store: who sees them, what they say, and that no secret leaves the house."""

from __future__ import annotations

import io
import json
import re
import zipfile
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import httpx
import pytest

from abbe.service.clock import SystemClock
from abbe.service.domain.progress import DeviceStatus
from abbe.service.queries.fleet import FleetFigure, MachineLine
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.storage.store import Store
from abbe.service.web.app import create_app
from abbe.service.web.pages.diagnostics import HIDDEN, blanked, blanked_doc, blanked_line
from abbe.service.web.pages.plant_screens import FleetLine, FleetQuery, device_screen, fleet_csv, fleet_lines
from tests.pages_world import Served
from tests.service.web.pages.test_screens import as_user

CANARY = "c4n4ry-7f3a"


def machine(store: Store, name: str, value: float | None, verdict: str) -> None:
    at = datetime.now(UTC).isoformat()
    doc = {"machine": name, "started_utc": at, "verdict": verdict, "values": {} if value is None else {"body_diagonal_um": value}}
    doc |= {
        "uncertainties": {"body_diagonal_um": 2.0},
        "limits": {"body_diagonal_um": 20.0},
        "text": "",
        "campaign": "",
        "runs": [],
        "cause": None,
    }
    store.verifications.add_with_messages(store.machines.add(name, {"name": name}), doc, [])


def test_machines_stand_worst_first_and_can_be_filtered(tmp_path: Path) -> None:
    with Store.open(f"sqlite:///{tmp_path / 'a.sqlite3'}") as store:
        machine(store, "good", 8.0, "pass")
        machine(store, "bad", 30.0, "fail")
        machine(store, "broken", None, "cannot tell")
        now = datetime.now(UTC)

        def names(**asked: str) -> list[str]:
            return [line.machine.machine for line in fleet_lines(store, now, FleetQuery(**asked))]

        assert names() == ["broken", "bad", "good"]
        assert names(sort="machine") == ["bad", "broken", "good"]
        assert names(verdict="fail") == ["bad"]
        assert names(name="BRO") == ["broken"]
        line = fleet_lines(store, now, FleetQuery(name="good"))[0]
        assert (line.share, line.share_u) == (pytest.approx(0.4), pytest.approx(0.1))


def test_the_csv_holds_si_and_no_formula() -> None:
    line = FleetLine(MachineLine('=cmd("x")', "waiting", verdict="pass"), FleetFigure("body_diagonal_um", 8.0, 2.0, 20.0), 1)
    head, row = fleet_csv([line]).splitlines()
    assert head.startswith("machine,state,")
    assert row == '"\'=cmd(""x"")",waiting,,pass,body_diagonal_um,8.0,2.0,20.0,0.4,,,1,not checked yet'


def test_a_certificate_says_how_long_it_holds(tmp_path: Path) -> None:
    today = date(2026, 11, 22)
    until = {"ballbar": today + timedelta(days=5), "laser": today - timedelta(days=1)}
    devices = [DeviceStatus(role=r, url=f"modbus://me:{CANARY}@h/{r}", state="answered") for r in ("cnc", "ballbar", "laser")]
    with Store.open(f"sqlite:///{tmp_path / 'a.sqlite3'}") as store:
        number = store.campaigns.add(store.machines.add("m", {}), "c", {})
        told = {"link": "laser", "device": "d", "code": "DRV-003", "run": "r1", "text": "no answer"}
        for phase, state in (("detected", ""), ("outcome", "recovered")):
            store.checkpoints.add(number, "incident", told | {"phase": phase, "state": state, "times": 3})
        screen = device_screen(store, "m", devices, until, today)
    assert [None if line.certificate is None else line.certificate.sign for line in screen.lines] == [None, "open", "bad"]
    assert CANARY not in "".join(line.url for line in screen.lines)
    assert [(one.code, one.times, dict(one.ends)) for one in screen.incidents] == [("DRV-003", 1, {"recovered": 1})]


def test_who_sees_users_and_diagnostics(running: Served) -> None:
    for name, admin in (("vera", False), ("anna", False), ("adam", True)):
        with as_user(running, name) as client:
            assert ("petra" in client.get("/users").text) == admin
            assert "petra" not in client.get("/settings").text
            for path in ("/diagnostics", "/support.zip", "/machine"):
                assert client.get(path).status_code == (200 if admin else 403), (name, path)


async def test_a_choice_is_kept_by_a_screen_alone_and_over_tls_only_where_there_is_tls(running: Served) -> None:
    with as_user(running, "vera") as client:
        asked = [client.get(f"{path}?theme=dark").headers for path in ("/healthz", "/api/v1/status", "/settings")]
        assert ["set-cookie" in headers for headers in asked] == [False, False, True]
        assert "Secure" not in asked[2]["set-cookie"]
    app = create_app(StatusReader(Reader(running.store, "m", SystemClock()), "0", running.board, list, ""), version="0", auth=running.auth)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="https://127.0.0.1") as client:
        assert "Secure" in (await client.get("/login?theme=dark")).headers["set-cookie"]


def test_units_and_colours_are_kept_by_cookies_and_apply_to_figures(running: Served) -> None:
    with as_user(running, "vera") as client:
        before = client.get("/trends").text
        answer = client.get("/settings?units=inch&theme=dark&lang=de")
        assert {c.split("=")[0] for c in answer.headers.get_list("set-cookie")} == {"abbe_units", "abbe_theme", "abbe_lang"}
        assert 'data-theme="dark"' in answer.text
        assert "set-cookie" not in client.get("/settings?units=furlong&theme=%22%3E").headers
        kept = {"Cookie": client.headers["Cookie"] + "; abbe_units=inch"}
        after = client.get("/trends", headers=kept).text
        assert ("µin" in before, "µin" in after) == (False, True)
        limit = r'<td class="n">20 µm</td>|<td class="n">787 µin</td>'
        assert set(re.findall(limit, before)) == {'<td class="n">20 µm</td>'}
        assert set(re.findall(limit, after)) == {'<td class="n">787 µin</td>'}
        for path in ("/", "/result", "/proposals", "/proposal?id=3", "/run?id=1", "/fleet"):
            assert "µin" in client.get(path, headers=kept).text, path
        assert "µin" not in client.get("/api/v1/status", headers=kept).text
        assert client.get("/api/v1/status").json()["last"] == client.get("/api/v1/status", headers=kept).json()["last"]


@pytest.mark.parametrize(
    "text",
    [
        f"postgresql://me:{CANARY}@db/abbe",
        f'{{"password": "{CANARY}"}}',
        f"token={CANARY}",
        f"Authorization: Bearer {CANARY}",
        f"sent with bearer {CANARY}",
        f"Cookie: abbe-8080={CANARY}",
        f"-----BEGIN PRIVATE KEY-----\n{CANARY}\n-----END PRIVATE KEY-----",
        rf'{{"text": "… password=\"{CANARY}\" x"}}',
        rf'{{"text": "password=\"a {CANARY}',
        rf'{{"text": "{{\"text\": \"password=\\\"a {CANARY} b\\\"\"}}"}}',
        f"Authorization: Basic {CANARY}",
        f"sent Basic dXNlcjpwYXNz{CANARY}",
        f"Cookie: abbe_lang=de; abbe_session={CANARY}",
        f"abbe_session={CANARY}",
        f"('cookie', 'abbe_lang=de; abbe_session={CANARY}')",
        f'{{"password": "ab,cd}}ef {CANARY}"}}',
        f"{{'password': b'ab,cd}}ef {CANARY}'}}",
        f"pwd=abc,{CANARY}",
        f"mqtt://u:p@{CANARY}@host",
        f"mqtt://u:p/{CANARY}@host",
    ],
)
def test_what_looks_like_a_secret_is_blanked(text: str) -> None:
    assert CANARY not in blanked(f"before {text} after")
    assert CANARY not in blanked_line(f"before {text} after")
    assert CANARY not in blanked_line(json.dumps({"event": f"before {text} after"}))
    assert CANARY not in json.dumps(blanked_doc({"a": [{"text": f"before {text} after"}]}))
    assert blanked("laser 3 answered after 1.2 s: pass") == "laser 3 answered after 1.2 s: pass"


def test_what_stands_under_a_word_for_a_secret_is_blanked_whole_and_nothing_else() -> None:
    doc = {"device": {"db_password": {"now": CANARY}}, "headers": [["Cookie", f"a=1; b={CANARY}"]], "tokens": [CANARY]}
    assert blanked_doc(doc) == {"device": {"db_password": HIDDEN}, "headers": [["Cookie", HIDDEN]], "tokens": HIDDEN}
    plain = {"verdict": "pass", "url": "modbus://127.0.0.1:502", "password": None, "n": 3, "text": 'axis "X": 1.5 µm, key 7'}
    assert blanked_doc(plain) == plain
    assert json.loads(blanked_line(json.dumps(plain))) == plain


def test_the_bundle_holds_no_secret_and_stands_in_the_audit(running: Served) -> None:
    secret = running.people.begin(running.people.get("adam"))
    hashes = [user.password for user in running.store.people.all()]
    running.tail._lines.extend([f"mqtt://me:{CANARY}@broker refused", f"login with password={CANARY}", f"cookie: {secret}"])
    running.board.devices = [replace(d, url=f"modbus://me:{CANARY}@127.0.0.1:502") for d in running.board.devices]
    with as_user(running, "adam") as client:
        archive = zipfile.ZipFile(io.BytesIO(client.get("/support.zip").content))
        page = client.get("/diagnostics").text
        assert "mqtt://" in page
    texts = {name: archive.read(name).decode() for name in archive.namelist()}
    assert set(texts) == {"config.json", "diagnosis.json", "log.txt", "status.json", "versions.json"}
    whole = "".join(texts.values())
    assert [one for one in (CANARY, secret, *hashes) if one in whole] == []
    assert json.loads(texts["config.json"])["machine"] == running.filled.machine
    assert json.loads(texts["diagnosis.json"])["health"]["size_b"] > 10_000
    assert any(record.action == "support bundle" and record.who == "user:adam" for record in running.store.audit.events(50))


async def test_a_screen_that_is_not_there_is_not_in_the_bar(running: Served) -> None:
    entries = r'<a href="(/[a-z]+)"'
    with as_user(running, "vera") as client:
        there = set(re.findall(entries, client.get("/settings").text))
        headers = {"Cookie": client.headers["Cookie"]}
    assert {"/fleet", "/devices", "/settings", "/runs"} <= there
    app = create_app(StatusReader(Reader(running.store, "m", SystemClock()), "0", running.board, list, ""), version="0", auth=running.auth)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1", headers=headers) as client:
        assert (await client.get("/fleet")).status_code == 404
        fewer = set(re.findall(entries, (await client.get("/runs")).text))
    assert there - fewer >= {"/fleet", "/devices", "/settings"}
    assert "/runs" in fewer


def test_nobody_without_a_session_gets_the_bundle(running: Served) -> None:
    with httpx.Client(base_url=running.base) as client:
        assert {client.get(path).status_code for path in ("/support.zip", "/diagnostics", "/fleet.csv", "/fleet", "/devices")} == {401}


def test_the_machine_file_is_shown_with_its_lines_and_no_secret(running: Served) -> None:
    with as_user(running, "adam") as client:
        page = client.get("/machine").text
    rows = dict(re.findall(r"<code>([^<]+)</code></th><td[^>]*>([^<]+)</td>", page))
    assert rows["limits.table_value_um"] == "line 9"
    assert rows["limits.table_change_um"] == "default"
    assert rows["calibration.laser"] == "line 13"
    assert rows["issuer.laboratory"] == "line 15"
    assert rows["schedule[1].cron"] == "line 21"
    assert "secret" not in page
    assert "machine.toml" in page
