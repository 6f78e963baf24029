"""The page in a real browser: what it shows, that it asks nobody else, and that it notices when the service is gone."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from abbe.drivers.errors import LinkDown
from abbe.service.domain.progress import Progress
from abbe.service.domain.schedule import Schedule
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from tests.pages_world import Filled, Served, served
from tests.system.serve_bench import chromium_program, free_port, service
from tests.system.serve_check import Result
from tests.system.test_serve_users import PHRASE, add_user

pytestmark = pytest.mark.browser

ARTIFACTS = Path(__file__).parents[2] / "artifacts"
QUIET = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
WEEKLY = Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "quick-check")
TIMETABLE = [["weekly", "0 6 * * 1", "quick"], ["night", "30 2 1 1 *", "quick"]]


@dataclass
class Seen:
    """What the browser asked for and complained about."""

    page: Page
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)


@contextmanager
def launched(*more: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=chromium_program(), args=[*QUIET, *more])
        try:
            yield chromium
        finally:
            chromium.close()


@contextmanager
def browser(chromium: Browser | None = None, **context: Any) -> Iterator[Seen]:
    """A page in a browser that runs, or in one of its own."""
    with ExitStack() as stack:
        running = chromium or stack.enter_context(launched())
        page = stack.enter_context(closing(running.new_page(viewport={"width": 1280, "height": 768}, **context)))
        seen = Seen(page)
        page.on("request", lambda request: seen.requests.append(request.url))
        page.on("console", lambda message: seen.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: seen.errors.append(str(error)))
        yield seen


def fill(folder: Path, weeks: int) -> None:
    """Store a history that ends in a failure, with one check that could not be completed."""
    now = datetime.now(UTC)
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        machine = store.machines.add("mill-7", {"name": "mill-7"})
        for week in range(weeks):
            at = now - timedelta(days=7 * (weeks - 1 - week), hours=3)
            occasion = verify.Occasion("mill-7", WEEKLY, at)
            if week == weeks - 3:
                doc = verify.failed_doc(
                    occasion, LinkDown("modbus+tcp://127.0.0.1:5021", "connect", "connection refused", "is the laser on?"), at, 5.0
                )
            else:
                drift = 11.0 + 0.02 * week**2 + 1.2 * math.sin(1.7 * week)
                verdict = "fail" if drift - 1.1 > 20 else "pass" if drift + 1.1 <= 20 else "cannot tell"
                text = f"{verdict}: worst body diagonal {drift:.1f} µm (limit 20)"
                values = {
                    "diagonal_ppp_um": drift - 3,
                    "diagonal_npp_um": drift,
                    "body_diagonal_um": drift,
                    "helix_rms_um": 1.2 + 0.1 * week + 0.2 * math.cos(week),
                }
                result = Result(
                    verdict, values, text=text, started_utc=at, duration_s=312.0, campaign=f"quick-check {at:%Y-%m-%d %H:%M:%S}"
                )
                doc = verify.check_doc(occasion, result)
            store.verifications.add_with_messages(machine, doc, [])


def shot(page: Page, name: str, *, full: bool = False) -> None:
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / name, full_page=full)


def open_page(seen: Seen, where: int | str) -> None:
    """``where``: a port, or an address."""
    seen.page.goto(f"http://127.0.0.1:{where}/" if isinstance(where, int) else f"{where}/")
    seen.page.wait_for_selector("html[data-ready=yes]")


def only_us(seen: Seen) -> bool:
    return bool(seen.requests) and all(url.startswith("http://127.0.0.1:") for url in seen.requests)


@contextmanager
def serving(folder: Path, weeks: int = 0) -> Iterator[Served]:
    """The page over so many weeks of checks, without a process of its own."""
    if weeks:
        fill(folder, weeks)
    with served(Filled(f"sqlite:///{folder / 'abbe.sqlite3'}", "mill-7", [WEEKLY], {}, "", 0, [], 0), users=False) as one:
        yield one


def test_history_in_the_browser(tmp_path: Path, chromium: Browser) -> None:
    with serving(tmp_path, 24) as one, browser(chromium) as seen:
        open_page(seen, one.base)
        assert seen.page.locator("tr[data-id]").count() == 20
        assert seen.page.locator(".verdict").inner_text() == "✖ fail"
        assert seen.page.locator("svg.trend").count() == 2
        assert seen.page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), "scrolls sideways"
        shot(seen.page, "serve-history.png")
        shot(seen.page, "serve-history-full.png", full=True)
        assert seen.errors == []
        assert only_us(seen)


def test_it_refreshes_itself_and_says_when_the_service_is_gone(tmp_path: Path, chromium: Browser) -> None:
    port = free_port()
    with closing(service(tmp_path, schedules=[["fast", "* * * * * *", "quick"]], port=port)) as running, browser(chromium) as seen:
        running.expect("planned")
        open_page(seen, port)
        seen.page.locator("tr[data-id]").nth(1).wait_for(timeout=20_000)
        assert seen.page.locator(".verdict").inner_text() == "✔ pass"
        assert not seen.page.locator("#lost").is_visible()
        assert seen.errors == []
        assert running.terminate()[0] == 0
        seen.page.wait_for_selector("#lost:visible", timeout=10_000)
        assert seen.page.evaluate("document.body.classList.contains('stale')")
        shot(seen.page, "serve-lost.png")
        assert only_us(seen)


def test_a_running_check_in_dark_colours(tmp_path: Path, chromium: Browser) -> None:
    with serving(tmp_path, 9) as one, browser(chromium, color_scheme="dark") as seen:
        one.board.job_started(WEEKLY, datetime.now(UTC))
        one.board.job_progress(Progress("helix", 1, 2, 0.1, "revolution 1 of 2"))
        open_page(seen, one.base)
        assert seen.page.locator(".state").inner_text().endswith("measuring")
        assert seen.page.locator("#job-stage").inner_text() == "helix"
        assert float(seen.page.locator("#job-bar").get_attribute("value") or "nan") == 1.0
        shot(seen.page, "serve-dark.png")
        assert seen.errors == []


def test_empty_page(tmp_path: Path, chromium: Browser) -> None:
    with serving(tmp_path) as one, browser(chromium) as seen:
        open_page(seen, one.base)
        assert "No check has been made yet" in seen.page.locator("main").inner_text()
        shot(seen.page, "serve-empty.png")
        assert seen.errors == []


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="two services and a browser: ABBE_TEST_LONG=1 runs it")
def test_logged_in_to_two_services_and_out_of_one(tmp_path: Path, chromium: Browser) -> None:
    """By the form and the button, in one browser: its cookies go to every port of a host."""
    ports = free_port(), free_port()
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
        add_user(folder)
    with ExitStack() as stack:
        for folder, port in zip(folders, ports, strict=True):
            running = stack.enter_context(closing(service(folder, schedules=TIMETABLE, port=port)))
            running.expect("planned")
        seen = stack.enter_context(browser(chromium))
        for port in ports:
            seen.page.goto(f"http://127.0.0.1:{port}/")
            seen.page.fill("#name", "ana")
            seen.page.fill("#password", PHRASE)
            seen.page.click("button[type=submit]")
            seen.page.wait_for_selector("#logout")
        open_page(seen, ports[0])
        assert seen.page.locator("#logout").is_visible()
        shot(seen.page, "serve-logged-in.png")
        open_page(seen, ports[1])
        seen.page.click("#logout")
        seen.page.wait_for_url(f"http://127.0.0.1:{ports[1]}/login")
        seen.page.goto(f"http://127.0.0.1:{ports[1]}/")
        assert seen.page.url.endswith("/login")
        open_page(seen, ports[0])
        assert seen.page.locator(".logout .quiet").inner_text() == "ana"
        assert seen.errors == []
        assert only_us(seen)
