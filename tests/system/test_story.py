"""From an alarm that a drift has raised to the report, by touches only: acknowledge, check, cause, proposal, signature, push, proof, PDF.

What the machine does in between (searching, pushing, measuring again) is written into the store, as the service would; every screen, every
decision and every touch is real. Each stop is looked at for broken words, small targets, sideways scrolling, and by axe-core.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Route

from abbe.service.clock import SystemClock
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from abbe.service.verification.alarm_rules import READ_CHECKS, check_facts, evaluate_alarm
from tests.pages_world import PHRASE, Filled, filled_once, served
from tests.pretended_push import KEPT, as_if_pushed
from tests.system.finger import Finger
from tests.system.serve_check import Result
from tests.system.test_serve_screens import LONG, SIZES, Watch, axe, violations  # noqa: F401 - a fixture

pytestmark = [pytest.mark.browser, pytest.mark.timeout(240)]
RECIPE = "verify"
STEPS = ["alarm", "check", "cause", "proposal", "approval", "push", "proof", "report"]
WALKS = [(size, scheme, lang) for size in SIZES for scheme in ("light", "dark") for lang in ("en", "ja")]
SHORT = [("390", "light", "en")]


def check(store: Store, filled: Filled, at: datetime, um: float) -> int:
    """Store a check as the service does, with what it does to the alarm of its recipe; return its number."""
    machine = store.campaigns.find(filled.campaign).machine_id
    told = Result("pass", {"body_diagonal_um": um, "helix_rms_um": 1.2}, text="pass", started_utc=at, duration_s=300.0, campaign="")
    store.verifications.add_with_messages(machine, verify.check_doc(verify.Occasion(filled.machine, filled.schedules[1], at), told), [])
    latest = store.verifications.of_machine(filled.machine, READ_CHECKS)
    found = evaluate_alarm(store, filled.machine, RECIPE, latest, 0.0)
    if found.kind is not None:
        entries = store.alarms.entries(filled.machine)
        number = None if found.now is None else found.now.number
        seq = 0 if number is None else 1 + max(e.seq for e in entries if e.alarm == number)
        store.alarms.append(filled.machine, number, seq, found.kind, check_facts(found, RECIPE, "night", latest[0].id))
    return latest[0].id


def drifted(store: Store, filled: Filled) -> tuple[int, int]:
    """Checks that creep up, below their limit, until the chart raises an alarm; the service searches and proposes. Alarm and proposal."""
    now = datetime.now(UTC)
    for k in range(16):
        check(store, filled, now - timedelta(days=16 - k), 8.0 + 0.05 * (-1) ** k + max(0, k - 8) * 0.4)
    number = max(e.alarm for e in store.alarms.entries(filled.machine))
    with store.engine.begin() as connection:  # the world's search was of another machine
        own = f"(SELECT id FROM machines WHERE name = '{filled.machine}' LIMIT 1)"
        searched = f"(SELECT campaign_id FROM discoveries WHERE id = {filled.discovery})"
        connection.exec_driver_sql(f"UPDATE campaigns SET machine_id = {own} WHERE id = {searched}")
    one = store.proposals.get(filled.proposals[2])
    proposal = store.proposals.add(one.machine, one.solution_id, one.doc, one.digest)
    seq = 1 + max(e.seq for e in store.alarms.entries(filled.machine) if e.alarm == number)
    facts = AlarmFacts(discovery=filled.discovery, text="searched")
    store.alarms.append(filled.machine, number, seq, AlarmKind.DISCOVERED, facts)
    store.alarms.append(filled.machine, number, seq + 1, AlarmKind.PROPOSED, AlarmFacts(proposal=proposal, text="a proposal waits"))
    return number, proposal


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    return filled_once(tmp_path_factory)


@dataclass
class Walk(Finger):
    """A person who sees the alarm on every screen."""

    def look(self, address: str) -> None:
        """Wait for a screen, and find its faults."""
        self.screen(address)
        assert self.page.locator(".strip .count").inner_text().startswith("▲"), "an alarm is present, and shown"

    def step(self, name: str) -> None:
        """Touch a step of the way."""
        self.touch(f".path ol li:nth-child({STEPS.index(name) + 1}) a")


@pytest.mark.parametrize(("size", "scheme", "lang"), WALKS if LONG else SHORT)
def test_from_a_drift_to_the_report_by_touches(chromium: Browser, tmp_path_factory, filled, axe, size, scheme, lang) -> None:  # noqa: F811
    world = filled_once(tmp_path_factory)  # each walk has a store of its own
    options: Any = {"viewport": SIZES[size], "color_scheme": scheme, "locale": lang, "has_touch": True}
    with served(world) as running, closing(chromium.new_context(**options)) as context:
        store, aside = running.store, ThreadPoolExecutor(1)  # the browser has a loop in this thread
        number, proposal = aside.submit(drifted, store, world).result()
        page = context.new_page()
        watch = Watch(page, running.base)

        def push(route: Route) -> None:
            """The core's part: the push goes well, and the next check passes and ends the alarm."""
            images = (b"the table of June", b"the table of July")
            kept = as_if_pushed(store, SystemClock(), world.machine, {"proposal": proposal}, images, KEPT)
            aside.submit(asyncio.run, kept).result()
            aside.submit(check, store, world, datetime.now(UTC) + timedelta(seconds=1), 6.0).result()
            route.fulfill(status=202, json={}, headers={"Location": "/api/v1/jobs/0123456789ab"})

        page.route(f"**/api/v1/proposals/{proposal}/push", push)
        page.route("**/api/v1/jobs/*", lambda route: route.fulfill(json={"state": "done: kept", "text": "", "ended_utc": "2026-01-01"}))
        walk = Walk(page, axe, "{}" if LONG or scheme == "light" else "{runOnly: ['color-contrast']}")
        walk.logs_in(running.base, "anna")
        walk.touch(".strip .count")
        walk.look("/alarms")
        walk.touch(page.locator(f"a[href='/alarm?id={number}']").last)
        walk.look(f"/alarm?id={number}")
        walk.touch("form[action='/alarm/acknowledge'] button")
        walk.look(f"/alarm?id={number}")
        assert page.locator("form[action='/alarm/acknowledge']").count() == 0
        walk.step("check")
        walk.look("/check")
        walk.step("cause")
        walk.look("/discovery")
        walk.touch(".path .go.main")  # what comes next: the approval
        walk.look(f"/proposal?id={proposal}")

        before = walk.touches
        walk.touch("form.sign [name=clear]")
        page.fill("form.sign [name=password]", PHRASE)
        walk.touch("form.sign button")
        page.wait_for_selector("#ask-order[open]")
        walk.bad += violations(page, axe, "{}")
        walk.touch("#ask-order button.danger")
        assert walk.touches - before == 3, "from the proposal to the push"
        page.wait_for_selector("#order-over:not([hidden])")
        walk.touch("#order-over a")
        walk.look(f"/proposal?id={proposal}")
        assert page.locator(".path li.done").count() == 7, "all but the report"
        walk.step("proof")
        walk.look("/check")
        with page.expect_download() as report:
            walk.touch(".path .go.main")
        assert Path(report.value.path()).read_bytes().startswith(b"%PDF-")
        assert walk.touches <= 12
        before = walk.touches
        walk.touch(".strip .name")
        walk.look("/")
        with page.expect_download():
            walk.touch("main a[href^='/api/v1/reports/verification/']")
        assert walk.touches - before == 2, "from any screen to the report of the last check"
        assert walk.bad == []
        assert watch.errors == []
        assert watch.foreign == []
        assert [a.login for a in store.proposals.approvals(proposal)] == ["user:anna"]
        aside.shutdown()
