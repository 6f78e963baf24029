"""The main screens stand where they stood: boxes, colours and texts of all visible elements against those kept in `layouts/`.

Not pixels: docs/decisions/0046-layouts-instead-of-pixels.md. `make pictures` writes them anew; look at what it changed.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from tests.box_font import box_font
from tests.pages_world import Filled, Served, filled_once, served
from tests.system.test_serve_screens import LONG, SIZES, log_in

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]
FOLDER = Path(__file__).parent / "layouts"
RENEW = bool(os.environ.get("ABBE_PICTURES"))
SCREENS = {
    "home": "/", "alarms": "/alarms", "alarm": "/alarm?id=2", "check": "/check?id=24", "new": "/new", "proposal": "/proposal",
    "table": "/table", "trends": "/trends?pictures=true", "runs": "/runs", "result": "/result", "settings": "/settings",
    "administration": "/administration",
}  # fmt: skip
NEAR_PX = 3
"""Rounding of positions; a button that moves by more is told."""
FONT = """@font-face {{ font-family: Box; src: url(data:font/ttf;base64,{}) }}
* {{ font-family: Box !important; text-rendering: geometricPrecision !important; }}"""
"""Letters stand at fractions of a pixel; hinting by the computer's own settings would round their widths."""

SEEN = """() => {
  const shown = [];
  const walk = (e) => {
    const style = getComputedStyle(e), r = e.getBoundingClientRect();
    if (style.visibility === "hidden" || style.display === "none" || !r.width || !r.height) return;
    const words = [...e.childNodes].filter(n => n.nodeType === 3).map(n => n.data.trim()).filter(Boolean).join(" ");
    const own = words.replace(/[0-9a-f]{16,}/g, "#").replace(/[0-9]/g, "0");
    const back = style.backgroundColor === "rgba(0, 0, 0, 0)" ? "" : style.backgroundColor;
    if (own || back || e.matches("svg, canvas, input, select, button, a, section"))
      shown.push([e.tagName.toLowerCase(), own.slice(0, 60), Math.round(r.x + scrollX), Math.round(r.y + scrollY), Math.round(r.width),
                  Math.round(r.height), own ? style.color : "", back]);
    if (!e.matches("svg, canvas")) [...e.children].forEach(walk);
  };
  walk(document.body);
  return shown;
}"""
Seen = list[list[Any]]


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    filled: Filled = filled_once(tmp_path_factory)
    with served(filled) as one:
        yield one


# ABBE_TEST_LONG=1 compares the third size, too.
@pytest.fixture(scope="module", params=SIZES if LONG or RENEW else ("1280", "390"))
def page(request: pytest.FixtureRequest, chromium: Browser, running: Served) -> Iterator[Page]:
    """A browser of one size whose every font is the same; the page's policy would refuse the font."""
    size: Any = SIZES[request.param]
    with closing(chromium.new_context(viewport=size, color_scheme="light", locale="en", bypass_csp=True, service_workers="block")) as made:
        one = made.new_page()
        log_in(one, running.base, "anna")
        yield one


def seen(page: Page, address: str) -> Seen:
    """What is visible on a screen: tag, text, box, colours of text and ground."""
    page.goto(address, wait_until="load")
    page.wait_for_selector("html[data-ready=yes]")
    page.add_style_tag(content=FONT.format(base64.b64encode(box_font()).decode()))
    assert page.evaluate(
        "async () => { await document.fonts.load('16px Box'); return document.fonts.check('16px Box') && document.fonts.size }"
    )
    found: Seen = page.evaluate(SEEN)
    return found


def differences(kept: Seen, now: Seen) -> list[str]:
    """What is missing, new, moved or coloured otherwise; texts that stand more than once are counted in their order."""
    told, places = [], (_named(kept), _named(now))
    for key in [*places[0], *(key for key in places[1] if key not in places[0])]:
        before, after = places[0].get(key), places[1].get(key)
        if before is None or after is None:
            told.append(f"{key}: {'new' if before is None else 'missing'}")
        elif any(abs(a - b) > NEAR_PX for a, b in zip(before[2:6], after[2:6], strict=True)):
            told.append(f"{key}: {before[2:6]} is now {after[2:6]}")
        elif before[6:] != after[6:]:
            told.append(f"{key}: {before[6:]} is now {after[6:]}")
    return told


def _named(rows: Seen) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for row in rows:
        count = sum(1 for key in found if key.startswith(f"{row[0]} {row[1]!r} #"))
        found[f"{row[0]} {row[1]!r} #{count}"] = row
    return found


def kept_at(page: Page, name: str) -> Path:
    assert page.viewport_size is not None
    return FOLDER / f"{name}-{page.viewport_size['width']}.json"


def test_the_screens_stand_where_they_stood(page: Page, running: Served) -> None:
    bad: list[str] = []
    for name, path in SCREENS.items():
        now, file = seen(page, running.base + path), kept_at(page, name)
        if RENEW:
            FOLDER.mkdir(exist_ok=True)
            file.write_text("[\n" + ",\n".join(json.dumps(row, ensure_ascii=False) for row in now) + "\n]\n", encoding="utf-8")
        bad += [f"{name}: {one}" for one in differences(json.loads(file.read_text(encoding="utf-8")), now)]
    assert bad == []


MUTANTS = {
    "moved": "document.querySelector('main a.go').style.marginLeft = '9px'",
    "coloured": "document.querySelector('#stop').style.backgroundColor = '#22506e'",
    "silent": "document.querySelector('main h1').textContent = ''",
    "gone": "document.querySelector('#stop').hidden = true",
    "another word": "document.querySelector('main a.go').textContent += '!'",
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_change_is_told(page: Page, running: Served, mutant: str) -> None:
    before = seen(page, f"{running.base}/")
    page.evaluate(MUTANTS[mutant])
    assert differences(before, page.evaluate(SEEN)), mutant


def test_the_font_makes_every_character_alike(page: Page, running: Served) -> None:
    seen(page, f"{running.base}/")
    width = """text => { const e = document.createElement("span"); e.style.cssText = "position:absolute;font-size:20px;white-space:pre";
      e.textContent = text; document.body.append(e); return e.getBoundingClientRect().width; }"""
    assert {page.evaluate(width, text) for text in ("iiii", "WWWW", "µ±日本", "1. A")} == {40.0}


def test_the_kept_layouts_are_small() -> None:
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 1_500_000
    assert {re.sub(r"-\d+$", "", file.stem) for file in FOLDER.iterdir()} == set(SCREENS)
