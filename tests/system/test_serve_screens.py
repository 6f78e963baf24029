"""Every screen with real data in a real browser: quiet, within its width, usable by everybody, and nothing from a store is ever run.

The whole matrix (two sizes, light and dark, four languages, every screen, axe-core on each) runs with ABBE_TEST_LONG=1; otherwise each size
and scheme is walked once, the first time with all of axe-core, the second time with its rule of contrast.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

from service.audit.chain import Event
from tests.pages_world import PHRASE, PROPOSER, Filled, Served, fill, screens, served
from tests.system.serve_bench import require
from tests.system.test_serve_page import ARTIFACTS, QUIET

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
SIZES = {"1280": {"width": 1280, "height": 768}, "1920": {"width": 1920, "height": 1080}}
SHORT = [("1280", "light", "de", "{}"), ("1920", "dark", "ko", "{runOnly: ['color-contrast']}")]
WALKS = [(*one, "{}") for one in product(SIZES, ("light", "dark"), ("en", "de", "ja", "ko"))] if LONG else SHORT
EVIL = '"\'><script>hit()</script><img src=x onerror="hit()"></title></svg><svg onload="hit()">{{7*7}}'
INSIDE = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
SMALL = """() => [...document.querySelectorAll('.bar a, .languages a, button, select')].filter(e => e.offsetParent)
  .map(e => [e.textContent.trim().slice(0, 20), e.getBoundingClientRect()]).filter(([, r]) => r.height < 43.5 || r.width < 43.5)
  .map(([text, r]) => `${text}: ${r.width} x ${r.height}`)"""


class Watch:
    """What a page asked for and complained about."""

    def __init__(self, page: Page, base: str) -> None:
        self.foreign: list[str] = []
        self.errors: list[str] = []
        page.on("request", lambda request: None if request.url.startswith(base) else self.foreign.append(request.url))
        page.on("console", lambda message: self.errors.append(message.text) if message.type in {"error", "warning"} else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=require("chromium"), args=QUIET)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    return fill(tmp_path_factory.mktemp("screens"))


@pytest.fixture(scope="module")
def running(filled: Filled) -> Iterator[Served]:
    with served(filled) as one:
        yield one


@pytest.fixture(scope="module")
def axe() -> str:
    spec = importlib.util.find_spec("axe_playwright_python")
    if spec is None or spec.origin is None:
        pytest.fail("axe-core is not installed: it is in the developers' packages (axe-playwright-python)")
    return (Path(spec.origin).parent / "axe.min.js").read_text(encoding="utf-8")


@contextmanager
def context(chromium: Browser, size: str = "1280", scheme: str = "light", lang: str = "en") -> Iterator[BrowserContext]:
    made: Any = chromium.new_context(viewport=SIZES[size], color_scheme=scheme, locale=lang)
    try:
        yield made
    finally:
        made.close()


def log_in(page: Page, base: str, name: str) -> None:
    page.goto(f"{base}/login")
    page.fill("#name", name)
    page.fill("#password", PHRASE)
    page.click("button[type=submit]")
    page.wait_for_selector("html[data-ready=yes]")


def violations(page: Page, axe: str, rules: str) -> list[str]:
    page.evaluate(axe)
    found = page.evaluate(f"axe.run(document, {rules})")["violations"]
    return [f"{v['id']}: {n['target']} {n['failureSummary'][:160]}" for v in found for n in v["nodes"][:3]]


@pytest.mark.parametrize(("size", "scheme", "lang", "rules"), WALKS)
def test_every_screen_is_quiet_and_fits(chromium, running, axe, size, scheme, lang, rules) -> None:
    bad: list[str] = []
    ARTIFACTS.mkdir(exist_ok=True)
    with context(chromium, size, scheme, lang) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "anna")
        for path in screens(running.filled):
            answer = page.goto(running.base + path, wait_until="load")
            page.wait_for_selector("html[data-ready=yes]")
            bad += [] if answer is not None and answer.status == 200 else [f"{path}: {answer}"]
            bad += [] if page.get_attribute("html", "lang") == lang else [f"{path}: not in {lang}"]
            bad += [] if page.evaluate(INSIDE) else [f"{path}: scrolls sideways"]
            bad += [f"{path}: small target {one}" for one in page.evaluate(SMALL)]
            bad += [f"{path}: {one}" for one in violations(page, axe, rules)]
            if LONG or scheme == "light":
                name = path.strip("/").replace("?", "-").replace("=", "-") or "home"
                page.screenshot(path=ARTIFACTS / f"screen-{name}-{size}-{scheme}-{lang}.png")
        assert bad == []
        assert watch.errors == []
        assert watch.foreign == []


def test_nothing_from_a_store_is_run(chromium, tmp_path) -> None:
    """The payload stands in every name, note, address and refusal there is; it is shown, and never run."""
    filled = fill(tmp_path, EVIL)
    hits: list[int] = []
    with served(filled) as one, context(chromium) as made:
        one.door.book.write(Event(EVIL, EVIL, EVIL, EVIL, {"note": EVIL}))
        one.board.job_started(filled.schedules[0], one.door.store._utcnow())
        page = made.new_page()
        page.expose_function("hit", lambda: hits.append(1))
        watch = Watch(page, one.base)
        log_in(page, one.base, "anna")
        shown = 0
        for path in [*screens(filled), f"/runs?campaign={EVIL}", f"/runs?test={EVIL}"]:
            page.goto(one.base + path, wait_until="load")
            page.wait_for_selector("html[data-ready=yes]")
            shown += page.inner_text("body").count("<script>hit()</script>")
            assert page.locator("img, script:not([src]), [onload], [onerror]").count() == 0, path
            assert "49" not in page.title(), path
        assert shown > 60
        assert hits == []
        assert watch.errors == []
        assert watch.foreign == []


def test_a_proposal_is_approved_by_another_person_than_its_proposer(chromium, running) -> None:
    number = running.filled.proposals[2]
    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, PROPOSER)
        page.goto(f"{running.base}/proposal?id={number}")
        assert page.locator("form[action='/proposal/approve']").count() == 0
        page.click(".logout button")
        page.wait_for_url("**/login")
        log_in(page, running.base, "anna")
        page.goto(f"{running.base}/proposal?id={number}")
        assert page.inner_text(".verdict").endswith("proposed")
        page.select_option("select[name=hours]", "8.0")
        page.click("form[action='/proposal/approve'] button")
        page.wait_for_selector(".verdict.pass, .verdict .pass")
        assert page.inner_text(".verdict").endswith("approved")
        assert "Approved by anna" in page.inner_text("main")
        assert watch.errors == []
        told = running.store.approvals(number)
        assert [(a.name, a.login) for a in told] == [("anna", "user:anna")]
        record = running.store.audit(1)[0]
        assert (record.who, record.action, record.target) == ("user:anna", "POST /proposal/approve", f"proposal {number}")
        # One that has reasons against it says why on the screen; nothing is stored.
        page.goto(f"{running.base}/proposal?id={number}")
        page.evaluate(f"document.querySelector('input[name=number]').value = '{running.filled.proposals[0]}'")
        page.click("form[action='/proposal/approve'] button")
        page.wait_for_selector("form [role=alert]:not(:empty)")
        assert "has reasons against it" in page.inner_text("form .fail")
        assert running.store.approvals(running.filled.proposals[0]) == []


def test_keyboard_language_and_first_paint(chromium, running) -> None:
    with context(chromium) as made:
        page = made.new_page()
        log_in(page, running.base, "vera")
        assert page.locator(".screens a").count() == 7, "a viewer is not led to the audit"
        page.goto(f"{running.base}/")
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.className") == "skip"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "content"
        assert page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime") < 5000.0
        page.click(".languages a[hreflang=ko]")
        page.wait_for_selector("html[lang=ko][data-ready=yes]")
        page.goto(f"{running.base}/runs")
        assert page.get_attribute("html", "lang") == "ko"
        assert "측정" in page.inner_text("h1")


def test_a_screen_says_when_the_service_is_gone(chromium, filled) -> None:
    with context(chromium) as made:
        page = made.new_page()
        with served(filled) as one:
            log_in(page, one.base, "vera")
            page.goto(f"{one.base}/schedule")
            page.wait_for_selector("html[data-ready=yes]")
            assert not page.locator("#lost").is_visible()
        page.wait_for_selector("#lost:visible", timeout=10_000)
        assert page.evaluate("document.body.classList.contains('stale')")
