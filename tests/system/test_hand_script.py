"""The script behind Done: what it may hide, and when a button can be pressed. The page is pretended, its clock is the test's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Route

from abbe.service.web.page import HERE
from tests.system.test_serve_page import browser

pytestmark = pytest.mark.browser
BASE = "http://127.0.0.1:9"
SCRIPT = (HERE / "static" / "hand.js").read_text(encoding="utf-8")
HELD: list[Route] = []
"""Words that the service has not answered yet."""


def card(job: str, prompt: int) -> str:
    button = f'<button data-job="{job}" data-prompt="{prompt}" data-csrf="c">Done</button>'
    return f'<section id="by-hand">{button}<span id="by-hand-alert"></span></section>'


def content(inside: str) -> str:
    return f'<main id="content">{inside}</main>'


@pytest.fixture
def screen(chromium: Browser) -> Iterator[Page]:
    """The home page with prompt 1 of job a, its second over; time stands still."""
    HELD.clear()
    with browser(chromium) as seen:
        page: Any = seen.page
        page.route(
            f"{BASE}/",
            lambda route: route.fulfill(
                content_type="text/html", body=f"{content(card('a', 1))}<script type=module src=/hand.js></script>"
            ),
        )
        page.route(f"{BASE}/hand.js", lambda route: route.fulfill(content_type="text/javascript", body=SCRIPT))
        page.route("**/done", lambda route: HELD.append(route))
        page.clock.install(time=0)
        page.goto(f"{BASE}/")
        page.clock.pause_at(100)
        assert pressable(page)
        yield page
        assert [one for one in seen.errors if "409" not in one] == []


def pressable(page: Page) -> bool:
    return page.locator("#by-hand button").is_enabled()


def replace(page: Page, inside: str) -> None:
    """What status.js does when something has changed."""
    page.evaluate("(html) => { document.getElementById('content').outerHTML = html; }", content(inside))


def answered(page: Page, status: int) -> None:
    """The service answers the word that was given, and the script is through with it."""
    with page.expect_response("**/done"):
        HELD.pop().fulfill(status=status, content_type="application/json", body='{"detail": "another prompt stands"}')
    page.evaluate("() => fetch('/hand.js').then((answer) => answer.text())")


def said(page: Page) -> None:
    with page.expect_request("**/done"):
        page.click("#by-hand button")


def test_an_answer_hides_its_own_card_and_no_other(screen: Page) -> None:
    said(screen)
    replace(screen, card("a", 2))
    answered(screen, 202)
    assert screen.is_visible("#by-hand")
    screen.clock.run_for(1000)
    said(screen)
    replace(screen, "")
    answered(screen, 202)
    replace(screen, card("a", 3))
    screen.clock.run_for(1000)
    said(screen)
    answered(screen, 409)
    assert screen.inner_text("#by-hand-alert") == "another prompt stands"
    said(screen)
    answered(screen, 202)
    assert not screen.is_visible("#by-hand")


@pytest.mark.parametrize(("job", "prompt"), [("a", 2), ("b", 1)])
def test_a_new_prompt_can_be_read_for_a_second_whatever_is_replaced(screen: Page, job: str, prompt: int) -> None:
    replace(screen, card(job, prompt))
    assert not pressable(screen)
    screen.clock.run_for(600)
    replace(screen, card(job, prompt))
    assert not pressable(screen), "the same prompt in another element"
    screen.clock.run_for(399)
    assert not pressable(screen)
    screen.clock.run_for(1)
    assert pressable(screen)
    replace(screen, card(job, prompt))
    assert pressable(screen), "it was read"
