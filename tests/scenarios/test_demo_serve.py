"""`abbe demo --serve`: a check, the machine drifts, a check, an alarm, a campaign, a proposal; a person approves it in a real browser."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

from abbe.service.demo import demo_serve
from abbe.service.demo.demo_serve import DRIFT_UM_PER_M, MARGIN_UM, USER, service_config
from abbe.service.errors import StoreError
from abbe.service.storage.store import Store
from tests.system.serve_bench import Process, chromium_program
from tests.system.test_serve_page import QUIET

pytestmark = [pytest.mark.scenario, pytest.mark.browser, pytest.mark.timeout(1200)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
LOOKS_MS = 60_000
PATIENCE_S = 400.0


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[Process]:
    with ExitStack() as stack:
        words = ("demo", "--serve", "--seed", os.environ.get("ABBE_TEST_SEED", "1"), "--keep", str(tmp_path / "demo"), "--port", "0")
        process = Process(sys.executable, "-c", "from abbe.service.cli import main; main()", *words)
        stack.callback(process.close)
        yield process


@pytest.fixture
def page() -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_program(), args=QUIET)
        yield browser.new_page(viewport={"width": 1280, "height": 768}, locale="en")
        browser.close()


@pytest.mark.skipif(not LONG, reason="several minutes: ABBE_TEST_LONG=1 runs it")
def test_the_story_is_seen_and_approved_in_the_page(demo: Process, page: Page, tmp_path: Path) -> None:
    base = demo.expect("page: ", PATIENCE_S).removeprefix("page: ")
    told = re.search(r"log in as (\S+) with (\S+) ", demo.expect("log in as"))
    assert told is not None
    page.goto(f"{base}login")
    page.fill("#name", told[1])
    page.fill("#password", told[2])
    page.click("button[type=submit]")
    page.wait_for_url(base)
    expect(page.get_by_role("alert").filter(has_text="Alarm")).to_have_count(0)
    begun = pushes(tmp_path)  # those of the commissioning, which took back what it brought

    # two checks by the timetable, the machine has drifted between them
    demo.expect("1. check by the timetable: ", PATIENCE_S)
    demo.expect("3. check by the timetable: ", PATIENCE_S)
    demo.expect("4. alarm 1: ", PATIENCE_S)
    page.goto(base)
    alarm = page.get_by_role("alert").filter(has_text="Alarm 1")
    expect(alarm).to_contain_text("is above its limit", timeout=LOOKS_MS)
    rows = page.locator("table.past tbody tr")
    expect(page.locator("td.fail")).not_to_have_count(0)
    expect(rows.last.locator("td.pass")).to_have_count(1)
    drawn = page.locator("#h-trend ~ .plots svg")
    expect(drawn.first).to_be_visible()

    # it is named, and a proposal waits
    named = demo.expect("5. the service has measured the full campaign and searched: ", PATIENCE_S).split("searched: ")[1]
    by_search = re.search(r"changed since solution \d+: scale of X \+([\d.]+) ± ([\d.]+) µm/m(.*)", named)
    assert by_search is not None, named
    assert abs(float(by_search[1]) - DRIFT_UM_PER_M) < float(by_search[2])
    assert "not proved" not in by_search[3]
    promise = demo.expect("proposal 1 waits for approval", PATIENCE_S)
    assert re.search(r"largest change: [+-][\d.]+ µm .* in the table of X over X", promise), promise
    grown = re.search(r"changed most since solution \d+: scale of X ([+-][\d.]+) ± ([\d.]+) µm/m", promise)
    assert grown is not None, promise
    assert abs(float(grown[1]) - DRIFT_UM_PER_M) < 2.0 * float(grown[2])
    page.goto(f"{base}discoveries")
    expect(page.locator("main")).to_contain_text("alarm 1")
    page.goto(f"{base}discovery")
    expect(page.locator("main")).to_contain_text("scale of X")
    expect(page.locator("main")).to_contain_text("on runs that were not used to find the change, the gap shrinks from")
    page.goto(base)
    expect(alarm).to_contain_text("scale of X", timeout=LOOKS_MS)
    page.get_by_role("link", name="Proposal 1").first.click()
    expect(page.locator("main")).to_contain_text("in the table of X over X")
    assert pushes(tmp_path) == begun  # nothing is written before a person has said yes
    page.get_by_role("button", name="Approve").click()
    expect(page.locator("main")).to_contain_text(f"Approved by {USER}", timeout=LOOKS_MS)
    demo.expect(f"6. approved by {USER}", PATIENCE_S)

    # pushed, proved, verified, and the trend is back within its limits
    assert " kept: " in demo.expect("7. ", PATIENCE_S)
    demo.expect("8. the check after it", PATIENCE_S)
    page.goto(base)
    expect(alarm).to_contain_text("over, not acknowledged", timeout=LOOKS_MS)
    expect(rows.nth(0).locator("td.pass")).to_have_count(1)
    assert (len(pushes(tmp_path)) > len(begun), pushes(tmp_path)[-1]) == (True, "KEEP")

    code, _ = demo.terminate(signal.SIGINT)
    assert code == 130
    assert left_behind(tmp_path) == []


def pushes(folder: Path) -> list[str]:
    with Store.open(f"sqlite:///{folder / 'demo' / 'abbe.sqlite3'}") as store:
        return [entry.state for entry in store.pushes.entries("demo-machine")]


def left_behind(folder: Path) -> list[str]:
    """Command lines of processes that still work in the demonstration's folder."""
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = line.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if str(folder / "demo") in words:
            found.append(words)
    return found


def test_the_machine_file_of_the_demonstration_is_one(tmp_path: Path) -> None:
    from abbe.service.config import load_machine
    from abbe.service.demo.demo import demo_site, write_machine_file
    from abbe.service.demo.simulator_process import SimulatorProcess
    from abbe.service.domain.machine import machine_from_doc

    doc = {
        "chain": "w-X-Y-b-Z-t", "tool_mm": [0.0, 0.0, -120.0], "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]},
        "pivots_mm": {"X": [300, 250, -150], "Y": [300, 250, -250], "Z": [0, 320, 260]},
    }  # fmt: skip
    assert machine_from_doc(doc).chain == "w-X-Y-b-Z-t"
    urls = {"cnc": "modbus+tcp://127.0.0.1:1", "ballbar": "socket://127.0.0.1:2", "laser": "modbus+tcp://127.0.0.1:3"}
    ready = {"machine": doc, "fixture": "fixture+tcp://127.0.0.1:4"} | urls
    path = write_machine_file(demo_site(SimulatorProcess.of_line(json.dumps(ready))), tmp_path)
    with path.open("a") as out:
        out.write(service_config(8123, dict.fromkeys(MARGIN_UM, 12.5)))
    machine = load_machine(path).machine
    (entry,) = machine.schedule
    assert (entry.recipe, entry.on_alarm, machine.alarm.push, machine.web.port) == ("verification", "propose", "approved", 8123)
    assert machine.verify.helix_rms_um == machine.verify.body_diagonal_um == 12.5


async def test_a_locked_database_is_looked_at_again_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_serve, "LOOK_S", 0.0)
    answers: list[str | None] = [None, "", "there"]
    tries = 0

    def look() -> str | None:
        nonlocal tries
        tries += 1
        if tries % 2:
            raise StoreError("database is locked")
        return answers.pop(0)

    assert await demo_serve._until(look) == "there"
    assert tries == 6

    def never() -> None:
        raise StoreError("database is locked")

    with pytest.raises(StoreError, match="locked"):
        await demo_serve._until(never)
