"""A panel that can be installed and survives a lost network: the server is really taken away, and comes back."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Error, Page, Route

from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.web.page import HERE
from tests.pages_world import PHRASE, filled_once, served
from tests.patience import within
from tests.scenarios.world import wait_for
from tests.system.serve_bench import Process, free_port, service
from tests.system.test_serve_page import ARTIFACTS
from tests.system.test_serve_screens import INSIDE, SMALL, axe, context, log_in, violations

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
__all__ = ["axe"]  # the fixture
SAME_COLOUR = "getComputedStyle(document.querySelector('#lost a')).color === getComputedStyle(document.querySelector('#lost')).color"
GREY = "getComputedStyle(document.querySelector('main')).filter"
KEPT = "caches.match('/', {cacheName: 'abbe-state-2'}).then(found => found ? found.text() : '')"


def test_the_last_state_stays_grey_with_its_time_and_stop_says_that_it_reaches_nobody(
    chromium: Browser, tmp_path_factory: pytest.TempPathFactory, axe: str
) -> None:
    filled = filled_once(tmp_path_factory)
    with context(chromium, "1024") as made:
        page = made.new_page()
        with served(filled) as one:
            base = one.base
            log_in(page, base, "olga")
            page.evaluate("navigator.serviceWorker.ready.then(() => 1)")
            page.goto(f"{base}/")
            page.wait_for_function("navigator.serviceWorker.controller !== null")
            page.goto(f"{base}/")
            page.wait_for_function(f"({KEPT}).then(text => text.length > 0)")
            text = page.evaluate(KEPT)
            assert re.search(r'data-csrf="[0-9a-f]+"|name="csrf" value="[0-9a-f]+"', text) is None, "no token of the session is kept"
            assert page.evaluate(GREY) == "none"
        page.wait_for_selector("#lost:visible", timeout=20_000)
        assert "grayscale" in page.evaluate(GREY)
        page.goto(f"{base}/runs")  # a touch anywhere leads to the last state, not to the browser's page of errors
        page.wait_for_selector("html[data-kept][data-ready=yes]")
        assert "You see the state of" in page.inner_text("#lost")
        assert "grayscale" in page.evaluate(GREY)
        assert page.inner_text(".strip .name") == filled.machine
        page.click("#stop")
        page.wait_for_selector("#stop-answer:not(:empty)")
        assert page.inner_text("#stop-answer").startswith("Not stopped: Abbe cannot be reached.")
        assert page.evaluate(INSIDE)
        assert page.evaluate(SMALL) == []
        ARTIFACTS.mkdir(exist_ok=True)
        page.screenshot(path=ARTIFACTS / "kiosk-lost-1024-light.png")
        page.emulate_media(color_scheme="dark")
        page.screenshot(path=ARTIFACTS / "kiosk-lost-1024-dark.png")
        with served(filled, port=urlsplit(base).port or 0):
            page.wait_for_selector("html:not([data-kept])[data-ready=yes]", timeout=20_000)
            assert page.evaluate(GREY) == "none"
            assert violations(page, axe, "{}") == []
            page.click("#logout")
            page.wait_for_url("**/login")
            page.wait_for_function(f"({KEPT}).then(text => text.length === 0)")


def kept(page: Page, base: str) -> None:
    """Log in, and wait until the service worker has kept the home page."""
    log_in(page, base, "olga")
    page.evaluate("navigator.serviceWorker.ready.then(() => 1)")
    for _ in range(2):
        page.goto(f"{base}/")
        page.wait_for_function("navigator.serviceWorker.controller !== null")
    page.wait_for_function(f"({KEPT}).then(text => text.length > 0)")


def test_a_server_that_never_answers_leaves_the_kept_page_grey_and_stop_works_as_soon_as_it_answers(
    chromium: Browser, tmp_path_factory: pytest.TempPathFactory
) -> None:
    filled = filled_once(tmp_path_factory)
    with context(chromium, "1024") as made:
        page = made.new_page()
        with served(filled) as one:
            base, port = one.base, urlsplit(one.base).port or 0
            kept(page, base)
            text = page.evaluate(KEPT)
            assert '<body class="stale" ' in text
            assert re.search(r'<p id="lost"[^>]*[^n]>Connection lost[^<]* You see the state of 2\d{3}-', text), "the banner needs no script"
            assert " hidden>Connection lost" not in text
        with socket.create_server(("127.0.0.1", port), backlog=200):  # it takes every connection and says nothing
            begun = time.monotonic()
            page.goto(f"{base}/", wait_until="commit")
            page.wait_for_selector("html[data-kept] #lost:visible", timeout=1e3 * within(20))
            painted = f"() => {GREY}.includes('grayscale') && performance.getEntriesByType('paint').length > 0"
            page.wait_for_function(painted, timeout=1e3 * within(20))
            page.wait_for_selector("html[data-ready=yes]", timeout=1e3 * within(20))
            assert time.monotonic() - begun < within(20)
            page.click("#stop")
            page.wait_for_selector("#stop-answer:not(:empty)", timeout=1e3 * within(20))
            assert page.inner_text("#stop-answer").startswith("Not stopped: Abbe cannot be reached.")
        pressed: list[str] = []

        def stopped(route: Route) -> None:
            if route.request.method == "GET":
                route.continue_()
                return
            pressed.append(route.request.headers["x-csrf-token"])
            route.fulfill(status=200, json={})

        page.route("**/api/v1/stop", stopped)
        page.route("**/api/v1/status", lambda route: route.abort())  # it has not seen yet that the service is back
        with served(filled, port=port):
            page.click("#stop")
            page.wait_for_selector("#stop-answer:has-text('Stopping')", timeout=1e3 * within(20))
            assert re.fullmatch(r"[0-9a-f]{64}", pressed[0]), "the token is that of the session"
            page.unroute("**/api/v1/status")
            page.wait_for_selector("html:not([data-kept])[data-ready=yes]", timeout=1e3 * within(30))


def stopped_at_the_page(page: Page, running: Process) -> None:
    """Stop is pressed and says so, and the axes are held. Where no check runs at this moment, it is pressed again."""

    def pressed() -> bool:
        with page.expect_response(lambda answer: answer.request.method == "POST" and answer.url.endswith("/api/v1/stop")) as told:
            page.click("#stop")
        assert told.value.status in {202, 409}
        return told.value.status == 202

    wait_for(pressed, within(60), "a check that can be stopped")
    page.wait_for_selector("#stop-answer:has-text('Stopping')", timeout=1e3 * within(20))
    running.expect("held")


def test_stop_works_after_the_log_in_ran_out_on_a_page_that_stayed_open_and_on_a_kept_one(
    chromium: Browser, tmp_path: Path, axe: str
) -> None:
    """A real core that measures; hours go by in the table of sessions."""
    url, port = f"sqlite:///{tmp_path / 'abbe.sqlite3'}", free_port()
    base = f"http://127.0.0.1:{port}"
    with Store.open(url) as store:
        UserAccounts(store, SystemClock(), Passwords(memory_kib=64, passes=1)).add("olga", "operator", PHRASE)
        with context(chromium, "1024") as made:
            page = made.new_page()
            with closing(service(tmp_path, schedules=[["endless", "* * * * * *", "endless"]], port=port)) as running:
                running.expect('"page up"')
                kept(page, base)
                with store.engine.begin() as connection:
                    connection.exec_driver_sql("UPDATE sessions SET seen_utc = '2026-01-01T00:00:00.000000Z'")
                page.wait_for_selector("#lost a[href='/login']", timeout=1e3 * within(20))
                assert urlsplit(page.url).path == "/", "the screen with Stop stays"
                assert "grayscale" in page.evaluate(GREY)
                assert page.evaluate(SAME_COLOUR), "a link on the banner is read as its text is"
                stopped_at_the_page(page, running)
                running.terminate()
            page.goto(f"{base}/")
            page.wait_for_selector("html[data-kept][data-ready=yes]")
            with closing(service(tmp_path, schedules=[["endless", "* * * * * *", "endless"]], port=port)) as running:
                running.expect('"page up"')
                page.wait_for_selector("#lost a[href='/login']", timeout=1e3 * within(20))
                assert page.locator("html[data-kept]").count() == 1
                stopped_at_the_page(page, running)
                asking = made.new_page()
                asking.goto(f"{base}/runs")
                asking.wait_for_url("**/login")
                assert violations(asking, axe, "{}") == []
                stopped_at_the_page(asking, running)  # who touches another screen is asked to log in, and can stop there too
                asking.close()
                with store.engine.begin() as connection:
                    connection.exec_driver_sql("UPDATE sessions SET ended_utc = seen_utc")
                page.wait_for_url("**/login", timeout=1e3 * within(20))  # logged out elsewhere: nothing is left that could stop
        done = [(r.who, r.outcome) for r in store.audit.events(1000) if r.action == "POST /api/v1/stop" and r.outcome.startswith("done")]
        assert done == [("user:olga", "done 202")] * 3


def test_a_kept_state_ends_after_twelve_hours(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> None:
    older = """async (hours) => {
      const state = await caches.open('abbe-state-2');
      const kept = await state.match('/');
      const headers = new Headers(kept.headers);
      headers.set('X-Kept-Ms', Number(headers.get('X-Kept-Ms')) - hours * 3600e3);
      await state.put('/', new Response(await kept.text(), { headers }));
    }"""
    with context(chromium) as made:
        page = made.new_page()
        with served(filled_once(tmp_path_factory)) as one:
            kept(page, one.base)
            page.goto(f"{one.base}/runs")
            page.evaluate(older, 11.9)
        page.goto(f"{one.base}/")
        page.wait_for_selector("html[data-kept]")
        page.evaluate(older, 0.2)
        with pytest.raises(Error, match="ERR_"):
            page.goto(f"{one.base}/")


class Slow(BaseHTTPRequestHandler):
    """A home page whose body comes 7 s after its headers, and a file."""

    def do_GET(self) -> None:
        """Answer at once with headers."""
        kinds = {"/": "text/html", "/sw.js": "text/javascript"}
        self.send_response(200)
        self.send_header("Content-Type", kinds.get(self.path, "text/plain"))
        self.end_headers()
        if self.path == "/sw.js":
            self.wfile.write(re.sub(rb"const FRAME = .*", b"const FRAME = [];", (HERE / "static" / "sw.js").read_bytes()))
            return
        self.wfile.write(b"begun<script>navigator.serviceWorker.register('/sw.js')</script>" if self.path == "/" else b"begun")
        self.wfile.flush()
        if self.path == "/?slow":
            threading.Event().wait(7)
        self.wfile.write(b"<p id=end>all of it")

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


def test_the_service_worker_cuts_no_body_and_leaves_files_to_the_network(chromium: Browser) -> None:
    with context(chromium) as made, ThreadingHTTPServer(("127.0.0.1", 0), Slow) as server:
        threading.Thread(target=server.serve_forever).start()
        page, base = made.new_page(), f"http://127.0.0.1:{server.server_port}"
        try:
            page.goto(f"{base}/")
            page.wait_for_function("navigator.serviceWorker.controller !== null")
            slow = page.goto(f"{base}/?slow", timeout=1e3 * within(30))
            assert slow is not None
            assert slow.from_service_worker
            assert "all of it" in page.content()
            for path in ("/api/v1/reports/run/1", "/support.zip"):
                file = page.goto(base + path)
                assert file is not None
                assert not file.from_service_worker
        finally:
            server.shutdown()


def test_a_browser_can_install_it(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> None:
    with served(filled_once(tmp_path_factory)) as one, context(chromium) as made:
        page = made.new_page()
        page.goto(f"{one.base}/login")
        session = made.new_cdp_session(page)
        told = session.send("Page.getAppManifest")
        assert told["errors"] == []
        manifest = json.loads(told["data"])
        assert (manifest["start_url"], manifest["display"]) == ("/", "standalone")
        for icon in manifest["icons"]:
            assert page.request.get(one.base + icon["src"]).headers["content-type"].startswith("image/svg")
        policy = page.request.get(f"{one.base}/sw.js").headers
        assert "default-src 'self'" in policy["content-security-policy"]
        assert policy["cache-control"] == "no-cache"
