"""A real service whose machine file a person changes on the page: it starts anew, and everybody sees the same values."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser

from abbe.service.audit.book import AuditBook
from abbe.service.config import load_machine
from abbe.service.storage.store import Store
from tests.patience import within
from tests.system.serve_bench import Machine, abbe, free_port
from tests.system.test_serve_processes import PHRASE, Running, tokens, url_of
from tests.system.test_serve_screens import context

pytestmark = pytest.mark.timeout(300)
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
LABORATORY = {
    "issuer.laboratory": "Länglab GmbH",
    "issuer.city": "Ulm",
    "issuer.country": "DE",
    "issuer.person": "P. Meier",
    "item.serial": "4711",
}
COMMENT = "# agreed with the plant on 3 May"


@dataclass
class Desk:
    """A running service and its machine file."""

    running: Running
    file: Path

    def sha256(self) -> str:
        return load_machine(self.file).sha256

    def post(self, form: str, who: str, **fields: str) -> httpx.Response:
        sent = {"sha256": self.sha256(), "password": PHRASE} | fields
        return self.running.http.post(f"/administration/{form}", data=sent, headers=self.running.who[who])

    def changed(self, form: str, who: str, **fields: str) -> str:
        """Send a form that is taken; the screen, once the service has started anew."""
        answer = self.post(form, who, **fields)
        assert answer.status_code == 303, answer.text
        until_s = time.monotonic() + within(30)
        while True:
            try:
                page = self.running.http.get(answer.headers["location"], headers=self.running.who[who])
            except httpx.TransportError:  # the connection was to the process that is gone
                page = None
            if page is not None and page.status_code == 200 and "starting anew" not in page.text:
                assert "has started anew" in page.text
                return page.text
            assert time.monotonic() < until_s, page and page.text
            threading.Event().wait(0.2)  # as a browser that asks again


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    port, who = free_port(), tokens(tmp_path)
    extra = ["[web]", f"port = {port}", COMMENT, "[verify]", "helix_rms_um = 5.0   # of the maker"]
    machine = Machine(tmp_path, 100.0, *extra)
    with closing(machine.process), closing(abbe("serve", "-m", machine.file)) as process:
        process.expect('"page up"')
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as http:
            yield Desk(Running(process, http, who, port), machine.file)


def test_a_change_is_in_the_file_in_the_service_in_the_commands_and_in_the_audit(desk: Desk) -> None:
    core, before = desk.running.process.pid, desk.file.read_text()
    page = desk.changed("laboratory", "admin", **LABORATORY)
    assert 'value="Länglab GmbH"' in page
    assert desk.running.process.pid == core
    text = desk.file.read_text()
    assert text.startswith(before.rstrip("\n")), "what was there stays as it was"
    loaded = load_machine(desk.file)
    assert loaded.machine.issuer is not None
    assert (loaded.machine.issuer.laboratory, loaded.machine.item.serial) == ("Länglab GmbH", "4711")
    config = abbe("check-config", "-m", desk.file)
    config.expect("Länglab GmbH")
    config.close()
    looser = {"verify.helix_rms_um": "6.5"}
    refused = desk.post("limits", "approver", **looser)
    assert refused.status_code == 409
    assert "allows more than before: Helix rms, µm 5.0 → 6.5" in refused.json()["detail"]
    assert desk.file.read_text() == text
    page = desk.changed("limits", "approver", **looser, looser="yes", reason="new bearings, agreed with the plant")
    assert 'name="verify.helix_rms_um" inputmode="decimal" maxlength="30" autocomplete="off" value="6.5"' in page
    assert (COMMENT in desk.file.read_text(), "helix_rms_um = 6.5  # of the maker" in desk.file.read_text()) == (True, True)
    if LONG:  # each change is a start of the service
        desk.changed("certificates", "approver", **{"calibration.ballbar": "2031-05-31"}, looser="yes", reason="certificate K-88")
    name = {f"schedule[1].{key}": value for key, value in {"name": "week", "cron": "0 6 * * 1", "timezone": "UTC"}.items()}
    refused = desk.post("schedule", "admin", **name)
    assert (refused.status_code, "allows more than before" in refused.json()["detail"]) == (409, True)
    desk.changed("schedule", "admin", **name, looser="yes", reason="agreed with the shift")
    due = desk.running.http.get("/api/v1/status", headers=desk.running.who["viewer"]).json()["next_due"]
    assert [one["schedule"] for one in due] == ["week"]
    if LONG:
        desk.changed("schedule", "admin", **{"schedule[1].name": "week", "remove": "yes"})
    with Store.open(url_of(desk.file.parent)) as store:
        assert AuditBook(store, url_of(desk.file.parent)).verify() == []
        told = [
            (one.who, one.target, one.doc["reason"])
            for one in store.audit.events()
            if one.action == "machine file" and one.outcome == "done"
        ]
        digests = [one.doc["sha256"] for one in store.audit.events() if one.action == "abbe serve"]
    assert told[1] == ("token:a-approver/test", "verify.helix_rms_um 5.0 → 6.5", "new bearings, agreed with the plant")
    assert len(told) == (5 if LONG else 3)
    assert len(set(digests)) == len(told) + 1, "each life of the service names the file that it had"


def test_what_may_not_be_is_refused_and_the_file_stays(desk: Desk) -> None:
    before = desk.file.read_bytes()
    fields = {"verify.helix_rms_um": "4"}
    assert desk.post("limits", "admin", **fields).status_code == 403
    assert desk.post("laboratory", "approver", **LABORATORY).status_code == 403
    assert desk.post("limits", "approver", **fields, password="wrong").status_code == 403
    for value in ("0", "-1", "five", "1e999", "nan"):
        answer = desk.post("limits", "approver", **{"verify.helix_rms_um": value})
        assert (answer.status_code, "Helix rms" in answer.json()["detail"]) == (409, True), answer.text
    assert desk.post("limits", "approver", **fields, sha256="0" * 64).status_code == 409
    assert desk.post("limits", "approver", **{"verify.helix_rms_um": "5"}).json()["detail"].startswith("Nothing is different")
    number = desk.running.start("quick-check").json()["id"]
    answer = desk.post("limits", "approver", **fields)
    assert (answer.status_code, "in use" in answer.json()["detail"]) == (409, True)
    desk.running.http.post(f"/api/v1/jobs/{number}/abort", headers=desk.running.who["operator"])
    until_s = time.monotonic() + within(60)
    while desk.running.job(number)["ended_utc"] is None:
        assert time.monotonic() < until_s
        threading.Event().wait(0.2)
    assert desk.file.read_bytes() == before
    desk.file.write_bytes(before + b"# somebody was here\n")
    stale = desk.post("limits", "approver", **fields)
    assert stale.status_code == 409
    desk.changed("read", "admin", sha256=hashlib.sha256(before).hexdigest())
    desk.changed("limits", "approver", **fields)
    assert desk.file.read_text().endswith("helix_rms_um = 4  # of the maker\n# somebody was here\n")


@pytest.mark.browser
@pytest.mark.parametrize("size", ["1280", "390"] if LONG else ["390"])
def test_a_laboratory_is_entered_by_touches_and_the_browser_waits_for_the_service(chromium: Browser, desk: Desk, size: str) -> None:
    base = str(desk.running.http.base_url).rstrip("/")
    with context(chromium, size) as made:
        page = made.new_page()
        page.goto(f"{base}/login")
        page.fill("#name", "a-admin")
        page.fill("#password", PHRASE)
        page.click("button[type=submit]")
        page.wait_for_selector("html[data-ready=yes]")
        page.goto(f"{base}/settings")
        page.click("a.go[href='/administration']")
        page.wait_for_selector("html[data-ready=yes]")
        page.locator("main summary").first.click()
        form = page.locator("form[action='/administration/laboratory']")
        for key, value in (LABORATORY | {"issuer.country": "germany"}).items():
            form.locator(f"[name='{key}']").fill(value)
        form.locator("[name=password]").fill(PHRASE)
        form.locator("button").click()
        page.wait_for_selector("form[action='/administration/laboratory'] [role=alert]:not(:empty)")
        assert "Country, two letters" in form.locator("[role=alert]").inner_text()
        assert load_machine(desk.file).machine.issuer is None
        form.locator("[name='issuer.country']").fill("DE")
        form.locator("button").click()
        page.wait_for_selector("p.pass[role=status]", timeout=within(60) * 1000)
        assert page.locator("[name='issuer.laboratory']").input_value() == "Länglab GmbH"
    assert load_machine(desk.file).machine.item.serial == "4711"
