"""The pictures of the documentation: main screens over a filled store, reports of real runs; `make pictures` writes docs/pictures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from datetime import date
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page

from abbe.service.domain.machine import Rules
from abbe.service.rendering.document_page import write_document
from abbe.service.report.report import certified, numbered_report
from abbe.service.storage.store import Store
from tests.conftest import ROOT
from tests.pages_world import Filled, filled_once, served
from tests.service.rendering.test_certificate import ITEM, LABORATORY
from tests.system.test_serve_screens import LONG, log_in

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]
FOLDER = os.environ.get("ABBE_PICTURES")
"""Where `make pictures` wants them; without it they go to a scratch folder and are looked at there."""
BY_HAND = pytest.mark.skipif(
    not (FOLDER or LONG),
    reason="test_layouts and test_serve_screens walk the screens: ABBE_TEST_LONG=1 or `make pictures` takes them",
)
WIDE = 1100
SCREENS = {
    "home": ("/", 760),
    "check": ("/check?id=24", 760),
    "alarm": ("/alarm?id=2", 512),
    "result": ("/result", 760),
    "discovery": ("/discovery", 760),
    "volume": ("/volume", 560),
    "proposal": ("/proposal", 760),
    "motions": ("/motions?motion=EYY", 760),
    "trends": ("/trends", 760),
    "new": ("/new", 760),
}
"""Address and height of each."""


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    return filled_once(tmp_path_factory)


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    with closing(chromium.new_context(viewport={"width": WIDE, "height": 760}, color_scheme="light", locale="en")) as context:
        yield context.new_page()


def kept(page: Page, name: str, folder: Path, height: int, begins: Locator | None = None) -> None:
    """Take a picture of the page's top, or from something on; it is neither empty nor large."""
    page.set_viewport_size({"width": WIDE, "height": height})
    if begins is not None:
        begins.first.evaluate("element => element.scrollIntoView()")
    page.wait_for_timeout(300)  # what is drawn follows the new size
    target = Path(FOLDER or folder) / f"{name}.png"
    page.screenshot(path=target)
    assert 10_000 < target.stat().st_size < 150_000, name


@BY_HAND
def test_the_screens(page: Page, filled: Filled, tmp_path: Path) -> None:
    with served(filled) as running:
        log_in(page, running.base, "anna")
        for name, (path, height) in SCREENS.items():
            answer = page.goto(running.base + path, wait_until="load")
            assert answer is not None
            assert answer.status == 200, path
            page.wait_for_selector("html[data-ready=yes]")
            kept(page, name, tmp_path, height, page.locator("canvas") if name == "volume" else None)


@BY_HAND
def test_the_report_of_a_solution(page: Page, filled: Filled, tmp_path: Path) -> None:
    report = tmp_path / "june.html"
    abbe("solve", filled.campaign, "--db", filled.url, "--report", report)
    page.goto(report.as_uri())
    kept(page, "report-solution", tmp_path, 900)


@pytest.mark.skipif(FOLDER is None, reason="tested beside its writer; `make pictures` writes the sample")
def test_the_sample_of_a_certificate(filled: Filled) -> None:
    until, bar, laser = (
        date(2027, 5, 31),
        "Example, bar, serial 1; certificate 12 of laboratory L",
        "Example, laser, serial 2; certificate 13 of L",
    )
    rules = Rules(
        {"body_diagonal_um": 20.0, "helix_rms_um": 5.0}, {"ballbar": until, "laser": until}, instruments={"ballbar": bar, "laser": laser},
        issuer=LABORATORY, item=ITEM,
    )  # fmt: skip
    with Store.open(filled.url) as store:
        document = certified(numbered_report(store, "verification", 24, rules), rules, date(2026, 11, 27), date(2026, 11, 27))
    write_document(document, ROOT / "docs" / "sample-certificate.pdf")


@pytest.mark.skipif(FOLDER is None, reason="the demonstration has tests of its own; its pictures are made by `make pictures`")
def test_the_report_of_the_demonstration(page: Page, tmp_path: Path) -> None:
    abbe("demo", "--keep", tmp_path / "demo")
    page.goto((tmp_path / "demo" / "report.html").as_uri())
    kept(page, "before-after", tmp_path, 950, page.locator("h2", has_text="Before and after"))
    kept(page, "diagonals", tmp_path, 510, page.locator("svg", has_text="along the diagonal"))


def abbe(*words: str | Path) -> None:
    done = subprocess.run([sys.executable, "-m", "abbe.service.cli", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
