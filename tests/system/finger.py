"""A person with a finger: what is touched on one page, and the faults of each screen on the way."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from playwright.sync_api import Locator, Page

from tests.pages_world import PHRASE
from tests.system.test_serve_screens import BROKEN, INSIDE, SMALL, violations

MARK = "() => { document.documentElement.dataset.touched = 'yes'; }"
ARRIVED = """([path, query]) => {
  const html = document.documentElement.dataset, at = new URL(location.href);
  if (at.pathname !== path || !at.search.startsWith(query) || html.ready !== "yes" || html.touched) return false;
  const live = document.getElementById("live");
  return !live || "job" in live.dataset;
}"""
"""The screen of an address stands, it is not the one that was touched, and it will not load itself anew as `live` without a job does."""


@dataclass
class Finger:
    """What a person touches. ``rules``: options of axe-core; ``bad``: faults that were seen; ``counts``: touches of each task."""

    page: Page
    axe: str
    rules: str = "{}"
    touches: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    bad: list[str] = field(default_factory=list)

    def touch(self, what: Locator | str) -> None:
        """Touch what is in reach: Playwright refuses what is covered or out of the window."""
        where = self.page.locator(what).first if isinstance(what, str) else what
        where.wait_for()
        self.page.evaluate(MARK)
        where.tap()
        self.touches += 1

    def screen(self, address: str) -> None:
        """Wait for the screen that the last touch has led to, and look for its faults."""
        page, (path, _, query) = self.page, address.partition("?")
        page.wait_for_function(ARRIVED, arg=[path, f"?{query}" if query else ""])
        self.bad += [] if page.evaluate(INSIDE) else [f"{path}: scrolls sideways"]
        self.bad += [f"{path}: broken word {one}" for one in page.evaluate(BROKEN)]
        self.bad += [f"{path}: small target {one}" for one in page.evaluate(SMALL)]
        self.bad += [f"{path}: {one}" for one in violations(page, self.axe, self.rules)]

    def shot(self, name: str) -> None:
        """Take a picture of the whole screen where ``ABBE_SHOTS`` names a folder."""
        folder = os.environ.get("ABBE_SHOTS")
        if folder:
            self.page.screenshot(path=f"{folder}/{name}.png", full_page=True)

    def counted(self, what: str, since: int) -> int:
        """Keep and return the touches of a task that began at ``since``."""
        self.counts[what] = self.touches - since
        return self.counts[what]

    def logs_in(self, base: str, name: str) -> None:
        """Typed, not touched."""
        self.page.goto(f"{base}/login")
        self.page.fill("#name", name)
        self.page.fill("#password", PHRASE)
        self.page.tap("button[type=submit]")
        self.screen("/")
