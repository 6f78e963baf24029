"""The live run and the new test in a real browser, over a check that really runs on the simulated machine.

With ABBE_TEST_LONG=1 also the figures: how old a sample is when it is drawn, and what browser and service need for it, at 1 kHz in real
time. Both are told with the load of the computer: they say nothing on one that is busy with other things.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import sqlite3
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import pytest
from playwright.sync_api import Page
from playwright.sync_api import TimeoutError as NotSeen
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store
from abbe.service.users.people import UserAccounts
from tests.system.serve_bench import Machine, Process, abbe, free_port
from tests.system.test_serve_page import Seen, browser, only_us, shot
from tests.system.test_serve_screens import INSIDE, SIZES, SMALL, violations

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
PHRASE = "correct horse battery staple"
TIMETABLE = ["[[schedule]]", 'name = "yearly"', 'cron = "0 0 1 1 *"', 'recipe = "quick-check"']
TICKS = os.sysconf("SC_CLK_TCK")
WINDOW_S = 10.0
CONTRAST = "{runOnly: ['color-contrast']}"
LISTEN = """() => { window.drawn = []; addEventListener("live-drawn", (event) => {
  // The event comes when the drawing has been ordered; the next task after the next frame begins when it has been done.
  const { arrivedMs, count } = event.detail;
  requestAnimationFrame(() => setTimeout(() => window.drawn.push([Date.now() - arrivedMs, count]), 0)); }); }"""
INKED = """(id) => { const canvas = document.getElementById(id);
  const style = getComputedStyle(canvas).getPropertyValue("--accent").trim();
  const wanted = [1, 3, 5].map((at) => parseInt(style.slice(at, at + 2), 16));
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let found = 0;
  for (let k = 0; k < data.length; k += 4)
    if (data[k + 3] > 128 && wanted.every((value, at) => Math.abs(data[k + at] - value) < 24)) found += 1;
  return found; }"""


@dataclass
class Serving:
    """The service with the simulated machine's devices."""

    process: Process
    port: int
    url: str
    viewer: dict[str, str]

    @property
    def base(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def web(self) -> int:
        pid = self.process.pid
        (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return int(child)


@contextmanager
def serving(folder: Path, speed: float) -> Iterator[Serving]:
    url, port = f"sqlite:///{folder / 'abbe.sqlite3'}", free_port()
    with Store.open(url) as store:
        people = UserAccounts(store, SystemClock())
        people.add("olga", "operator", PHRASE)
        token = people.add_token("olga", "test", ["read"], 5.0)
    machine = Machine(folder, speed, "[web]", f"port = {port}", *TIMETABLE)
    with closing(machine.process), closing(abbe("serve", "-m", machine.file)) as process:
        process.expect('"page up"')
        yield Serving(process, port, url, {"Authorization": f"Bearer {token}"})
        process.terminate()


def log_in(page: Page, base: str, name: str = "olga") -> None:
    page.goto(f"{base}/login")
    page.fill("#name", name)
    page.fill("#password", PHRASE)
    page.click("button[type=submit]")
    page.wait_for_selector("html[data-ready=yes]")


def start(page: Page, base: str, rate_hz: int) -> None:
    """From the home page to the dry run, and with one confirmation to the live run."""
    page.goto(f"{base}/")
    page.click("a[href='/new']")
    page.select_option("select[name=rate_hz]", str(rate_hz))
    page.click("form.choose button")
    page.wait_for_selector("#dry svg")
    assert "✔" in page.inner_text("#dry")
    page.click("#start button")
    told = page.context.request.get(f"{base}/api/v1/jobs").json()
    assert told["jobs"] == [], "it starts before the checklist was gone through"
    page.check("#start input[type=checkbox]")
    page.click("#start button")
    page.wait_for_url("**/live")
    page.wait_for_selector("#live-bar")
    page.evaluate(LISTEN)


def until_drawn(page: Page, count: int) -> None:
    page.wait_for_function("(count) => window.drawn.some(([, drawn]) => drawn >= count)", arg=count, timeout=60_000)


def states(serving: Serving) -> list[str]:
    with Store.open(serving.url) as store:
        return [run.status for run in store.runs.all()]


def refused(serving: Serving) -> None:
    """Who may not look on, or comes from another site's page, gets no sample."""
    address = f"ws://127.0.0.1:{serving.port}/api/v1/live/samples"
    for headers in ({}, {**serving.viewer, "Origin": "http://evil.example"}):
        with pytest.raises(InvalidStatus) as told:
            connect(address, additional_headers=headers)
        assert told.value.response.status_code == 403
    with connect(address, additional_headers=serving.viewer) as live:
        path = json.loads(live.recv(timeout=10))
        assert (path["test"], path["rate_hz"]) == ("ballbar_helix", 100)
        frames = live.recv(timeout=10)
        assert isinstance(frames, bytes)
        assert len(frames) >= 28


def axe_core() -> str:
    spec = importlib.util.find_spec("axe_playwright_python")
    assert spec is not None, "axe-core is in the developers' packages (axe-playwright-python)"
    assert spec.origin is not None
    return (Path(spec.origin).parent / "axe.min.js").read_text(encoding="utf-8")


def faults(page: Page, axe: str, rules: str = "{}") -> list[str]:
    """What is wrong with a screen as it stands: sideways scroll, small targets, axe-core."""
    page.wait_for_selector("html[data-ready=yes]")
    found = [] if page.evaluate(INSIDE) else ["scrolls sideways"]
    return [f"{page.url}: {one}" for one in (*found, *page.evaluate(SMALL), *violations(page, axe, rules))]


def without_scripts(page: Page, base: str) -> None:
    """The same person in a browser that runs no scripts is told that he cannot steer from here."""
    assert page.context.browser is not None
    quiet = page.context.browser.new_context(java_script_enabled=False, storage_state=page.context.storage_state())
    other = quiet.new_page()
    other.goto(f"{base}/live")
    assert "needs scripts" in other.inner_text("main")
    other.goto(f"{base}/new")
    assert other.locator("#start button").count() == 0, "while a check runs there is nothing to start"
    quiet.close()


def in_inches(page: Page) -> None:
    """Readings and scales of the traces are in the unit that was chosen in the settings."""
    told = page.inner_text(".traces")
    assert ("µin" in told, "µm" in told) == (True, False)
    least, most = (float(v) for v in page.inner_text("#live-range").split(" … "))
    scale = float(page.inner_text("#strip-scale").removeprefix("20 s, ±").removesuffix(" µin"))
    assert max(-least, most) <= scale
    assert page.inner_text("#polar-scale").endswith(f"±{scale:g} µin")


def test_a_browser_draws_a_running_check_and_stops_it(tmp_path: Path) -> None:
    axe = axe_core()
    with serving(tmp_path, 6.0) as one, browser() as seen:
        page = seen.page
        log_in(page, one.base)
        page.goto(f"{one.base}/live")
        assert page.locator("main a[href='/new']").is_visible()
        assert page.locator(".due dt").inner_text() == "yearly"
        page.goto(f"{one.base}/settings?units=inch")
        start(page, one.base, 100)
        until_drawn(page, 300)
        refused(one)
        without_scripts(page, one.base)
        assert page.evaluate(INKED, "strip") > 200
        assert page.evaluate(INKED, "polar") > 200
        assert int(page.inner_text("#live-samples")) >= 300
        assert page.evaluate("document.getElementById('live-bar').value") >= 3.0, "a path of minutes would look as if it stood"
        in_inches(page)
        sizes = [one.bounding_box() for one in page.locator("#steer button").all()]
        assert len(sizes) == 3
        assert all(box is not None and box["height"] >= 48 and box["width"] >= 48 for box in sizes)
        assert faults(page, axe, CONTRAST) == []
        shot(page, "serve-live.png")
        page.keyboard.press("Space")
        page.wait_for_selector("#steer [data-how=resume]", timeout=10_000)
        page.keyboard.press("Escape")
        page.wait_for_selector("#ask-stop[open]")
        page.keyboard.press("Escape")  # asked, and not wanted
        page.wait_for_selector("#ask-stop:not([open])", state="attached")
        page.keyboard.press("Escape")
        page.route("**/api/v1/jobs/*/stop", lambda route: route.fulfill(status=202, json={"state": "stopping"}))
        with page.expect_request("**/api/v1/jobs/*/stop"):
            page.click("#ask-stop button[value=stop]")
        stop_elsewhere(page, one)
        page.wait_for_selector("#live-over:not([hidden])", timeout=30_000)
        assert "cannot tell" in page.inner_text("#live-outcome")
        assert page.locator("#live-alarm").is_hidden(), "this check was for no alarm"
        assert states(one)[-1] in {"stopped", "aborted"}
        assert seen.errors == []
        assert only_us(seen)


SEEN = """() => {
  const stop = document.querySelector("#steer [data-how=stop]").getBoundingClientRect();
  const bar = document.getElementById("steer").getBoundingClientRect();
  const shown = ["strip", "polar"].map(id => document.getElementById(id)).filter(e => e.offsetParent).map(e => e.getBoundingClientRect());
  return {stop: stop.bottom <= innerHeight && stop.height >= 44, hidden: shown.filter(r => r.top < 0 || r.bottom > bar.top + 1).length,
    share: Math.max(...shown.map(r => r.height)) / innerHeight, wide: Math.max(...shown.map(r => r.right)) / innerWidth};
}"""


def test_trace_position_and_stop_are_seen_together_on_every_screen_and_then_the_laser(tmp_path: Path) -> None:
    axe = axe_core()
    with serving(tmp_path, 3.0) as one, browser() as seen:
        page = seen.page
        log_in(page, one.base)
        start(page, one.base, 100)
        until_drawn(page, 100)
        for size, scheme in zip(("1280", "1024", "390"), ("light", "dark", "light"), strict=True):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            page.set_viewport_size(SIZES[size])  # type: ignore[arg-type]
            page.goto(f"{one.base}/live")
            page.wait_for_selector("#dro:not([hidden])")
            page.wait_for_function("() => Number(document.getElementById('live-samples').textContent) > 50")
            where = page.evaluate(SEEN)
            assert where["stop"], size
            assert where["hidden"] == 0, (size, where)
            assert where["share"] > (0.24 if size == "390" else 0.33), (size, where)
            assert all(re.fullmatch(r"-?\d+\.\d{3}", page.inner_text(f"#dro-{axis}")) for axis in "xyz")
            page.wait_for_function("() => Number(document.getElementById('dro-feed').textContent) > 100")
            assert page.inner_text("#dro-door") == "shut"
            assert re.search(r"\d+ (s|min) left", page.inner_text("#live-left")), "the dry run knows"
            assert faults(page, axe) == []
            shot(page, f"serve-live-{size}-{scheme}.png")
        page.wait_for_selector("#live-pair.single:not(.old)", timeout=90_000)
        page.wait_for_function("() => document.getElementById('strip-scale').textContent.startsWith('60 s')")
        assert page.inner_text("#live-run") == "Laser"
        assert re.fullmatch(r"\d+\.\d °C", page.inner_text("#dro-air"))
        assert page.evaluate(INKED, "strip") > 20
        shot(page, "serve-live-laser-390.png")
        assert seen.errors == []
        assert only_us(seen)


def stop_elsewhere(page: Page, one: Serving) -> None:
    """The bar of any screen says what happens; a session that has run out leads to the log-in, whose Stop works."""
    assert page.context.browser is not None
    other = page.context.browser.new_page()
    log_in(other, one.base)
    other.goto(f"{one.base}/runs")
    assert other.locator(".strip .state.busy").is_visible()
    with closing(sqlite3.connect(one.url.removeprefix("sqlite:///"))) as there, there:
        there.execute("UPDATE sessions SET seen_utc = '2026-01-01T00:00:00+00:00' WHERE id = (SELECT max(id) FROM sessions)")
    other.wait_for_url("**/login", timeout=10_000)
    other.click("#stop")
    other.wait_for_selector("#stop-answer:not(:empty)")
    assert other.inner_text("#stop-answer").startswith("Stopping")
    other.close()


@pytest.mark.skipif(not LONG, reason="every size, scheme and language: ABBE_TEST_LONG=1 walks them")
def test_both_screens_are_quiet_and_fit(tmp_path: Path) -> None:
    axe, bad = axe_core(), list[str]()
    with serving(tmp_path, 0.3) as one, browser() as seen:
        log_in(seen.page, one.base)
        start(seen.page, one.base, 100)
        until_drawn(seen.page, 100)
        assert seen.page.context.browser is not None
        for size, scheme, lang in product(SIZES, ("light", "dark"), ("en", "de", "ja", "ko")):
            looks = {"viewport": SIZES[size], "color_scheme": scheme, "locale": lang}
            made = seen.page.context.browser.new_context(storage_state=seen.page.context.storage_state(), **looks)  # type: ignore[arg-type]
            page = made.new_page()
            page.on("console", lambda message, bad=bad: bad.append(message.text) if message.type in {"error", "warning"} else None)
            for path in ("/live", "/new"):
                page.goto(one.base + path)
                if path == "/live":
                    page.wait_for_function("() => document.getElementById('live-samples').textContent !== '–'")
                    box = page.locator("#strip").bounding_box()
                    bar = page.locator("#steer").bounding_box()
                    assert box is not None
                    assert bar is not None
                    # On smaller screens one scrolls to the trace.
                    bad += (
                        []
                        if size != "1280" or box["y"] + box["height"] <= bar["y"]
                        else [f"{size}: the trace is hidden behind the buttons"]
                    )
                bad += [f"{size} {scheme} {lang} {fault}" for fault in faults(page, axe)]
                shot(page, f"screen-{path.strip('/')}-{size}-{scheme}-{lang}.png")
            made.close()
        assert bad == []


@pytest.mark.skipif(not LONG, reason="starts the whole service once more: ABBE_TEST_LONG=1 runs it")
def test_a_lost_connection_is_said_and_comes_back(tmp_path: Path) -> None:
    """The page's process is killed while a path is drawn, and each that follows, for one alone is replaced before anybody would miss it:

    banner and grey traces, then the same path again, from a new process.
    """
    with serving(tmp_path, 0.5) as one, browser() as seen:
        page = seen.page
        log_in(page, one.base)
        start(page, one.base, 100)
        until_drawn(page, 100)
        lose(page, one)
        page.wait_for_selector("#live-pair.old", timeout=30_000)
        shot(page, "serve-live-lost.png")
        page.wait_for_selector("#live-lost[hidden]", state="attached", timeout=90_000)
        page.wait_for_selector("#live-pair:not(.old)", timeout=30_000)
        before = int(page.inner_text("#live-samples"))
        until_drawn(page, before + 100)
        page.click("#steer [data-how=abort]")
        page.wait_for_selector("#live-over:not([hidden])", timeout=60_000)
        assert states(one) == ["aborted"]


def lose(page: Page, one: Serving) -> None:
    """Kill every process of the page as it comes, until the page says that it has lost its connection."""
    for _ in range(100):
        with suppress(ValueError, ProcessLookupError):  # none at the moment
            os.kill(one.web, signal.SIGKILL)
        with suppress(NotSeen):
            page.wait_for_selector("#live-lost:not([hidden])", timeout=300)
            return
    raise AssertionError("the connection was lost a hundred times, and the page did not say so")


# ---- figures ----------------------------------------------------------------------------------------------------------------------


def cpu_s(pids: list[int]) -> float:
    """CPU time that processes have used so far; one that has ended counts nothing."""
    total = 0
    for pid in pids:
        try:
            words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except FileNotFoundError:
            continue
        total += int(words[11]) + int(words[12])
    return total / TICKS


def chromium_pids() -> list[int]:
    """Every process of the browser that this test has started."""
    mine, found, waiting = os.getpid(), [], [os.getpid()]
    while waiting:
        parent = waiting.pop()
        for task in Path(f"/proc/{parent}/task").glob("*/children"):
            for word in task.read_text().split():
                waiting.append(int(word))
                found.append(int(word))
    return [pid for pid in found if pid != mine and "chrom" in Path(f"/proc/{pid}/comm").read_text()]


def shares(groups: dict[str, list[int]], window_s: float) -> dict[str, float]:
    """Part of one core that each group of processes uses over a time."""
    before, began_s = {name: cpu_s(pids) for name, pids in groups.items()}, time.monotonic()
    threading.Event().wait(window_s)  # the time over which is measured, not a wait for something
    took_s = time.monotonic() - began_s
    return {name: (cpu_s(pids) - before[name]) / took_s for name, pids in groups.items()}


def measure_live(one: Serving, seen: Seen) -> dict[str, float]:
    page = seen.page
    log_in(page, one.base)
    start(page, one.base, 1000)
    until_drawn(page, 2000)
    page.evaluate("window.drawn.length = 0")
    groups = {"browser": chromium_pids(), "core": [one.process.pid], "web": [one.web]}
    watched = shares(groups, WINDOW_S)
    drawn = page.evaluate("window.drawn")
    shot(page, "serve-live-1khz.png")
    page.goto("about:blank")
    alone = shares(groups, WINDOW_S)
    ages = sorted(age for age, _ in drawn)
    return {
        "age_median_ms": statistics.median(ages),
        "age_p95_ms": ages[int(0.95 * len(ages))],
        "age_max_ms": ages[-1],
        "draws_per_s": len(ages) / WINDOW_S,
        "samples_per_s": (drawn[-1][1] - drawn[0][1]) / WINDOW_S,
        "browser_percent": 100 * watched["browser"],
        "web_percent": 100 * watched["web"],
        "core_percent": 100 * watched["core"],
        "web_unwatched_percent": 100 * alone["web"],
        "core_unwatched_percent": 100 * alone["core"],
        "load_1min": os.getloadavg()[0],
    }


@pytest.mark.skipif(not LONG, reason="figures of a quiet computer: ABBE_TEST_LONG=1 measures them")
def test_the_trace_is_young_and_cheap(tmp_path: Path) -> None:
    with serving(tmp_path, 1.0) as one, browser() as seen:
        figures = measure_live(one, seen)
        print(json.dumps({name: round(value, 2) for name, value in figures.items()}))  # noqa: T201 - what this is run for
        assert figures["samples_per_s"] > 900
        assert figures["age_p95_ms"] <= 200
        assert figures["browser_percent"] < 40
        assert figures["web_percent"] < 3
        assert seen.errors == []
