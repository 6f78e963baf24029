"""What is worse and cannot be taken back now stays pending, loudly, and goes at the edge at which the machine is safe or answers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from abbe.service.clock import SystemClock
from abbe.service.compensation.recover import finish_when_safe
from abbe.service.devices.session import Session, open_session
from abbe.service.errors import StatusUnknown, StillActive
from abbe.service.storage.store import Store
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.scenario import Fault, FaultScenario
from tests.scenarios.test_push import active
from tests.scenarios.verifying import LIMIT_S, Push, Shop, long, made_shop, state

BACK_OFF_S = 30.0
pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def shop(tmp_path_factory) -> Iterator[Shop]:
    with made_shop(tmp_path_factory.mktemp("worse")) as made:
        yield made


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
