"""Administration in a real browser: users, own password and PIN, the machine file; by touches, in three sizes, light and dark."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page

from tests.pages_world import PHRASE, Served, filled_once, served
from tests.system.test_serve_page import ARTIFACTS
from tests.system.test_serve_screens import BROKEN, INSIDE, SIZES, SMALL, SPILT, Watch, axe, context, log_in, violations

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
__all__ = ["axe"]  # the fixture
NEW = "a quiet hall in autumn"
OVERLAPS = """() => {
  const all = [...document.querySelectorAll("button, input, select, .go, .tick")].filter(e => e.offsetParent && e.type !== "radio");
  const boxes = all.map(e => [e.textContent.trim() || e.name, e.getBoundingClientRect()]);
  const bad = [];
  boxes.forEach(([a, p], k) => boxes.slice(k + 1).forEach(([b, q]) => {
    if (p.right > q.left + 1 && q.right > p.left + 1 && p.bottom > q.top + 1 && q.bottom > p.top + 1) bad.push(`${a} over ${b}`);
  }));
  return bad;
}"""


@pytest.fixture
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(filled_once(tmp_path_factory)) as one:
        yield one


def faults(page: Page, axe: str, label: str) -> list[str]:
    """What is wrong with the screen, and a picture of it."""
    ARTIFACTS.mkdir(exist_ok=True)
    page.screenshot(path=ARTIFACTS / f"administration-{label}.png", full_page=True)
    found = [] if page.evaluate(INSIDE) else ["scrolls sideways"]
    for name, script in (("broken", BROKEN), ("spilt", SPILT), ("small", SMALL), ("overlap", OVERLAPS)):
        found += [f"{name} {one}" for one in page.evaluate(script)]
    return [f"{label}: {one}" for one in found + violations(page, axe, "{}")]


@pytest.mark.parametrize(("size", "scheme", "lang"), [("1280", "light", "en"), ("1024", "dark", "de"), ("390", "light", "ja")])
def test_the_screens_of_an_admin_fit_and_are_quiet(chromium: Browser, running: Served, axe: str, size: str, scheme: str, lang: str) -> None:
    with context(chromium, size, scheme, lang) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "adam")
        bad = []
        for path in ("/users", "/user?name=olga", "/settings", "/machine", "/administration"):
            page.goto(running.base + path)
            page.wait_for_selector("html[data-ready=yes]")
            page.evaluate("document.querySelectorAll('main details').forEach(one => { one.open = true; })")
            bad += faults(page, axe, f"{path.strip('/').partition('?')[0]}-{size}-{scheme}-{lang}")
        assert bad == []
        assert watch.errors == []
        assert watch.foreign == []


def test_an_admin_adds_a_user_who_sets_a_pin_and_logs_in_with_it_by_touch(chromium: Browser, running: Served, axe: str) -> None:
    with context(chromium, "1280") as made:
        page = made.new_page()
        log_in(page, running.base, "adam")
        page.click("a[href='/settings']:visible >> nth=0")
        page.click("a.go[href='/users']")
        page.fill("[name=name]", "nora")
        page.select_option("[name=role]", "operator")
        page.fill("[name=new]", "short but long")
        page.fill("[name=again]", "another one than that")
        page.click("form[action='/users/add'] button")
        page.wait_for_selector("form[action='/users/add'] [role=alert]:not(:empty)")
        for field in ("new", "again"):
            page.fill(f"[name={field}]", NEW)
        page.click("form[action='/users/add'] button")
        page.wait_for_selector("a[href='/user?name=nora']")
    for size, scheme in zip(SIZES, ("light", "dark", "light"), strict=True):
        with context(chromium, size, scheme) as made:
            page = made.new_page()
            watch = Watch(page, running.base)
            page.goto(f"{running.base}/login")
            page.fill("#name", "nora")
            page.fill("#password", NEW)
            page.click("button[type=submit]")
            page.wait_for_selector("html[data-ready=yes]")
            page.goto(f"{running.base}/settings")
            page.fill("form[action='/settings/pin'] [name=password] >> nth=0", NEW)
            page.fill("[name=pin]", "582914")
            page.click("form[action='/settings/pin'] button >> nth=0")
            page.wait_for_selector("form[action='/settings/pin'] >> nth=1")
            page.wait_for_selector("html[data-ready=yes]")  # a form that is sent before its scripts run lets the page ask once more
            page.click("#logout")
            page.wait_for_selector("#digits")
            assert faults(page, axe, f"pin-{size}-{scheme}") == []
            if size != "390":
                assert page.evaluate("document.querySelector('#digits').getBoundingClientRect().bottom <= innerHeight")
            for digit in "5829144":
                page.click(f"[data-digit='{digit}']")
            page.click("[data-digit='']")
            page.click("#digits [type=submit]")
            page.wait_for_selector("html[data-ready=yes]")
            assert page.inner_text(".logout .quiet") == "nora"
            assert watch.errors == []
            assert watch.foreign == []
    assert PHRASE not in str(running.store.audit.events())
