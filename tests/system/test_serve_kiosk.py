"""A panel that can be installed and survives a lost network: the server is really taken away, and comes back."""

from __future__ import annotations

import json
import re
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser

from tests.pages_world import filled_once, served
from tests.system.test_serve_page import ARTIFACTS
from tests.system.test_serve_screens import INSIDE, SMALL, axe, context, log_in, violations

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
__all__ = ["axe"]  # the fixture
GREY = "getComputedStyle(document.querySelector('main')).filter"
KEPT = "caches.match('/', {cacheName: 'abbe-state-1'}).then(found => found ? found.text() : '')"


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
            kept = page.evaluate(KEPT)
            assert re.search(r'data-csrf="[0-9a-f]+"|name="csrf" value="[0-9a-f]+"', kept) is None, "no token of the session is kept"
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
