"""A machine whose table in force is well off, and pushes of other tables that a real measurement decides about."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.models.compensation.tables import NineTables
from abbe.service.campaigns.measure import measure
from abbe.service.compensation.proposals import load_runs
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.devices.session import Session, open_session
from abbe.service.domain.progress import Progress, ignore_progress
from abbe.service.domain.run import Run
from abbe.service.push.journal import check_chain
from abbe.service.push.operations import VerificationResult
from abbe.service.sequences.recipes.recipe import Diagonal, Helix
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from abbe.service.verification.verify import VerificationFigures, decide, figures
from tests.scenarios.conftest import simulated
from tests.scenarios.test_push import linear_tables, site_of

LIMIT_S = 5.0
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
DIAGONALS = ("ppp", "npp", "pnp", "ppn")
Runs = list[Run]


def plan_of(site: Site, name: str, *, diagonals: tuple[str, ...] = DIAGONALS, helix: bool = True) -> CampaignPlan:
    """A short verification: what a decision needs and no more."""
    tests = [Helix("check-helix", "VB", "holdout", (300.0, 250.0, 100.0), 100.0, turns=3, rate_hz=20).plan(site.machine)] if helix else []
    tests += [Diagonal(f"check-{d}", f"V{d}", "holdout", d, 4, "").plan(site.machine) for d in diagonals]
    return CampaignPlan(name, tuple(tests))


@dataclass
class Shop:
    """A machine with a table in force that is well off on three of its four diagonals, and how it measured."""

    sims: Any
    site: Site
    url: str
    before: VerificationFigures = field(init=False)
    said: list[str] = field(default_factory=list)
    number: int = 0
    here: tuple[Store, Session] = field(init=False)

    def tables(self, scale: float = 0.0, shear: float = 0.0, ellipse: float = 0.0) -> NineTables:
        """``scale`` of X; ``shear``: lengthens ppp three times as much as it shortens the others; ``ellipse``: no diagonal sees it."""
        length = np.diff(np.asarray(self.site.machine.stroke_mm), axis=1)[:, 0]
        slopes = np.zeros((3, 3))
        slopes[0, 0] = scale + ellipse
        slopes[1, 1] = -ellipse * (length[0] / length[1]) ** 2
        slopes[0, 1], slopes[1, 2], slopes[2, 0] = (shear * length[0] ** 2 / (length[a] * length[(a + 1) % 3]) for a in range(3))
        return linear_tables(self.site, slopes)


BASE = {"scale": 60e-5, "shear": -20e-5}


@contextmanager
def made_shop(folder: Path) -> Iterator[Shop]:
    """The machine, its table in force and its verification with it, measured."""
    with simulated(folder, "--speed", "120", "--seed", "5") as sims:
        made = Shop(sims, site_of(sims), f"sqlite:///{folder / 'abbe.sqlite3'}")
        asyncio.run(_prepared(made))
        yield made


async def _prepared(shop: Shop) -> None:
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:

            async def yes() -> VerificationResult:
                return VerificationResult(True, "the table that is there")

            wanted = WantedTable(shop.tables(**BASE), await read_base(session.controller), 100, None, {})
            assert (await Pushing(session.controller, store, shop.site).bring(wanted, Questions(list, "a test", yes, yes))).kept
            ids = await measure(session, store, shop.site, plan_of(shop.site, "before"), progress=ignore_progress)
            shop.before = figures(await load_runs(store, ids))


@dataclass
class Push:
    """One push, verified by a measurement. ``meanwhile`` happens once in the middle of it; ``alter`` changes what was read."""

    shop: Shop
    store: Store
    session: Session
    tables: NineTables
    meanwhile: Callable[[], object] | None = None
    alter: Callable[[Runs], None] = lambda runs: None
    plan: CampaignPlan | None = None
    told_s: float = 0.0
    took_s: float = 0.0

    async def bring(self) -> PushResult:
        self.pushing = Pushing(self.session.controller, self.store, self.shop.site)

        async def yes() -> VerificationResult:
            return VerificationResult(True, "a stand-in")

        async def verify() -> VerificationResult:
            try:
                return await self._verify()
            finally:
                self.told_s = time.monotonic()

        wanted = WantedTable(self.tables, await read_base(self.session.controller), 100, None, {})
        try:
            return await self.pushing.bring(wanted, Questions(list, "a test", yes, verify))
        finally:
            self.took_s = time.monotonic() - self.told_s
            print(f"ended {self.took_s:.2f} s after the verdict")  # noqa: T201

    async def _verify(self) -> VerificationResult:
        self.shop.number += 1
        plan = replace(self.plan or plan_of(self.shop.site, ""), name=f"after {self.shop.number}")
        ids = await measure(self.session, self.store, self.shop.site, plan, progress=self._watch)
        runs = await load_runs(self.store, ids)
        self.alter(runs)
        decision = decide(self.shop.before, figures(runs), self.pushing.crc)
        return VerificationResult(decision.keep, decision.text)

    def _watch(self, p: Progress) -> None:
        if self.meanwhile is not None and p.stage.startswith("after") and p.done > 0.5 * p.total:
            happen, self.meanwhile = self.meanwhile, None
            happen()


def state(store: Store) -> str:
    entries = store.pushes.entries("sim")
    check_chain(entries)
    return str(entries[-1].state)


long = pytest.mark.skipif(not LONG, reason="ABBE_TEST_LONG=1 runs it")
