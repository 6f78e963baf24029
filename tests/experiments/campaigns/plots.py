"""How soon the page draws, and how smoothly it zooms: a run of a million readings and the trend of a year, in a real Chromium.

    python -m tests.experiments.campaigns.plots                 # prints the figures with the load of this computer
    taskset -c 0 python -m tests.experiments.campaigns.plots    # server and browser share one core
    python -m tests.experiments.campaigns.plots --chunk 16      # a run in chunks of 16 ms, about the smallest that capture writes

First: from the start of the navigation until the curve stands, the first time (the service reads the run from its database) and again;
and the processor time of service and page's thread until then, which other programs do not lengthen.
Zoom: frames a second while every frame zooms a little, and the longest frame. What does not race with other programs is the processor time
that the page's thread spends on a frame (script, layout, painting of the canvases), from Chromium's own trace: 50 frames a second leave
20 ms. With ABBE_TEST_LONG=1 tests/system/test_frames.py asserts it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page

from abbe.service.domain.measured import ChunkRecord
from abbe.service.domain.schedule import Schedule
from abbe.service.runs.chunks import BAR_CODEC
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from abbe.service.web.login.authentication import COOKIE
from tests.pages_world import Filled, served
from tests.service.web.api_bench import MACHINE
from tests.system.serve_check import Result
from tests.system.test_serve_page import launched

READINGS, CHUNK = 1_000_000, 50_000
SAMPLE = np.dtype([("seq", "<u4"), ("device_us", "<u8"), ("reading_nm", "<i4"), ("status", "<u2")])
ON_PATH, PERIOD_US = 8, 1000
TURNS = np.linspace(0.0, 40.0 * np.pi, 1801)
POINTS = [[100.0 * np.cos(a), 100.0 * np.sin(a), 0.0] for a in TURNS]
SETUP = {"setup_id": "A", "t_set_s": 3.5, "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0, "plane": "XY"}
DAILY = Schedule("daily", "0 6 * * *", "Europe/Berlin", "quick-check")
FRAMES = """() => new Promise((done) => {
  const over = document.querySelector("[data-part=main] .u-over"), times = [];
  const frame = (now) => {
    times.push(now);
    const inward = Math.floor(times.length / 40) % 2 === 0;
    const at = {deltaY: inward ? -1 : 1, ctrlKey: true, clientX: over.getBoundingClientRect().left + 400,
                bubbles: true, cancelable: true};
    over.dispatchEvent(new WheelEvent("wheel", at));
    if (times.length < 240) requestAnimationFrame(frame); else done(times);
  };
  requestAnimationFrame(frame);
})"""
PLOTTED = """() => document.documentElement?.dataset.plotted && document.querySelector('[data-part=main] canvas')
  && performance.mark("the curve stands").startTime"""


def fill(folder: Path, checks: int, readings: int = READINGS, chunk: int = CHUNK) -> Filled:
    """A store with one long run and a history of daily checks."""
    url = f"sqlite:///{folder / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        machine = store.machines.add("mill-7", MACHINE)
        length_mm = float(np.linalg.norm(np.diff(np.array(POINTS), axis=0), axis=1).sum())
        feed_mm_min = length_mm / (readings * PERIOD_US * 1e-6) * 60.0
        path = {"feed_mm_min": feed_mm_min, "direction": 1, "points_mm": POINTS}
        start = {"setup": SETUP, "machine": MACHINE, "ctrl0_us": 5_000_000, "path": path, "rate_hz": 1000}
        run = store.runs.start(store.campaigns.add(machine, "long", {}), "r01", "ballbar_circle", "identify", start)
        store.chunks.ingest(list(_chunks(run, readings, chunk)))
        store.runs.finish(run, "complete", "", {"path_start_us": 8_000_000, "path_end_us": 8_000_000 + readings * PERIOD_US})
        now = datetime.now(UTC)
        noise = np.random.default_rng(1).normal(0.0, 0.4, (checks, 2))
        for day in range(checks):
            at = now - timedelta(days=checks - day)
            values = {"body_diagonal_um": 12.0 + noise[day, 0] + 0.01 * day, "helix_rms_um": 2.0 + 0.3 * noise[day, 1]}
            told = Result("pass", values, text="pass", started_utc=at, duration_s=180.0, campaign=f"quick-check {day}")
            store.verifications.add_with_messages(machine, verify.check_doc(verify.Occasion("mill-7", DAILY, at), told), [])
    return Filled(url, "mill-7", [DAILY], {}, "long", 0, [], 0)


def _chunks(run: int, readings: int, size: int) -> Iterator[ChunkRecord]:
    k = np.arange(-20, readings + 20)
    samples = np.zeros(k.size, SAMPLE)
    samples["seq"], samples["device_us"] = np.arange(k.size), 10**9 + np.arange(k.size) * PERIOD_US
    rng = np.random.default_rng(2)
    samples["reading_nm"] = 4000.0 * np.sin(k * 2e-5) + rng.normal(0.0, 300.0, k.size)
    samples["status"] = np.where((k >= 0) & (k < readings), ON_PATH, 0)
    for number, at in enumerate(range(0, k.size, size)):
        part = samples[at : at + size]
        payload = zlib.compress(part.tobytes(), 1)
        first, last = int(part["device_us"][0]), int(part["device_us"][-1])
        yield ChunkRecord(run, "bar", number, part.size, BAR_CODEC, zlib.crc32(payload), payload, 0.0, 0.0, first, last)


def first_ms(page: Page, address: str) -> float:
    """Time from the start of a navigation until the curve stands, ms."""
    page.goto(address, wait_until="commit")
    return float(page.wait_for_function(PLOTTED, timeout=120_000, polling="raf").json_value())


def first_cost_ms(browser: Browser, page: Page, address: str) -> tuple[float, float]:
    """Processor time until the curve stands, ms: of this process, which serves the page, and of the page's own thread.

    This process also steers the browser, which counts as serving. The page's thread is the one that marks the curve: Chromium may load a
    page of its own meanwhile, such as the list below its address bar, which takes three times as long.
    """
    browser.start_tracing(page=page, categories=["toplevel", "blink.user_timing"])
    begun_s = time.process_time()
    first_ms(page, address)
    served_ms = 1e3 * (time.process_time() - begun_s)
    events = json.loads(browser.stop_tracing())["traceEvents"]
    drawing = {(one["pid"], one["tid"]) for one in events if one["name"] == "the curve stands"}
    assert len(drawing) == 1, drawing
    tasks = [one for one in events if one["name"] == "ThreadControllerImpl::RunTask" and (one["pid"], one["tid"]) in drawing]
    return served_ms, sum(one.get("tdur", 0) for one in tasks) / 1e3


def frames(page: Page) -> tuple[float, float]:
    """Frames a second and the longest frame, ms, while every frame zooms."""
    steps = np.diff(page.evaluate(FRAMES))
    return 1e3 / float(np.mean(steps)), float(np.max(steps))


def frame_ms(browser: Browser, page: Page) -> np.ndarray:
    """Processor time of the page's thread for each frame while every frame zooms, ms."""
    browser.start_tracing(page=page, categories=["cc", "devtools.timeline"])
    page.evaluate(FRAMES)
    events = json.loads(browser.stop_tracing())["traceEvents"]
    return np.array([one["tdur"] / 1e3 for one in events if one["name"] == "ProxyMain::BeginMainFrame" and "tdur" in one])


def weight_kb(page: Page, address: str) -> float:
    """What a screen and its parts weigh without a cache, kB."""
    sizes: list[int] = []
    page.on("response", lambda answer: sizes.append(len(answer.body())))
    page.goto(address, wait_until="networkidle")
    return sum(sizes) / 1e3


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--checks", type=int, default=365, help="daily checks in the trend")
    parser.add_argument("--chunk", type=int, default=CHUNK, help="samples in a chunk of the run")
    parser.add_argument("--repeat", type=int, default=5)
    given = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} of {os.cpu_count()} cores")  # noqa: T201
    with (
        tempfile.TemporaryDirectory() as folder,
        launched() as chromium,
        served(fill(Path(folder), given.checks, chunk=given.chunk)) as one,
    ):
        for name, path in (("a million readings", "/run?id=1"), (f"trend of {given.checks} checks", "/trends")):
            made = chromium.new_context(viewport={"width": 1280, "height": 800}, service_workers="block")
            made.add_cookies([{"name": COOKIE, "value": one.people.begin(one.people.get("vera")), "url": one.base}])
            page = made.new_page()
            served_ms, drawn_ms = first_cost_ms(chromium, page, one.base + path)
            warm = [first_ms(page, one.base + path) for _ in range(given.repeat)]
            found = [frames(page) for _ in range(given.repeat)]
            spent = frame_ms(chromium, page)
            rate, longest = statistics.median(f for f, _ in found), max(ms for _, ms in found)
            heavy = weight_kb(made.new_page(), one.base + path)
            said = f"first {served_ms:.0f} + {drawn_ms:.0f} ms of processor time (service, page), "
            said += f"again {statistics.median(warm):.0f} ms (median of {len(warm)}, at most {max(warm):.0f})"
            cost = f"processor {np.median(spent):.1f} ms a frame, 95 % below {np.percentile(spent, 95):.1f}"
            zoomed = f"zoom {rate:.0f} frames/s (median of {len(found)} times 240), longest {longest:.0f} ms, {cost}"
            print(f"{name}: {said}; {zoomed}; {heavy:.0f} kB")  # noqa: T201
            made.close()


if __name__ == "__main__":
    main()
