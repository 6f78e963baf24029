"""What every screen weighs on the wire at first view, over a store of a year: HTML, data, scripts and styles, each once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from abbe.service.domain.service_records import AlarmFacts, AlarmKind, AuditEvent
from abbe.service.storage.store import Store
from tests.built_once import once_per_run
from tests.pages_world import Filled, Served, fill, screens, served
from tests.system.test_serve_screens import LONG, MAP_READY, log_in

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
HEAVIEST = 150_000
DAYS, WEEKS = 366, 53


def a_year(factory: pytest.TempPathFactory, folder: Path) -> Filled:
    """A check each day; each week a campaign with runs, a solution, a proposal, an alarm; slots and decisions."""
    filled = fill(factory, folder, checks=DAYS, days=1)
    with Store.open(filled.url) as store:
        campaign = store.campaigns.find(filled.campaign)
        solved, searched = store.solutions.get(filled.solution), store.discoveries.get(filled.discovery)
        proposed = store.proposals.get(filled.proposals[0])
        for week in range(WEEKS):
            number = store.campaigns.add(campaign.machine_id, f"quick-check {week}", campaign.doc)
            for k in range(3):
                run = store.runs.start(number, f"helix {k}", "ballbar_helix", "identify", {"setup": {}})
                store.runs.finish(run, "stopped", "SEQ-003: the door was opened", None)
            store.solutions.add(campaign.id, "joint", solved.run_ids, solved.doc)
            store.discoveries.add(campaign.id, f"{week:064d}", searched.doc)
            store.proposals.add(filled.machine, proposed.solution_id, proposed.doc, proposed.digest)
            alarm = store.alarms.append(
                filled.machine, None, 0, AlarmKind.RAISED, AlarmFacts(recipe=f"recipe {week}", text="above its limit")
            )
            store.alarms.append(filled.machine, alarm.alarm, 1, AlarmKind.CLEARED, AlarmFacts(text="over"))
        for day in range(DAYS):
            at = datetime.now(UTC) - timedelta(days=day + 1)
            store.slots.claim(f"{filled.machine}/night", at)
            store.slots.finish(f"{filled.machine}/night", at, "done: pass", "")
    return filled


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    _, filled = once_per_run(tmp_path_factory, "filled-year", lambda folder: a_year(tmp_path_factory, folder))
    with served(filled) as one:
        for k in range(220):
            one.auth.book.write(AuditEvent(who="user:anna", action="POST /proposal/approve", target=f"proposal {k}", outcome="303"))
        yield one


class Scales:
    """Bytes of the answers to a page, as they came over the wire, with their headers."""

    def __init__(self, page: Page) -> None:
        self.bytes = 0.0
        wire: Any = page.context.new_cdp_session(page)
        wire.send("Network.enable")
        wire.send("Network.setCacheDisabled", {"cacheDisabled": True})
        wire.on("Network.loadingFinished", self._came)

    def _came(self, event: dict[str, Any]) -> None:
        self.bytes += event["encodedDataLength"]


def weighed(page: Page, scales: Scales, address: str) -> int:
    """Bytes until a screen stands with its curves and data."""
    scales.bytes = 0.0
    answer = page.goto(address, wait_until="networkidle")
    assert answer is not None
    assert answer.status == 200, address
    page.wait_for_selector("html[data-ready=yes]")
    if page.locator("script[src$='/plot.js']").count():
        page.wait_for_function(MAP_READY)
    return round(scales.bytes)


@pytest.mark.skipif(not LONG, reason="a store of a year: ABBE_TEST_LONG=1 fills and weighs it")
def test_every_screen_is_light_over_a_store_of_a_year(chromium: Browser, running: Served) -> None:
    with closing(chromium.new_context(service_workers="block", locale="ja")) as context:
        page = context.new_page()
        log_in(page, running.base, "anna")
        scales = Scales(page)
        paths = [*screens(running.filled), "/trends?pictures=true", "/live", "/new?recipe=quick-check"]
        found = {path: weighed(page, scales, running.base + path) for path in paths}
    told = "\n".join(f"{size / 1e3:6.1f} kB {path}" for path, size in sorted(found.items(), key=lambda one: -one[1]))
    print(told)  # noqa: T201 - the figures of a passed test: pytest -rP
    assert max(found.values()) <= HEAVIEST, told
    assert min(found.values()) > 10_000, told  # every one was weighed
