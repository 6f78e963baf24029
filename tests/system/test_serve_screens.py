"""Every screen with real data in a real browser: quiet, within its width, usable by everybody, and nothing from a store is ever run.

The whole matrix (three sizes, light and dark, four languages, every screen, axe-core and a picture of each) runs with ABBE_TEST_LONG=1;
otherwise every screen is seen once with all of axe-core, and every third one in the other size and scheme with its rule of contrast.
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
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Route

from abbe.service.domain.service_records import AuditEvent
from abbe.service.web.page import has_uplot
from tests.pages_world import PHRASE, PROPOSER, Filled, Served, fill, filled_once, screens, served
from tests.system.test_serve_page import ARTIFACTS

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
SIZES = {"1280": {"width": 1280, "height": 800}, "1024": {"width": 1024, "height": 600}, "390": {"width": 390, "height": 844}}
SHORT = [("1280", "light", "de", "{}"), ("390", "dark", "ko", "{runOnly: ['color-contrast']}")]
WALKS = [(*one, "{}") for one in product(SIZES, ("light", "dark"), ("en", "de", "ja", "ko"))] if LONG else SHORT
EVIL = '"\'><script>hit()</script><img src=x onerror="hit()"></title></svg><svg onload="hit()">{{7*7}}'
INSIDE = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
TARGETS = ".strip a, .bar a, .languages a, button, select, summary, label.tick, .filter input, a.button"
SMALL = (
    f"() => [...document.querySelectorAll('{TARGETS}')]"
    + """.filter(e => e.offsetParent)
  .map(e => [e.textContent.trim().slice(0, 20), e.getBoundingClientRect()]).filter(([, r]) => r.height < 43.5 || r.width < 43.5)
  .map(([text, r]) => `${text}: ${r.width} x ${r.height}`)"""
)

BROKEN = """() => [...document.querySelectorAll("main th, main td, main dt, .strip *, .bar *")].flatMap(cell => {
  if (!cell.offsetParent) return [];
  const walk = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT), found = [];
  for (let node = walk.nextNode(); node; node = walk.nextNode())
    for (const word of node.data.matchAll(/[\\p{Script=Latin}\\d]{2,12}/gu)) {
      const range = document.createRange();
      range.setStart(node, word.index);
      range.setEnd(node, word.index + word[0].length);
      if (new Set([...range.getClientRects()].map(r => Math.round(r.top))).size > 1) found.push(word[0]);
    }
  return found;
})"""
"""Words of a table that are broken inside."""


SPILT = """() => [...document.querySelectorAll("main td, main th, main a, main button, main p, main dd, main li > span")].filter(e => {
  if (!e.offsetParent || e.closest(".scroll, .log, svg, .stage, .sr")) return false;
  const far = e.getBoundingClientRect().right > innerWidth + 1;
  return far || (getComputedStyle(e).display !== "inline" && e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1);
}).map(e => e.textContent.trim().slice(0, 30))"""
"""What stands out of its box, or of the window, where nothing scrolls."""


class Watch:
    """What a page asked for and complained about."""

    def __init__(self, page: Page, base: str) -> None:
        self.foreign: list[str] = []
        self.errors: list[str] = []
        page.on("request", lambda request: None if request.url.startswith(base) else self.foreign.append(request.url))
        page.on("console", self._complained)
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def _complained(self, message: ConsoleMessage) -> None:
        # The last is the browser's own: without a GPU it reads a canvas of WebGL back for every screenshot.
        if message.type in {"error", "warning"} and "GPU stall due to ReadPixels" not in message.text:
            self.errors.append(f"{message.text} {message.location.get('url', '')}".strip())


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    return filled_once(tmp_path_factory)


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
    found = page.evaluate(f"axe.run(document, {{...{rules}, resultTypes: ['violations']}}).then((told) => told.violations)")
    return [f"{v['id']}: {n['target']} {n['failureSummary'][:160]}" for v in found for n in v["nodes"][:3]]


def walked(addresses: list[str], scheme: str) -> list[str]:
    """All addresses in the long run; in every run one address of each screen in light, and every third address in dark."""
    if LONG:
        return addresses
    screens_once = {address.partition("?")[0]: address for address in addresses[::-1]}
    return list(screens_once.values()) if scheme == "light" else addresses[::3]


@pytest.mark.parametrize(("size", "scheme", "lang", "rules"), WALKS)
def test_every_screen_is_quiet_and_fits(chromium, running, axe, size, scheme, lang, rules) -> None:
    bad: list[str] = []
    ARTIFACTS.mkdir(exist_ok=True)
    with context(chromium, size, scheme, lang) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "anna")
        for path in walked(screens(running.filled), scheme):
            answer = page.goto(running.base + path, wait_until="load")
            page.wait_for_selector("html[data-ready=yes]")
            bad += [] if answer is not None and answer.status == 200 else [f"{path}: {answer}"]
            bad += [] if page.get_attribute("html", "lang") == lang else [f"{path}: not in {lang}"]
            bad += [] if page.evaluate(INSIDE) else [f"{path}: scrolls sideways"]
            bad += [f"{path}: broken word {one}" for one in page.evaluate(BROKEN)]
            bad += [f"{path}: spilt {one}" for one in page.evaluate(SPILT)]
            bad += [f"{path}: small target {one}" for one in page.evaluate(SMALL)]
            bad += [f"{path}: {one}" for one in violations(page, axe, rules)]
            if LONG:
                name = path.strip("/").replace("?", "-").replace("=", "-") or "home"
                page.screenshot(path=ARTIFACTS / f"screen-{name}-{size}-{scheme}-{lang}.png")
        assert bad == []
        assert watch.errors == []
        assert watch.foreign == []


@pytest.mark.parametrize("lang", ("en", "de", "ja", "ko") if LONG else ("de",))
def test_the_bar_is_one_row_and_its_last_entry_opens_by_keyboard(chromium, running, axe, lang) -> None:
    with context(chromium, "1280", "light", lang) as made:
        page = made.new_page()
        log_in(page, running.base, "anna")
        assert page.evaluate("document.querySelector('.bar').getBoundingClientRect().height") < 60
        page.focus(".more summary")
        page.keyboard.press("Enter")
        assert page.evaluate("document.querySelector('.more').open")
        assert page.evaluate(SMALL) == []
        assert page.evaluate(INSIDE)
        assert violations(page, axe, "{runOnly: ['color-contrast']}") == []
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.getAttribute('href')") == "/discoveries"
        page.click(".more a[href='/settings']")
        page.select_option("[name=units]", "inch")
        page.select_option("[name=theme]", "dark")
        page.click("form.filter button")
        page.wait_for_selector("html[data-theme=dark]")
        page.goto(f"{running.base}/trends")
        page.wait_for_selector("html[data-theme=dark][data-ready=yes]")
        assert "µin" in page.inner_text("table.list")
        assert violations(page, axe, "{runOnly: ['color-contrast']}") == []


def test_nothing_from_a_store_is_run(chromium, tmp_path, tmp_path_factory) -> None:
    """The payload stands in every name, note, address and refusal there is; it is shown, and never run."""
    filled = fill(tmp_path_factory, tmp_path, EVIL)
    hits: list[int] = []
    with served(filled) as one, context(chromium) as made:
        one.auth.book.write(AuditEvent(who=EVIL, action=EVIL, target=EVIL, outcome=EVIL, doc={"note": EVIL}))
        one.board.job_started(filled.schedules[0], one.auth.store.utcnow())
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


def sign(page: Page) -> None:
    page.check("form.sign [name=clear]")
    page.fill("form.sign [name=password]", PHRASE)
    page.click("form.sign button")


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
        # One that has reasons against it says why on the screen; nothing is stored.
        page.evaluate(f"document.querySelector('input[name=number]').value = '{running.filled.proposals[0]}'")
        sign(page)
        page.wait_for_selector("form [role=alert]:not(:empty)")
        assert "has reasons against it" in page.inner_text("form .fail")
        assert running.store.proposals.approvals(running.filled.proposals[0]) == []
        page.goto(f"{running.base}/proposal?id={number}")
        page.select_option("select[name=hours]", "8.0")
        sign(page)
        page.wait_for_selector(".verdict.pass, .verdict .pass")
        assert page.inner_text(".verdict").endswith("approved")
        assert "Approved by anna" in page.inner_text("main")
        assert page.locator("form.sign").count() == 0, "what is signed is not offered again"
        assert [one for one in watch.errors if "409" not in one] == []
        told = running.store.proposals.approvals(number)
        assert [(a.name, a.login) for a in told] == [("anna", "user:anna")]
        record = running.store.audit.events(1)[0]
        assert (record.who, record.action, record.target) == ("user:anna", "POST /proposal/approve", f"proposal {number}")


def test_a_table_is_ordered_back_after_a_reason_and_a_confirmation(chromium, running, axe) -> None:
    sent: list[Any] = []
    job = {"state": "done: kept", "text": "push 3: in force again", "ended_utc": "2026-11-22T09:00:00Z"}

    def order(route: Route) -> None:
        sent.append((route.request.post_data_json, route.request.headers["idempotency-key"]))
        route.fulfill(status=202, json=job, headers={"Location": "/api/v1/jobs/0123456789ab"})

    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "olga")
        page.goto(f"{running.base}/table")
        assert page.locator("#order").count() == 0
        page.click(".logout button")
        page.wait_for_url("**/login")
        log_in(page, running.base, "anna")
        page.route("**/api/v1/tables/rollback", order)
        page.route("**/api/v1/jobs/*", lambda route: route.fulfill(json=job))
        page.goto(f"{running.base}/table")
        page.click("#order button")
        assert not page.locator("#ask-order").is_visible()  # without a reason there is no question
        page.fill("#order textarea", " worse ")
        page.click("#order button")
        asked = page.inner_text("#ask-order")
        assert all(word in asked for word in (running.filled.machine, "push 2", page.inner_text("#table-crc"), "worse")), asked
        assert violations(page, axe, "{}") == []
        assert page.evaluate(SMALL) == []
        page.keyboard.press("Escape")
        assert (page.locator("#ask-order").is_visible(), sent) == (False, [])
        page.click("#order button")
        page.click("#ask-order button.danger")
        page.wait_for_selector("#order-over:not([hidden])")
        assert page.inner_text("#order-job").split("\n")[0] == "The order: brought back"
        assert "in force again" in page.inner_text("#order-text")
        assert [body for body, _ in sent] == [{"push": 2, "crc": page.inner_text("#table-crc"), "reason": "worse"}]
        assert watch.errors == []


def test_keyboard_language_and_first_paint(chromium, running) -> None:
    with context(chromium) as made:
        page = made.new_page()
        log_in(page, running.base, "vera")
        assert page.locator(".screens a").count() == 12, "a viewer is not led to the audit, nor to diagnostics"
        page.goto(f"{running.base}/")
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.className") == "skip"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "content"
        page.wait_for_function(
            "() => performance.getEntriesByName('first-contentful-paint').length"
        )  # a busy machine paints later than it loads
        assert page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime") < 5000.0
        page.goto(f"{running.base}/settings")
        page.select_option("[name=lang]", "ko")
        page.click("form.filter button")
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


# Always a function: a bare expression is evaluated anew at each look, and the page's policy forbids that from the second one on.
MAP_READY = "() => document.documentElement.dataset.plotted"


def test_the_map_of_the_volume_is_turned_zoomed_and_asked(chromium, running, axe) -> None:
    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "vera")
        page.goto(f"{running.base}/volume?id={running.filled.solution}")
        page.wait_for_function(MAP_READY)
        assert page.is_visible("#scene")
        assert not page.is_visible("#no-scene")
        assert painted(page) > 1000, "colours of the map on the canvas"
        assert violations(page, axe, "{}") == []
        views = [view(page)]

        def seen() -> None:
            page.wait_for_function(f"() => document.documentElement.dataset.view !== '{views[-1]}'")
            views.append(view(page))

        page.click("[data-do=left]")
        seen()
        page.focus("canvas")
        page.keyboard.press("ArrowUp")
        seen()
        page.keyboard.press("+")
        seen()
        box = page.locator("canvas").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 200, box["y"] + 200)
        page.mouse.wheel(0, -200)
        seen()
        page.mouse.down()
        page.mouse.move(box["x"] + 260, box["y"] + 170)
        page.mouse.up()
        seen()
        page.keyboard.press("0")
        seen()
        assert views[-1] == views[0]
        ask_nodes(page)
        page.select_option("[name=cut]", "XZ")
        page.wait_for_function("() => document.querySelector('[name=level-text]').textContent.startsWith('Y ')")
        assert watch.errors == []
        assert watch.foreign == []


def test_a_trend_is_zoomed_read_and_taken_along(chromium, running, axe) -> None:
    if not has_uplot():
        pytest.skip("uPlot was not fetched (deploy/npm_files.py)")
    with context(chromium, "1024", "dark") as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "vera")
        page.goto(f"{running.base}/trends")
        page.wait_for_function(MAP_READY)
        assert page.evaluate("() => performance.now()") < 5000.0
        box = page.locator("[data-plot]").first
        assert box.locator("svg").count() == 0, "the picture makes room"
        assert box.locator("canvas").count() == 2
        box.focus()
        page.keyboard.press("ArrowLeft")
        last = running.store.verifications.latest(limit=2)[-1]
        told = box.locator("output").inner_text()
        value, u = last.doc["values"]["body_diagonal_um"], last.doc["uncertainties"]["body_diagonal_um"]
        assert f": {value:.1f} ± {u:.1f} µm (U, k = 2), cannot tell" in told
        assert "CUSUM ↑" in told
        assert box.locator("a.open").get_attribute("href") == f"/check?id={last.id}"
        before = pixels(page)
        page.keyboard.press("+")
        page.wait_for_timeout(100)
        assert pixels(page) != before, "the axis shows less, larger"
        page.keyboard.press("0")
        page.wait_for_timeout(100)
        assert pixels(page) == before
        with page.expect_download() as table:
            box.locator("[data-do=csv]").click()
        rows = Path(table.value.path()).read_text(encoding="utf-8").splitlines()
        assert rows[0].startswith("check,time,body_diagonal_um [µm],U (k=2) [µm],limit [µm],verdict")
        assert len(rows) == 1 + 23
        with page.expect_download() as picture:
            box.locator("[data-do=png]").click()
        assert picture.value.suggested_filename == "body_diagonal_um.png"
        assert violations(page, axe, "{}") == []
        assert page.evaluate(SMALL) == []
        assert watch.errors == []
        assert watch.foreign == []


def test_the_readings_of_a_run_are_looked_into(chromium, running) -> None:
    if not has_uplot():
        pytest.skip("uPlot was not fetched (deploy/npm_files.py)")
    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "vera")
        page.goto(f"{running.base}/run?id=1")
        page.wait_for_function(MAP_READY)
        page.wait_for_selector("[data-run] output:not(:empty)")
        with page.expect_response("**/run/curve?*") as closer:
            page.click("[data-run] [data-do=in]")
        asked = closer.value.json()
        assert asked["whole"][0] <= asked["x"][0] < asked["x"][-1] <= asked["whole"][1]
        page.wait_for_selector("[data-run][data-shown]")
        with page.expect_download() as table:
            page.click("[data-run] [data-do=csv]")
        assert len(Path(table.value.path()).read_text(encoding="utf-8").splitlines()) == 1 + len(asked["x"]) < asked["readings"]
        assert watch.errors == []


def pixels(page: Page) -> str:
    return str(page.evaluate("() => document.querySelector('[data-plot] canvas').toDataURL()"))


def view(page: Page) -> str:
    return str(page.evaluate("document.documentElement.dataset.view"))


def painted(page: Page) -> int:
    """Pixels of the canvas that are not empty, read in the frame in which they were drawn."""
    return int(
        page.evaluate("""() => new Promise(done => {
      document.querySelector("[data-do=right]").click();
      requestAnimationFrame(() => {
        const canvas = document.querySelector("canvas"), copy = document.createElement("canvas");
        [copy.width, copy.height] = [canvas.width, canvas.height];
        const flat = copy.getContext("2d");
        flat.drawImage(canvas, 0, 0);
        const data = flat.getImageData(0, 0, copy.width, copy.height).data;
        document.querySelector("[data-do=home]").click();
        let count = 0;
        for (let i = 3; i < data.length; i += 4) count += data[i] > 0 ? 1 : 0;
        requestAnimationFrame(() => done(count));
      });
    })""")
    )


def ask_nodes(page: Page, mm: str = "mm", um: str = "µm") -> None:
    """A node by name has the numbers of the table; a click on the canvas chooses another one."""
    for axis in "XYZ":
        page.select_option(f"[name=node-{axis}]", "0")
    row = page.locator(".nodes tbody tr").first.locator("td").all_inner_texts()
    told = page.inner_text("#node")
    place = ", ".join(row[:3]).replace("−", "-")
    assert told.startswith(f"({place}) {mm}")
    assert row[6].split(" ± ")[0] in told
    assert f"U (k = 2) = {row[6].split(' ± ')[1]} {um}" in told
    page.click("canvas", position={"x": 400, "y": 200})
    assert page.inner_text("#node") != told


DRAWN = """async () => {
  const { Traces } = await import("/static/traces.js");
  const [strip, polar] = [document.createElement("canvas"), document.createElement("canvas")];
  const drawn = [];
  strip.getContext("2d").fillText = (text) => drawn.push(text);
  const traces = new Traces(strip, polar, { sign: "µin", size: 0.0254 });
  traces.begin({ number: 1, angle_deg: [0, 360], rate_hz: 100, duration_s: 1 });
  traces.take(0, [2.5, -1.27]);
  traces.draw();
  return [traces.most, traces.least, traces.scale, ...drawn];
}"""


def test_inches_reach_what_scripts_write(chromium, running) -> None:
    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "vera")
        page.goto(f"{running.base}/volume?id={running.filled.solution}&units=inch")
        page.wait_for_function(MAP_READY)
        assert painted(page) > 1000
        ask_nodes(page, "in", "µin")
        page.select_option("[name=cut]", "XY")
        page.wait_for_selector("[name=level-text]:not(:empty)")
        texts = [page.inner_text("[name=level-text]"), *page.locator("[name=node-X] option").all_inner_texts()]
        texts += page.locator(".stage svg text").all_text_contents()
        assert len(texts) == 1 + 6 + 3
        assert all(text.endswith(" in") for text in texts), texts
        most, least, *drawn = page.evaluate(DRAWN)
        assert (most, least) == (pytest.approx(2.5 / 0.0254), pytest.approx(-50.0))
        assert drawn == [100, "+100 µin", "0", "−100 µin"]
        assert watch.errors == []


NO_WEBGL = """const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind) { return kind.startsWith("webgl") ? null : real.apply(this, arguments); };
"""  # what a browser without 3-D graphics answers


def test_the_map_without_3d_is_a_slice_and_a_table(chromium, running, axe) -> None:
    with context(chromium) as made:
        page = made.new_page()
        page.add_init_script(NO_WEBGL)
        watch = Watch(page, running.base)
        log_in(page, running.base, "vera")
        page.goto(f"{running.base}/volume?id={running.filled.solution}")
        page.wait_for_function(MAP_READY)
        assert not page.is_visible("#scene")
        assert "no 3-D graphics" in page.inner_text("#no-scene")
        assert page.locator("figure.wide:not(.scene) svg").is_visible()
        assert page.locator(".nodes tbody tr").count() == 216
        assert violations(page, axe, "{}") == []
        assert watch.errors == []


def test_the_report_of_a_long_run_comes_after_its_curve(chromium, running, monkeypatch) -> None:
    monkeypatch.setattr("abbe.service.web.pages.routes.LONG_RUN", 10)
    with context(chromium) as made:
        page = made.new_page()
        watch = Watch(page, running.base)
        log_in(page, running.base, "anna")
        sent = page.goto(f"{running.base}/run?id=1").text()
        place = sent[sent.index('id="run-report"') :]
        assert "aria-busy" in place[: place.index(">")]
        assert "/run?id=1&amp;whole=true" in place, "there is a way without scripts"
        page.wait_for_selector("[data-run] canvas")
        page.wait_for_selector("#run-report:not([aria-busy]) svg", timeout=60_000)
        assert page.evaluate(INSIDE)
        assert watch.errors == []
