"""What the scripts of the screens do about a service that is silent, comes back or refuses: in a real browser, over answers made here."""

from __future__ import annotations

import html
import json
from typing import Any

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


def test_the_way_to_log_in_comes_back_after_a_lost_request_and_only_screens_that_stop_stay(chromium: Browser) -> None:
    base, lost = f"http://127.0.0.1:{free_port()}", list[bool]()

    def out(route: Route) -> None:
        if lost:
            route.abort()
        else:
            route.fulfill(status=401, json={})

    with browser(chromium) as seen:
        page = seen.page
        page.clock.install()
        answered(page, base, [screen("<h1>Some screen</h1>")], [])
        page.route(f"{base}/api/v1/status", out)
        page.goto(f"{base}/live")
        page.wait_for_selector("html[data-ready=yes]")
        for gone in (False, True, False):
            lost[:] = [gone] * gone
            page.clock.run_for(2500)
            page.wait_for_selector("#lost:not(:has(a))" if gone else "#lost a[href='/login']")
        assert page.url == f"{base}/live"
        page.goto(f"{base}/audit")
        page.wait_for_selector("html[data-ready=yes]")
        page.clock.run_for(2500)
        page.wait_for_url("**/login")


def test_a_refused_live_connection_is_told(chromium: Browser) -> None:
    base = f"http://127.0.0.1:{free_port()}"
    with browser(chromium) as seen:
        root = '<p id="live-lost" hidden>lost</p><section id="live" data-words="{}"></section>'
        answered(seen.page, base, [screen(root, script="live")], [])
        seen.page.goto(f"{base}/live")
        seen.page.wait_for_selector("#live-lost:not([hidden])", timeout=15_000)


@pytest.mark.parametrize("answer", ["refused", "another screen"])
def test_a_report_that_could_not_be_made_is_told_with_a_way_to_try_again(chromium: Browser, answer: str) -> None:
    base = f"http://127.0.0.1:{free_port()}"
    waits = '<p>It follows</p><p hidden>It could not be made <a href="/run?id=1">Try again</a></p>'
    main = f'<section data-run="1"><canvas></canvas></section><div id="run-report" data-from="/whole" aria-busy="true">{waits}</div>'
    with browser(chromium) as seen:
        answered(seen.page, base, [screen(main, script="late"), screen("<h1>Log in</h1>", script="late")], [])
        if answer == "refused":
            seen.page.route(f"{base}/whole", lambda route: route.fulfill(status=503, body=""))
        seen.page.goto(f"{base}/run?id=1")
        seen.page.wait_for_selector("#run-report:not([aria-busy]) a")
        assert seen.page.inner_text("#run-report").strip() == "It could not be made Try again"


def test_the_machine_disappears_when_it_says_nothing_new_and_a_reading_of_the_laser_is_drawn_once(chromium: Browser) -> None:
    base = f"http://127.0.0.1:{free_port()}"
    dro = "".join(f'<dd id="dro-{name}"></dd>' for name in ("x", "y", "z", "feed", "door", "air"))
    main = f'<dl id="dro" hidden>{dro}</dl><canvas id="strip"></canvas><section id="live" data-mm="1"></section>'
    tell = """async ([at, laserAt]) => {
      const { Machine } = await import('/static/machine.js');
      const machine = (globalThis.machine ??= new Machine(document.getElementById('live'), {}));
      const reading = { at_ms: at, position_mm: [1, 2, 3], feed_mm_min: 0, override_percent: null, door_open: false, air_c: null };
      machine.show({ ...reading, laser_at_ms: laserAt, laser_mm: laserAt, beam_good: true });
      machine.hideOld();
      return [!document.getElementById('dro').hidden, machine.readings.map(([when]) => when), machine.hasLaser];
    }"""
    with browser(chromium) as seen:
        page = seen.page
        page.clock.install()
        answered(page, base, [screen(main, script="pad")], [])
        page.goto(f"{base}/live")
        page.clock.pause_at("2030-01-01")
        assert page.evaluate(tell, [1.0, 10.0]) == [True, [10.0], False]
        assert page.inner_text("#dro-feed") == "0 (– %)", "the control has told no override that can be"
        assert page.evaluate(tell, [2.0, 10.0]) == [True, [10.0], False], "the reading is the same one"
        assert page.evaluate(tell, [3.0, 11.0]) == [True, [10.0, 11.0], True]
        page.clock.fast_forward(4900)
        assert page.evaluate(tell, [3.0, 11.0]) == [True, [10.0, 11.0], True]
        page.clock.fast_forward(200)
        assert page.evaluate(tell, [3.0, 11.0]) == [False, [10.0, 11.0], False], "an old answer is not shown again by being told again"
        assert page.evaluate(tell, [4.0, 11.0]) == [True, [10.0, 11.0], False]


@pytest.mark.parametrize(("alarm", "answer"), [(0, 202), (3, 202), (3, 409)])
def test_a_start_says_for_which_alarm_and_a_refusal_why(chromium: Browser, alarm: int, answer: int) -> None:
    base, sent = f"http://127.0.0.1:{free_port()}", list[dict[str, Any]]()
    data = f'data-recipe="identification" data-rate="100" data-alarm="{alarm}" data-key="k" data-csrf="c"'
    form = f'<form id="start" {data}><input type="checkbox" required><button>Start</button><span role="alert"></span></form>'

    def start(route: Route) -> None:
        sent.append(route.request.post_data_json)
        route.fulfill(status=answer, json={"detail": "alarm 3 is over"})

    with browser(chromium) as seen:
        page = seen.page
        answered(page, base, [screen(form, script="new"), screen("<h1>Live</h1>", script="pad")], [])
        page.route(f"{base}/api/v1/jobs", start)
        page.goto(f"{base}/new?recipe=identification")
        page.click("button")
        assert sent == [], "nothing moves before the checklist is confirmed"
        page.check("input")
        page.click("button")
        if answer == 202:
            page.wait_for_url("**/live")
        else:
            page.wait_for_selector("[role=alert]:has-text('alarm 3 is over')")
    assert sent == [{"recipe": "identification", "rate_hz": 100, "alarm": alarm}]
