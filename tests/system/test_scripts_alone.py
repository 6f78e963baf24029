"""What the scripts of the screens do about a service that is silent, comes back or refuses: in a real browser, over answers made here."""

from __future__ import annotations

import html
import json

import pytest
from playwright.sync_api import Browser, Page, Route

from abbe.service.web.language import SPAN_KEYS, catalogue
from abbe.service.web.page import HERE
from tests.system.serve_bench import free_port
from tests.system.test_serve_page import browser

pytestmark = pytest.mark.browser
OLD = "5 s ago, as the server has written it"
STATUS = {"revision": 7, "now_utc": "2026-11-22T12:00:00+00:00", "mqtt": {"waiting": 0}, "job": None}


def screen(main: str, *, script: str = "status", revision: str | None = None) -> str:
    words = html.escape(json.dumps({key: catalogue("en")[key] for key in SPAN_KEYS}))
    known = "" if revision is None else f' data-revision="{revision}"'
    return (
        f'<!doctype html><script type="module" src="/static/{script}.js"></script><body data-words="{words}">'
        f'<p id="lost" hidden>gone</p><main id="content"{known}>{main}</main>'
    )


def answered(page: Page, base: str, pages: list[str], asked: list[str]) -> None:
    """Answer everything under an address where nobody listens: the screens in turn, the last one again and again."""

    def answer(route: Route) -> None:
        path = route.request.url.removeprefix(base)
        asked.append(path)
        if path.startswith("/static/"):
            route.fulfill(path=HERE / path.lstrip("/"))
        elif path == "/api/v1/status":
            route.fulfill(json=STATUS)
        else:
            route.fulfill(body=pages.pop(0) if len(pages) > 1 else pages[0], content_type="text/html")

    page.route(f"{base}/**", answer)


def test_a_silent_screen_comes_back_as_itself_and_ages_stand_still(chromium: Browser) -> None:
    base, asked = f"http://127.0.0.1:{free_port()}", list[str]()
    with browser(chromium) as seen:
        page = seen.page
        page.clock.install()
        shown = screen(f'<h1>Schedule</h1><span id="age" data-since="2020-01-01T00:00:00+00:00">{OLD}</span>')
        answered(page, base, [screen("<h1>Silent</h1>", revision=""), shown], asked)
        page.goto(f"{base}/schedule")
        assert page.inner_text("h1") == "Silent"
        page.wait_for_selector("html[data-ready=yes]")
        page.clock.run_for(2000)
        page.wait_for_function("() => document.querySelector('h1').textContent === 'Schedule'")
        page.wait_for_selector("html[data-ready=yes]")
        for _ in range(2):  # when it asks once more, it has done with the answer before
            with page.expect_response("**/api/v1/status"):
                page.clock.run_for(2500)
        assert (page.inner_text("#age"), "/" in asked, page.url) == (OLD, False, f"{base}/schedule")


def test_a_refused_live_connection_is_told(chromium: Browser) -> None:
    base = f"http://127.0.0.1:{free_port()}"
    with browser(chromium) as seen:
        root = '<p id="live-lost" hidden>lost</p><section id="live" data-words="{}"></section>'
        answered(seen.page, base, [screen(root, script="live")], [])
        seen.page.goto(f"{base}/live")
        seen.page.wait_for_selector("#live-lost:not([hidden])", timeout=15_000)
