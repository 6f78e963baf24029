"""Row M11 and goal G8: one socket, patient attempts, a peer that is gone is found, and work goes on when it is back."""

from __future__ import annotations

import asyncio
import random

import pytest

from abbe.drivers.errors import DriverError, LinkDown, on_behalf_of
from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.urls import ModbusTcpUrl
from abbe.simulators.faults.modbus_proxy import ModbusProxy, refusing
from abbe.simulators.faults.scenario import Fault, FaultScenario, scenario
from tests.faults import rows_modbus as rows
from tests.faults.contract import Observed, assert_fault_contract, told_of
from tests.faults.modbus_rig import KINDS, observe, opened, records_of
from tests.faults.patient import patience

MINUTE_S = 60.0


@pytest.fixture(scope="module", autouse=True)
def _patient():
    with patience():
        yield


class Hands:
    """A clock that only the test moves: waiting takes no time."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.slept_s: list[float] = []

    def clock(self) -> float:
        return self.now_s

    async def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds
        await asyncio.sleep(0)


@pytest.fixture
async def listener():
    """A peer that accepts and hangs up; counts how often."""
    proxy = ModbusProxy(("127.0.0.1", 1), refusing())
    await proxy.start()
    yield proxy
    await proxy.stop()


async def hammer(link: ModbusLink, hands: Hands) -> list[float]:
    """Somebody asks all the time, for a minute; gives when the errors were told."""
    told = []
    while hands.now_s < MINUTE_S:
        with pytest.raises(LinkDown):
            await link.read(0, 4)
        told.append(hands.now_s)
        hands.now_s += 0.1
    return told


@pytest.mark.parametrize("seed", range(5))
async def test_at_most_eight_attempts_in_a_minute_against_accept_then_close(listener, seed):
    hands = Hands()
    backoff = Backoff(clock=hands.clock, sleep=hands.sleep, draw=random.Random(seed).random)
    link = ModbusLink(ModbusTcpUrl("127.0.0.1", listener.port), timeout_s=0.3, backoff=backoff)
    await hammer(link, hands)
    assert 5 <= listener.connections <= 8
    assert listener.most_open <= 1
    await link.close()


@pytest.mark.parametrize("seed", range(5))
async def test_at_most_eight_attempts_in_a_minute_against_refusal(monkeypatch, seed):
    hands, attempts = Hands(), []
    backoff = Backoff(clock=hands.clock, sleep=hands.sleep, draw=random.Random(seed).random)
    noted = backoff.attempted
    monkeypatch.setattr(backoff, "attempted", lambda: (attempts.append(hands.now_s), noted()))
    proxy = ModbusProxy(("127.0.0.1", 1))
    port = await proxy.start()
    await proxy.stop()  # nobody listens there now
    link = ModbusLink(ModbusTcpUrl("127.0.0.1", port), timeout_s=0.3, backoff=backoff)
    told = await hammer(link, hands)
    assert 5 <= len(attempts) <= 8
    assert len(told) > 100  # whoever asks is told at once, not when the next attempt is due
    await link.close()


def test_the_waits_grow_to_thirty_seconds_and_only_a_good_answer_ends_them():
    hands = Hands()
    backoff = Backoff(clock=hands.clock, sleep=hands.sleep, draw=lambda: 0.5)
    waits = []
    for _ in range(9):
        backoff.attempted()
        waits.append(backoff.left_s())
        hands.now_s += backoff.left_s()
    assert waits == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    backoff.attempted()
    backoff.succeeded()
    assert backoff.left_s() == 0.0
    edges = [Backoff(clock=hands.clock, draw=lambda edge=edge: edge) for edge in (0.0, 1.0)]
    for one in edges:
        one.attempted()
    assert [round(one.left_s(), 3) for one in edges] == [0.4, 0.6]


async def test_back_off_is_not_ended_by_a_connection_that_was_only_made(listener):
    hands = Hands()
    link = ModbusLink(
        ModbusTcpUrl("127.0.0.1", listener.port), timeout_s=0.3, backoff=Backoff(clock=hands.clock, sleep=hands.sleep, draw=lambda: 0.5)
    )
    for _ in range(3):
        with pytest.raises(LinkDown):
            await link.read(0, 4)
    assert hands.slept_s[:2] == [0.5, 1.0]  # the first attempt at once
    await link.close()


async def test_work_goes_on_within_two_seconds_when_the_peer_is_back():
    async with opened("cnc") as rig:
        line, clock = rig.line, asyncio.get_running_loop().time
        assert isinstance(line, ModbusProxy)
        await line.stop()
        with pytest.raises(DriverError):
            await rig.cnc.status()
        await line.start(line.port)
        began = clock()
        while True:
            try:
                await rig.cnc.status()
                break
            except LinkDown:
                assert clock() - began < 2.0
        assert clock() - began < 2.0
        assert line.most_open == 1


async def test_the_old_socket_is_closed_before_a_new_one_is_made():
    """A device that allows one socket refuses a second: 15 lost connections, and never two at a time."""
    async with opened("cnc", timeout_s=0.3) as rig:
        line = rig.line
        assert isinstance(line, ModbusProxy)
        for how in ("fin", "rst", "drop_reply") * 5:
            line.play(scenario(Fault(how), Fault("one_socket", times=0)))
            await rig.cnc.status()
        assert line.connections >= 16  # one more for each time that this computer was slow
        assert line.most_open == 1


async def test_a_dropped_socket_is_closed_when_drop_returns():
    async with opened("cnc") as rig:
        wire = rig.link._wire
        assert wire._client is not None
        end = wire._client.ctx.transport.get_extra_info("socket")
        assert end.fileno() != -1
        await wire.drop()
        assert end.fileno() == -1
        await rig.cnc.status()


async def test_a_disturbed_line_is_proven_by_the_canary_before_anything_is_believed():
    async with opened("laser", "rtu", timeout_s=0.2) as rig:
        before = rig.line.requests
        rig.line.play(scenario(Fault("drop_reply", times=2)))
        assert KINDS["laser reading"].right(rig, await rig.laser.read())
        # the request and its silence, the first canary (not answered), the second, the request again and the canary behind it
        assert rig.line.requests - before == 5
        assert rig.link.state == "up"


async def test_a_line_that_never_proves_itself_is_given_up():
    async with opened("laser", "rtu", timeout_s=0.1) as rig:
        rig.line.play(scenario(Fault("drop_reply", times=0)))
        with pytest.raises(LinkDown, match="canary"):
            await rig.laser.read()
        assert rig.link.state == "quarantine"
        rig.line.play(FaultScenario())
        await rig.laser.read()
        assert rig.link.state == "up"


async def test_an_idle_link_keeps_looking_and_says_when_the_device_is_back():
    async with opened("laser", heartbeat_s=0.2) as rig:
        line, clock = rig.line, asyncio.get_running_loop().time
        assert isinstance(line, ModbusProxy)
        await line.stop()
        began = clock()
        while rig.link.incidents.open is None:
            assert clock() - began < 3.0
            await asyncio.sleep(0.02)
        await line.start(line.port)
        while rig.link.incidents.open is not None:
            assert clock() - began < 10.0
            await asyncio.sleep(0.02)
        assert [entry.kind for entry in rig.link.incidents.entries] == ["detected", "outcome"]
        assert rig.link.incidents.entries[-1].state == "recovered"


FAULTS = {
    "one socket only": (Fault("one_socket", times=0), Fault("fin")),
    "oldest kicked": (Fault("kick_oldest", times=0), Fault("rst")),
    "accept then close": (Fault("fin_before"), Fault("accept_then_close", times=2)),
}


@pytest.mark.parametrize("case", rows.ROWS[-1].cases)
async def test_m11_stingy_devices(case):
    with on_behalf_of(f"run M11/{case}"):
        if case == "refused":
            assert_fault_contract(await _refused())
            return
        async with opened("cnc") as rig:
            line = rig.line
            assert isinstance(line, ModbusProxy)
            seen = await observe(rig, "M11", case, KINDS["status"], lambda rig: line.play(scenario(*FAULTS[case])))
            assert line.most_open == 1
        assert_fault_contract(seen)


async def _refused() -> Observed:
    async with opened("cnc") as rig:
        line = rig.line
        assert isinstance(line, ModbusProxy)
        await line.stop()
        with pytest.raises(LinkDown) as caught:
            await rig.cnc.status()
        state = rig.link.state
        await line.start(line.port)
        resumed = KINDS["status"].right(rig, await rig.cnc.status())
        await rig.device.close()
        return Observed("M11", "refused", told_of(caught.value), state=state, resumed=resumed, records=records_of(rig.link))


async def test_a_link_can_be_closed_while_it_waits_for_its_next_attempt(listener):
    link = ModbusLink(ModbusTcpUrl("127.0.0.1", listener.port), timeout_s=0.3, canary=Canary(), backoff=Backoff(first_s=1.0))
    with pytest.raises(LinkDown):
        await link.read(0, 4)
    waiting = asyncio.create_task(link.read(0, 4))
    await asyncio.sleep(0.05)
    await link.close()
    with pytest.raises(LinkDown):
        await waiting
