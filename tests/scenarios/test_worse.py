"""A verification that is worse, or tells nothing, in every way that reliability.md H11 names: the old table is in force again within 5 s.

Through `Pushing` on a simulated controller, with measurements on simulated instruments. A machine that is not safe: test_pending.py.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.drivers.errors import DriverError
from abbe.service.devices.session import open_session
from abbe.service.errors import MeasurementFault, PreconditionsChanged
from abbe.service.storage.store import Store
from tests.scenarios.test_push import active
from tests.scenarios.verifying import LIMIT_S, LONG, Push, Runs, Shop, long, made_shop, plan_of, state

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def shop(tmp_path_factory) -> Iterator[Shop]:
    with made_shop(tmp_path_factory.mktemp("worse")) as made:
        yield made


def scattered(runs: Runs) -> None:
    """Every second reading is off by 0.4 mm: what a loose reflector does."""
    for k, run in enumerate(runs):
        if run.test == "laser_diagonal":
            runs[k] = run.with_readings(run.columns.readings_mm + 0.4 * (np.arange(len(run.columns)) % 2))


def not_numbers(runs: Runs) -> None:
    k = next(k for k, r in enumerate(runs) if r.test == "laser_diagonal")
    runs[k] = runs[k].with_readings(np.full(len(runs[k].columns), np.nan))


def of_the_old_table(runs: Runs) -> None:
    runs[-1] = replace(runs[-1], table=replace(runs[-1].table, crc=42))


def empty(runs: Runs) -> None:
    k = next(k for k, r in enumerate(runs) if r.test == "ballbar_helix")
    runs[k] = replace(runs[k], columns=replace(runs[k].columns, valid=np.zeros(len(runs[k].columns), dtype=bool)))


WAYS = {
    "equal": (lambda s: Push(s, *s.here, s.tables(60.01e-5, -20e-5)), "no improvement beyond its uncertainty"),
    "worse": (lambda s: Push(s, *s.here, s.tables(90e-5, -20e-5)), "no improvement beyond its uncertainty"),
    "worse on one diagonal only": (lambda s: Push(s, *s.here, s.tables(0.0, 12e-5)), "diagonal ppp got worse"),
    "only the helix worse": (lambda s: Push(s, *s.here, s.tables(ellipse=1e-3)), "helix got worse"),
    "uncertainties too large": (lambda s: Push(s, *s.here, s.tables(), alter=scattered), "beyond its uncertainty"),
    "the helix measured only once": (
        lambda s: Push(s, *s.here, s.tables(), plan=plan_of(s.site, "", helix=False)),
        "the helix was measured only once",
    ),
    "measured with another table": (
        lambda s: Push(s, *s.here, s.tables(), alter=of_the_old_table),
        "cannot tell whether it is better: it was measured with table 0000002A",
    ),
    "warmer between before and after": (
        lambda s: Push(s, *s.here, s.tables(), lambda: s.sims.ask("air", plus_c=3.0)),
        "cannot tell whether it is better: the air had",
    ),
}
"""Ways in which the verification says no: what is pushed and what happens, and what stands in the journal."""


def some(ways: dict[str, Any], *short: str) -> list[Any]:
    """All ways, or a few where time is short."""
    return [pytest.param(way, marks=[] if LONG or way in short else [pytest.mark.skip(reason="ABBE_TEST_LONG=1 runs it")]) for way in ways]


@pytest.mark.parametrize("way", some(WAYS, "worse on one diagonal only", "measured with another table", "warmer between before and after"))
async def test_what_is_not_clearly_better_goes_back(shop: Shop, way: str) -> None:
    make, why = WAYS[way]
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            shop.here = (store, session)
            base = await active(session)
            push = make(shop)
            pushed = await push.bring()
            if way.startswith("warmer"):
                shop.sims.ask("air", plus_c=-3.0)
            print(f"{way}: base in force {push.took_s:.2f} s after the verdict: {pushed.why}")  # noqa: T201
            assert (pushed.kept, await active(session), state(store)) == (False, base, "ROLLED_BACK")
            assert why in pushed.why
            assert push.took_s < LIMIT_S


RAISING = {
    "a figure is missing": ({"plan": {"diagonals": ("ppp", "npp", "pnp")}}, MeasurementFault, "body diagonal ppn is missing"),
    "no valid reading": ({"alter": empty}, MeasurementFault, "only 0 valid readings"),
    "not a number": ({"alter": not_numbers}, MeasurementFault, "no finite number"),
}


@pytest.mark.parametrize("way", some(RAISING, "a figure is missing"))
async def test_what_is_no_measurement_goes_back_and_is_told(shop: Shop, way: str) -> None:
    words, error, text = RAISING[way]
    plan = plan_of(shop.site, "", **words["plan"]) if "plan" in words else None
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            base = await active(session)
            push = Push(shop, store, session, shop.tables(), alter=words.get("alter", lambda runs: None), plan=plan)
            with pytest.raises(error, match=text):
                await push.bring()
            assert (await active(session), state(store)) == (base, "ROLLED_BACK")
            assert push.took_s < LIMIT_S


@long
async def test_aborted_in_the_middle_goes_back(shop: Shop) -> None:
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            base = await active(session)
            task = asyncio.current_task()
            assert task is not None
            push = Push(shop, store, session, shop.tables(), task.cancel)
            with pytest.raises(asyncio.CancelledError):
                await push.bring()
            task.uncancel()
            assert (await active(session), state(store)) == (base, "ROLLED_BACK")
            assert push.took_s < LIMIT_S


@long
async def test_another_table_in_the_middle_is_seen_and_goes_back(shop: Shop) -> None:
    """Somebody at the panel switches to the old table: the next run does not begin, and half a verification is none."""
    switched: list[asyncio.Task[None]] = []
    with Store.open(shop.url) as store:
        async with (
            open_session(shop.site.urls) as session,
            open_session(replace(shop.site.urls, ballbar=None, laser=None, fixture=None)) as panel,
        ):
            base = await active(session)

            async def by_hand() -> None:
                controller = panel.controller
                now = await controller.comp_status()
                await controller.release(now.lease_owner)
                await controller.lease(7, 60_000)
                while True:  # between two motions
                    try:
                        bank, gen = 1 - now.active_bank, (await controller.comp_status()).gen
                        await controller.activate(bank, expect_crc=now.bank_crc[bank], expect_gen=gen, owner=7)
                        break
                    except DriverError:
                        continue
                await controller.release(7)

            push = Push(shop, store, session, shop.tables(), lambda: switched.append(asyncio.ensure_future(by_hand())))
            with pytest.raises(PreconditionsChanged, match="another compensation table is active"):
                await push.bring()
            await switched[0]
            assert (await active(session), state(store)) == (base, "ROLLED_BACK")
            assert push.took_s < LIMIT_S


async def test_what_is_better_stays(shop: Shop) -> None:
    """The other side of all these: the same measurement keeps a table that is better. Last in this file, because it stays."""
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            pushed = await Push(shop, store, session, shop.tables()).bring()
            assert (pushed.kept, await active(session), state(store)) == (True, (pushed.bank, pushed.crc), "KEEP")
