"""The full campaign over HTTP: a real service, simulated devices, and somebody at the page who mounts what he is asked for.

The machine file's fixture is the console. The test reads each prompt, mounts in the simulated world what it says, and says Done.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import httpx
import pytest
from playwright.sync_api import Page as Screen

from abbe.service.audit.book import AuditBook
from abbe.service.campaigns.resume import begun_source
from abbe.service.clock import SystemClock
from abbe.service.compensation.proposal_decisions import proposal_status
from abbe.service.compensation.proposal_doc import load
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from tests.scenarios.conftest import Sims, simulated
from tests.scenarios.world import wait_for
from tests.system.serve_bench import Process, abbe, free_port
from tests.system.test_serve_live import axe_core, faults, log_in
from tests.system.test_serve_page import browser, only_us, shot
from tests.system.test_serve_rollback import PHRASE, client

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(900)]
LONG = os.environ.get("ABBE_TEST_LONG")
NUMBER = r"([+-]?\d+(?:\.\d+)?)"
BAR = re.compile(rf"mount the {NUMBER} mm bar", re.IGNORECASE)
BEAM = re.compile(rf"beam along X {NUMBER}  Y {NUMBER}  Z {NUMBER}")
SET_UPS, RUNS, BARS, CHECKED = 19, 21, 3, 4


def tokens(url: str) -> dict[str, dict[str, str]]:
    with Store.open(url) as store:
        people = UserAccounts(store, SystemClock(), Passwords(memory_kib=64, passes=1))
        found = {}
        for name, role, scopes in (("mia", "metrologist", ["read", "measure", "propose"]), ("vera", "viewer", ["read"])):
            people.add(name, role, PHRASE)
            found[name] = {"Authorization": f"Bearer {people.add_token(name, 'test', scopes, 1.0)}"}
        return found


@dataclass
class Page:
    """Somebody at the page, and his hands in the simulated world."""

    http: httpx.Client
    sims: Sims
    who: dict[str, dict[str, str]]
    mounted: list[str] = field(default_factory=list)

    def start(self, key: str, who: str = "mia", resume: str = "") -> httpx.Response:
        headers = {**self.who[who], "Idempotency-Key": key}
        return self.http.post("/api/v1/jobs", json={"recipe": "identification", "resume": resume}, headers=headers)

    def job(self, place: str) -> dict[str, Any]:
        return dict(self.http.get(place, headers=self.who["vera"]).json())

    def says_done(self, place: str, prompt: int, who: str = "mia") -> int:
        return self.http.post(f"{place}/prompts/{prompt}/done", headers=self.who[who]).status_code

    def next_prompt(self, place: str, after: int) -> dict[str, Any]:
        """The job once it asks for something new, or has ended."""

        def news() -> dict[str, Any] | None:
            now = self.job(place)
            return now if now["ended_utc"] or now["prompt"] > after else None

        return dict(wait_for(news, 300, f"what comes after prompt {after}"))

    def mount(self, text: str) -> None:
        """What a person does who reads this."""
        bar, beam = BAR.search(text), BEAM.search(text)
        if bar is not None:
            self.sims.ask("mount_ballbar", radius_mm=float(bar[1]))
        elif beam is not None:
            along = [float(part) for part in beam.groups()]
            self.sims.ask("mount_laser", beam=[part / math.hypot(*along) for part in along])
        else:
            assert "Take bar, cup, mirror or artefact away" in text, text
            self.sims.ask("unmount")
        self.mounted.append(text)


def stopped_at_the_first_prompt(page: Page) -> str:
    """A stop ends the wait for a person; gives the name of the campaign that can be gone on with."""
    place = page.start("k1").headers["Location"]
    asked = page.next_prompt(place, 0)
    assert (asked["kind"], asked["state"], asked["prompt"]) == ("campaign", "asking", 1)
    for address in ("/live", "/"):
        shown = page.http.get(address, headers=page.who["vera"]).text
        assert asked["ask"] in shown
        assert "data-prompt" not in shown, "who may not measure has no button"
    assert page.http.post(f"{place}/stop", headers=page.who["mia"]).status_code == 202
    ended = page.next_prompt(place, 1)
    assert (ended["state"], ended["prompt"], ended["proposal"]) == ("done: stopped", 0, None)
    assert page.says_done(place, 1) == 409, "an answer that comes too late is none"
    name = re.search(r"--resume '([^']+)'", ended["text"])
    assert name is not None, ended["text"]
    return name[1]


def stopped_at_the_third_bar(page: Page) -> str:
    """Two bars are measured, and the third stands when a person stops; gives the name that the screen of a new measurement resumes."""
    place = page.start("k2").headers["Location"]
    now = page.next_prompt(place, 0)
    while sum("mm bar" in asked for asked in page.mounted) < BARS:
        page.mount(now["ask"])
        assert page.says_done(place, now["prompt"]) == 202
        now = page.next_prompt(place, now["prompt"])
    assert page.http.post(f"{place}/stop", headers=page.who["mia"]).status_code == 202
    assert page.next_prompt(place, now["prompt"])["state"] == "done: stopped"
    offered = page.http.get("/new?recipe=identification", headers=page.who["mia"]).text
    name = re.search(r"/new\?recipe=identification&amp;resume=([^\"]+)", offered)
    assert name is not None, offered
    told = page.http.get(f"/new?recipe=identification&resume={name[1]}", headers=page.who["mia"]).text
    assert f"This resumes campaign {unquote(name[1])}" in told
    return unquote(name[1])


def led_to_its_end(page: Page, resume: str) -> dict[str, Any]:
    """Every prompt is answered once it was done, by whoever may; an old number or another's word moves nothing."""
    sent = page.start("k4", resume=resume)
    place = sent.headers["Location"]
    assert page.start("k4", resume=resume).headers["Location"] == place
    assert page.start("k5").status_code == 409
    before = len(page.mounted)
    now = page.next_prompt(place, 0)
    while not now["ended_utc"]:
        number = now["prompt"]
        assert (number, now["state"]) == (len(page.mounted) - before + 1, "asking")
        for wrong in {number - 1, number + 1} - {0}:
            assert page.says_done(place, wrong) == 409
        assert page.says_done(place, number, "vera") == 403
        assert page.job(place)["prompt"] == number
        page.mount(now["ask"])
        assert page.says_done(place, number) == 202
        assert page.says_done(place, number) == 409
        now = page.next_prompt(place, number)
    return now


@contextmanager
def serving(folder: Path) -> Iterator[tuple[Process, Page, str]]:
    """The service on a simulated machine whose fixture is a person, somebody at the page, and the store's address."""
    url, port = f"sqlite:///{folder / 'abbe.sqlite3'}", free_port()
    with simulated(folder, "--speed", "40", "--seed", "2", extra=f"[web]\nport = {port}") as sims:
        text = sims.machine_file.read_text()
        sims.machine_file.write_text(text.replace(sims.ready["fixture"], "fixture+console:"))
        who = tokens(url)
        with closing(abbe("serve", "-m", sims.machine_file)) as running, client(port) as http:
            running.expect('"page up"')
            yield running, Page(http, sims, who), url


@pytest.mark.skipif(not LONG, reason="a whole campaign takes minutes: ABBE_TEST_LONG=1 measures it")
def test_somebody_at_the_page_is_led_to_a_proposal(tmp_path: Path) -> None:
    with serving(tmp_path) as (running, page, url):
        http, who = page.http, page.who
        assert "identification" in http.get("/api/v1/jobs", headers=who["vera"]).json()["recipes"]
        assert page.start("k0", "vera").status_code == 403
        first = stopped_at_the_first_prompt(page)
        campaign = stopped_at_the_third_bar(page)
        before = len(page.mounted)
        done = led_to_its_end(page, campaign)
        print(done["state"], done["text"], len(page.mounted))  # noqa: T201 - what this is run for
        assert (done["state"], done["prompt"], done["ask"]) == ("done: proposed", 0, ""), done["text"]
        again = page.mounted[before:]
        assert "Take bar, cup, mirror or artefact away" in again[0], "what still stands is cleared away before anything moves"
        assert sum("mm bar" in asked or "beam along" in asked for asked in again) == SET_UPS - BARS + 1
        assert f"/proposal?id={done['proposal']}" in http.get("/live", headers=who["mia"]).text
        assert http.get(f"/proposal?id={done['proposal']}", headers=who["mia"]).status_code == 200
        assert running.terminate()[0] == 0
    with Store.open(url) as store:
        assert begun_source(store, first).recipe == "identification"
        runs = store.runs.all(store.campaigns.find(campaign).id)
        complete = [run.label for run in runs if run.visible_status == "complete"]
        assert len(complete) == len(set(complete)) == RUNS
        proposed = load(store, done["proposal"])
        assert (proposed.by, proposed.solution_id) == ("mia", done["solution"])
        assert proposal_status(store, done["proposal"], proposed, SystemClock().utc().timestamp()).word == "proposed"
        assert (store.proposals.approvals(done["proposal"]), store.pushes.entries("sim")) == ([], [])
        told = [(r.who, r.outcome) for r in store.audit.events(1000) if r.action == "campaign"]
        assert told == [("token:mia/test", word) for word in ("begun", "stopped", "begun", "stopped", "begun", "proposed")]
        started = [(r.who, r.outcome) for r in store.audit.events(1000) if r.action == "POST /api/v1/jobs"]
        assert ("token:vera/test", "refused 403") in started
        assert AuditBook(store, url).verify() == []


def at_the_button(screen: Screen, page: Page, number: int) -> None:
    """The prompt with this number comes to the screen; it is done in the simulated world, and Done is pressed."""
    screen.wait_for_selector(f"#by-hand button[data-prompt='{number}']", timeout=120_000)
    page.mount(screen.inner_text("#by-hand-text"))
    screen.click("#by-hand button")
    # The next prompt may come before anybody sees that there is none.
    screen.wait_for_selector(f"#by-hand:not([hidden]) button[data-prompt='{number}']", state="detached", timeout=60_000)


@pytest.mark.browser
@pytest.mark.skipif(not LONG, reason="drives a simulated machine for half a minute: ABBE_TEST_LONG=1 looks on")
def test_a_browser_leads_from_the_checklist_through_the_set_ups(tmp_path: Path) -> None:
    axe = axe_core()
    with serving(tmp_path) as (_, page, _), browser() as seen:
        screen, base = seen.page, str(page.http.base_url)
        log_in(screen, base, "mia")
        screen.goto(f"{base}/new?recipe=identification")
        assert screen.locator("#start ~ ol li").count() == SET_UPS
        assert faults(screen, axe) == []
        boxes = screen.locator("#start input[type=checkbox]").all()
        assert len(boxes) == CHECKED
        for box in boxes:
            box.check()
        shot(screen, "serve-campaign-new.png")
        screen.click("#start button")
        screen.wait_for_url("**/live")
        screen.wait_for_selector("#by-hand button:not([disabled])", timeout=60_000)
        assert screen.inner_text("#live-state") == "waiting for a person"
        assert faults(screen, axe) == []
        shot(screen, "serve-campaign-live.png")
        at_the_button(screen, page, 1)
        at_the_button(screen, page, 2)
        screen.goto(f"{base}/")
        at_the_button(screen, page, 3)
        shot(screen, "serve-campaign-home.png")
        at_the_button(screen, page, 4)
        assert faults(screen, axe) == []
        screen.goto(f"{base}/live")
        screen.wait_for_selector("#by-hand button[data-prompt='5']", timeout=120_000)
        screen.click("#steer [data-how=stop]")
        screen.wait_for_selector("#live-over:not([hidden])", timeout=60_000)
        assert screen.inner_text("#live-outcome") == "The run has ended: done: stopped"
        assert "are kept" in screen.inner_text("#live-text")
        assert "abbe" not in screen.inner_text("#live-text"), "a person at the page has no command line"
        assert screen.locator("#by-hand").count() == 0
        screen.click("#live-again a")
        screen.click("a[href*='resume=']")
        assert screen.locator("#start[data-resume^='identification ']").count() == 1
        assert screen.locator("#start input[type=checkbox]").count() == CHECKED + 1, "that nothing was changed meanwhile"
        assert faults(screen, axe) == []
        shot(screen, "serve-campaign-resume.png")
        assert seen.errors == []
        assert only_us(seen)
