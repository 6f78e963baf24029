"""From a drift of the machine to the signed report, by touches and passwords that are typed: `abbe serve` measures, searches, pushes and
proves on a simulated machine over its wires. A metrologist checks and searches; an approver signs and pushes. Each has a log-in.

Prepared, not walked: the control is pretended to be commissioned, and proved for pushes with nobody there; the baseline and the users are
stored by functions. From the first check on, nothing is pretended.

`test_story.py` walks the same screens in every size, light and language with a store that is filled by hand.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

from abbe.service.clock import SystemClock
from abbe.service.config import load_machine
from abbe.service.demo.demo_serve import store_baseline
from abbe.service.devices.session import open_session
from abbe.service.domain.service_records import AlarmKind
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.verification.alarms import alarms_of
from tests.pages_world import PHRASE
from tests.pretended import as_if_commissioned, as_if_proved_for_nobody_there
from tests.scenarios.conftest import Sims, simulated
from tests.system.finger import Finger
from tests.system.serve_bench import abbe, free_port
from tests.system.test_serve_screens import SIZES, Watch, axe  # noqa: F401 - a fixture

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
pytestmark = [pytest.mark.browser, pytest.mark.scenario, pytest.mark.timeout(3000)]
SPEED = 20
"""At 50 a busy computer answers the service too late: its status is then unknown for half a second, or readings lag behind the axes."""
WALKS = [
    ("1280", "light", "en"), ("1280", "dark", "ja"), ("1024", "dark", "en"),
    ("1024", "light", "ja"), ("390", "light", "en"), ("390", "dark", "ja"),
]  # fmt: skip
"""Every size in both languages, and in light and dark."""
DRIFT_UM_PER_M = 160.0
# What the machine shows as it is made stays below; what the drift adds does not. A first table changes more than a table of a routine.
TERMS = """\
[verify]
body_diagonal_um = 90
helix_rms_um = 7
[limits]
table_value_um = 200
table_change_um = 200
table_walk_um = 200
[web]
port = {port}
"""
CHECK_MS, CAMPAIGN_MS, PUSH_MS = 600_000, 1_500_000, 1_200_000


async def _prepare(url: str, sims: Sims) -> None:
    """Pretend that the control is commissioned and proved; store a measured baseline and two users."""
    with Store.open(url) as store:
        site = site_of(load_machine(sims.machine_file).machine)
        async with open_session(site.urls) as session:
            await as_if_commissioned(session.controller, store, site)
            await as_if_proved_for_nobody_there(session.controller, store, site)
            await store_baseline(session, store, site, 100)  # the machine as delivered: a search tells what has changed since
        people = UserAccounts(store, SystemClock(), Passwords(memory_kib=64, passes=1))
        people.add("petra", "metrologist", PHRASE)
        people.add("anna", "approver", PHRASE)


@dataclass
class Shop:
    """The served machine, and its simulated world."""

    base: str
    url: str
    sims: Sims


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    port = free_port()
    with simulated(tmp_path, "--speed", str(SPEED), "--seed", "2", extra=TERMS.format(port=port)) as sims:
        url = load_machine(sims.machine_file).database_url
        with ThreadPoolExecutor(1) as aside:  # the browser has a loop in this thread
            aside.submit(asyncio.run, _prepare(url, sims)).result()
        with closing(abbe("serve", "-m", sims.machine_file)) as running:
            running.expect('"page up"')
            yield Shop(f"http://127.0.0.1:{port}", url, sims)


def starts(finger: Finger) -> None:
    """Confirm the checklist of a dry run, and start."""
    for box in finger.page.locator("#start input[type=checkbox]").all():
        finger.touch(box)
    finger.touch("#start button[type=submit]")
    finger.screen("/live")


def waits(finger: Finger, ms: float) -> None:
    """Wait for the end of the run on its screen."""
    finger.page.wait_for_selector("#live-over:not([hidden])", timeout=ms)


def quick_check(finger: Finger) -> None:
    """From home: the favourite, one confirmation, Start; its check, once it has ended."""
    before = finger.touches
    finger.touch("a.main[href='/new?recipe=quick-check']")
    finger.screen("/new")
    starts(finger)
    assert finger.counted("quick check", before) == 3
    waits(finger, CHECK_MS)
    finger.touch("#live-check a")
    finger.screen("/check")


def to_the_alarm(finger: Finger) -> None:
    finger.touch(".strip .count")
    finger.screen("/alarms")
    finger.touch("main a[href^='/alarm?id=']")
    finger.screen("/alarm")


@pytest.mark.skipif(not LONG, reason="five to ten minutes a walk on a simulated machine: ABBE_TEST_LONG=1 walks the whole way")
@pytest.mark.parametrize(("size", "scheme", "lang"), WALKS)
def test_on_a_prepared_machine_a_drift_is_followed_to_the_signed_report(
    chromium: Browser,
    shop: Shop,
    axe: str,  # noqa: F811 - the fixture
    size: str,
    scheme: str,
    lang: str,
) -> None:
    options: Any = {"viewport": SIZES[size], "color_scheme": scheme, "locale": lang, "has_touch": True}
    with closing(chromium.new_context(**options)) as context:
        page = context.new_page()
        watch, finger = Watch(page, shop.base), Finger(page, axe)
        finger.logs_in(shop.base, "petra")
        quick_check(finger)
        assert page.locator(".verdict.pass").count() == 1
        shop.sims.ask("drift", axis="X", um_per_m=DRIFT_UM_PER_M)
        finger.touch(".strip .name")
        finger.screen("/")
        quick_check(finger)
        finger.shot("check")
        assert page.locator("section .verdict.fail").count() == 1

        to_the_alarm(finger)
        finger.touch("form[action='/alarm/acknowledge'] button")
        finger.screen("/alarm")
        assert page.locator("form[action='/alarm/acknowledge']").count() == 0
        finger.shot("alarm")
        before = finger.touches
        finger.touch(".path .go.main")
        finger.screen("/new")
        finger.shot("new")
        starts(finger)
        finger.counted("search for the cause", before)
        waits(finger, CAMPAIGN_MS)
        finger.shot("searched")
        finger.touch("#live-made a")
        finger.screen("/proposal")
        finger.touch(".path ol li:nth-child(3) a")
        finger.screen("/discovery")
        finger.shot("discovery")
        assert lang != "en" or "scale of X" in page.inner_text("main")
        finger.touch("#logout")
        page.wait_for_url("**/login")

        finger.logs_in(shop.base, "anna")
        to_the_alarm(finger)
        finger.touch(".path .go.main")
        finger.screen("/proposal")
        finger.shot("proposal")
        before = finger.touches
        finger.touch("form.sign [name=clear]")
        page.fill("form.sign [name=password]", PHRASE)
        finger.touch("form.sign button")
        page.wait_for_selector("#ask-order[open]")
        finger.touch("#ask-order button.danger")
        assert finger.counted("approve to pushed", before) == 3
        page.wait_for_selector("#order-over:not([hidden])", timeout=PUSH_MS)
        assert lang != "en" or "kept" in page.inner_text("#order-state"), page.inner_text("#order-job")
        finger.shot("pushed")
        finger.touch("#order-over a")
        finger.screen("/proposal")
        finger.touch("#logout")
        page.wait_for_url("**/login")

        finger.logs_in(shop.base, "petra")
        to_the_alarm(finger)
        before = finger.touches
        finger.touch(".path .go.main")
        finger.screen("/new")
        starts(finger)
        finger.counted("proof", before)
        waits(finger, CHECK_MS)
        finger.touch("#live-check a")
        finger.screen("/check")
        finger.shot("proof")
        assert page.locator("section .verdict.pass").count() == 1
        before = finger.touches
        finger.touch(".strip .name")
        finger.screen("/")
        finger.shot("home")
        with page.expect_download() as report:
            finger.touch("main a[href^='/api/v1/reports/verification/']")
        assert finger.counted("report of the last check", before) == 2
        assert Path(report.value.path()).read_bytes().startswith(b"%PDF-")
        assert (watch.errors, watch.foreign, finger.bad) == ([], [], [])
        print(finger.counts, finger.touches)  # noqa: T201 - the figures of a passed test: pytest -rP

    with Store.open(shop.url) as store:
        (alarm,) = alarms_of(store, "sim")
        assert [line.kind for line in alarm.work] == [
            AlarmKind.ORDERED, AlarmKind.BEGUN, AlarmKind.MEASURED, AlarmKind.DISCOVERED, AlarmKind.PROPOSED
        ]  # fmt: skip
        assert (alarm.active, alarm.acknowledged_by) == (False, "petra")
        assert "scale of X" in alarm.work[3].facts.text
        assert [one.login for one in store.proposals.approvals(1)] == ["user:anna"]
        assert str(store.pushes.entries("sim")[-1].state) == "KEEP"
        good_um, bad_um, after_um = (
            v.doc["values"]["helix_rms_um"] for v in reversed(store.verifications.of_machine("sim")) if v.doc.get("recipe") == "quick-check"
        )
        print(f"helix rms: {good_um:.1f} um, after the drift {bad_um:.1f}, after the push {after_um:.1f}")  # noqa: T201
        assert after_um < good_um < bad_um
