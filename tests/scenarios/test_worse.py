"""A verification that is worse, or tells nothing, in every way that reliability.md H11 names: the old table is in force again within 5 s.

Through `Pushing` on a simulated controller, with measurements on simulated instruments. What cannot be taken back now stays pending,
loudly, and goes at the edge at which the machine is safe or answers.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.drivers.errors import DriverError
from abbe.service.clock import SystemClock
from abbe.service.compensation.recover import finish_when_safe
from abbe.service.devices.session import Session, open_session
from abbe.service.errors import MeasurementFault, PreconditionsChanged, StatusUnknown, StillActive
from abbe.service.storage.store import Store
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.scenario import Fault, FaultScenario
from tests.scenarios.test_push import active
from tests.scenarios.verifying import LIMIT_S, LONG, Push, Runs, Shop, long, made_shop, plan_of, state

BACK_OFF_S = 30.0
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
        "only one of the two verifications has a helix",
    ),
    "measured with another table": (
        lambda s: Push(s, *s.here, s.tables(), alter=of_the_old_table),
        "cannot tell whether the machine is better: the machine was measured with table 0000002A",
    ),
    "warmer between before and after": (
        lambda s: Push(s, *s.here, s.tables(), lambda: s.sims.ask("air", plus_c=3.0)),
        "cannot tell whether the machine is better: the air was at",
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
    "not a number": ({"alter": not_numbers}, MeasurementFault, "not a finite number"),
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


async def test_an_interlock_in_the_middle_is_pending_and_loud_and_goes_at_the_edge(shop: Shop) -> None:
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            base = await active(session)
            push = Push(shop, store, session, shop.tables(), lambda: shop.sims.ask("estop", on=True))
            with pytest.raises(StillActive, match=r"(?i)e-stop.*STILL ACTIVE"):
                await push.bring()
            assert (state(store), push.took_s < LIMIT_S) == ("ROLLBACK_PENDING", True)
            assert await active(session) != base
            done, took_s = await _finished(shop, store, session, released)
            assert "made active again" in done
            assert (await active(session), state(store)) == (base, "ROLLED_BACK")
            assert took_s < LIMIT_S
            assert await finish_when_safe(session.controller, store, shop.site, limit_s=1.0, clock=SystemClock(), notify=print) is None


def released(shop: Shop) -> None:
    """The person at the machine: e-stop released, alarm reset."""
    shop.sims.ask("reset")


async def _finished(shop: Shop, store: Store, session: Session, make_safe: Callable[[Shop], None]) -> tuple[str, float]:
    """Wait as a command does; the machine becomes safe after the first loud word. Gives what was done, and how long after that edge."""
    heard: list[str] = []
    loud = asyncio.Event()

    def say(text: str) -> None:
        heard.append(text)
        loud.set()

    waiting = asyncio.ensure_future(finish_when_safe(session.controller, store, shop.site, limit_s=60.0, clock=SystemClock(), notify=say))
    await loud.wait()
    assert "UNVERIFIED TABLE IS ACTIVE" in heard[0]
    assert not waiting.done()
    make_safe(shop)
    safe_s = time.monotonic()
    done = await waiting
    took_s = time.monotonic() - safe_s
    print(f"base in force {took_s:.2f} s after the machine was safe; heard: {heard}")  # noqa: T201
    assert done is not None
    return done, took_s


async def test_waiting_ends_when_its_time_is_over_and_can_be_broken_off(shop: Shop) -> None:
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            base, clock, heard = await active(session), SystemClock(), []
            with pytest.raises(StillActive):
                await Push(shop, store, session, shop.tables(), lambda: shop.sims.ask("estop", on=True)).bring()
            with pytest.raises(StillActive, match="STILL ACTIVE after 0 s"):
                await finish_when_safe(session.controller, store, shop.site, limit_s=0.2, clock=clock, notify=heard.append)
            assert len(heard) == 1
            entries = len(store.pushes.entries("sim"))
            waiting = asyncio.ensure_future(
                finish_when_safe(session.controller, store, shop.site, limit_s=60.0, clock=clock, notify=lambda text: waiting.cancel())
            )
            with pytest.raises(asyncio.CancelledError):
                await waiting
            assert (state(store), len(store.pushes.entries("sim"))) == ("ROLLBACK_PENDING", entries)  # looking writes nothing
            released(shop)
            done = await finish_when_safe(session.controller, store, shop.site, limit_s=60.0, clock=clock, notify=heard.append)
            assert "made active again" in str(done)
            assert await active(session) == base


@pytest.mark.parametrize("back", [pytest.param(True, marks=long), False], ids=["for a moment", "for longer"])
async def test_a_link_lost_in_the_middle_goes_back_as_soon_as_it_is_there(shop: Shop, back: bool) -> None:
    host, port = shop.site.urls.cnc.removeprefix("modbus+tcp://").partition("?")[0].split(":")
    proxy = ModbusProxy((host, int(port)))
    await proxy.start()

    def cut() -> None:
        proxy.play(FaultScenario("cut", 1, (Fault("drop_request", times=3 if back else 0),)))

    try:
        with Store.open(shop.url) as store:
            async with open_session(replace(shop.site.urls, cnc=proxy.url)) as session:
                base = await active(session)
                push = Push(shop, store, session, shop.tables(), cut)
                if back:
                    with pytest.raises(StatusUnknown):
                        await push.bring()
                    assert push.took_s < LIMIT_S
                else:
                    with pytest.raises(StillActive):
                        await push.bring()
                    assert state(store) in ("ROLLBACK_PENDING", "ROLLBACK", "PROBED")
                    done, took_s = await _finished(shop, store, session, lambda shop: proxy.play(FaultScenario()))
                    assert "made active again" in done
                    assert took_s < LIMIT_S + BACK_OFF_S  # a link that was long gone is not tried again at once
                assert (await active(session), state(store)) == (base, "ROLLED_BACK")
    finally:
        await proxy.stop()


async def test_what_is_better_stays(shop: Shop) -> None:
    """The other side of all these: the same measurement keeps a table that is better. Last in this file, because it stays."""
    with Store.open(shop.url) as store:
        async with open_session(shop.site.urls) as session:
            pushed = await Push(shop, store, session, shop.tables()).bring()
            assert (pushed.kept, await active(session), state(store)) == (True, (pushed.bank, pushed.crc), "KEEP")
