"""The Modbus link when the other end or the caller goes away: hang-ups, cancellations, closing."""

from __future__ import annotations

import asyncio

import pytest

from abbe.drivers.errors import LinkDown, ReplyTimeout
from abbe.drivers.links.modbus import READ_HOLDING, ModbusWire, Request
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.urls import parse_url
from tests.drivers.contract.link_peer import TIMEOUT_S, silent
from tests.drivers.contract.link_peer import patient as patient  # fixture

AT_ONCE_S = 0.1


async def test_hang_up_during_a_write_is_link_down_at_once(peer, link):
    async def hang_up(exchange) -> None:
        exchange.hang_up()

    peer.tricks = [hang_up]
    loop = asyncio.get_running_loop()
    start = loop.time()
    with pytest.raises(LinkDown, match="closed"):
        await link.write(100, [1])
    assert loop.time() - start < AT_ONCE_S < TIMEOUT_S
    if not peer.rtu:
        assert await link.read(400, 1) == (400,)
        assert link.connections == 2
    else:
        with pytest.raises(LinkDown, match="plug the adapter in"):
            await link.read(100, 1)


async def test_hang_up_while_idle_is_noticed(tcp_peer):
    link = await ModbusLink.connect(parse_url(tcp_peer.url), timeout_s=TIMEOUT_S)
    await link.read(1, 1)
    for writer in list(tcp_peer.writers):
        writer.close()
        await writer.wait_closed()
    assert await link.read(1, 1) == (0,)
    assert link.connections == 2
    await link.close()


async def test_nobody_there(tcp_peer):
    await tcp_peer.stop()
    with pytest.raises(LinkDown) as caught:
        await ModbusLink.connect(parse_url(tcp_peer.url))
    assert caught.value.remedy
    with pytest.raises(LinkDown, match="plug the adapter in"):
        await ModbusLink.connect(parse_url("modbus+rtu:///dev/no-such-port"))


async def test_a_cancellation_while_connecting_is_never_lost(peer):
    """Also in the turn of the event loop in which the connection comes up; and no connection stays open."""
    for turns in range(20):
        connecting = asyncio.create_task(ModbusLink.connect(parse_url(peer.url)))
        for _ in range(turns):
            await asyncio.sleep(0)
        if connecting.done():
            await connecting.result().close()
            break
        connecting.cancel()
        await asyncio.wait({connecting})
        assert connecting.cancelled(), f"cancelled after {turns} turns"
    link = await ModbusLink.connect(parse_url(peer.url))  # the port is free
    await link.close()
    assert turns > 2


async def test_a_cancellation_that_meets_the_reply_is_never_lost(tcp_peer):
    """Python 3.11 loses it in wait_for, which pymodbus awaits; the request after it would still be sent for a caller who has gone."""
    wire = ModbusWire(parse_url(tcp_peer.url))
    for turns in range(1000):
        await wire.open(TIMEOUT_S)
        asking = asyncio.create_task(wire.ask(Request(READ_HOLDING, 1, 1), TIMEOUT_S))
        for _ in range(turns):
            await asyncio.sleep(0)
        if asking.done():
            break
        asking.cancel()
        await asyncio.wait({asking})
        assert asking.cancelled(), f"cancelled after {turns} turns"
    await wire.drop()
    assert 2 < turns < 999


async def test_a_port_in_use_is_refused(rtu_peer):
    first = await ModbusLink.connect(parse_url(rtu_peer.url))
    with pytest.raises(LinkDown, match="close the other program"):
        await ModbusLink.connect(parse_url(rtu_peer.url))
    await first.close()


async def test_cancel_while_waiting_for_the_reply(peer, link):
    release = asyncio.Event()

    async def late(exchange) -> None:
        await release.wait()
        exchange.reply()

    peer.tricks = [late]
    task = asyncio.create_task(link.read(100, 2))
    await peer.asked.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    following = asyncio.create_task(link.read(200, 2))
    asyncio.get_running_loop().call_later(0.03, release.set)
    assert await following == (200, 201)
    assert link.connections == 1  # the cancelled request was waited for, so nothing had to be thrown away


async def test_cancelled_before_it_was_sent_never_reaches_the_wire(peer, link):
    release = asyncio.Event()

    async def late(exchange) -> None:
        await release.wait()
        exchange.reply()

    peer.tricks = [late]
    first = asyncio.create_task(link.read(100, 1))
    await peer.asked.wait()
    second = asyncio.create_task(link.write(300, [9]))
    await asyncio.sleep(0)
    second.cancel()
    release.set()
    assert await first == (100,)
    with pytest.raises(asyncio.CancelledError):
        await second
    assert peer.writes == []


async def test_cancelled_during_the_quarantine_never_reaches_the_wire(rtu_peer):
    link = await ModbusLink.connect(parse_url(rtu_peer.url), timeout_s=TIMEOUT_S)
    rtu_peer.tricks = [silent]
    with pytest.raises(ReplyTimeout):
        await link.write(100, [1])
    quarantined = asyncio.create_task(link.write(200, [2]))
    await asyncio.sleep(TIMEOUT_S / 3)
    quarantined.cancel()
    with pytest.raises(asyncio.CancelledError):
        await quarantined
    await link.write(300, [3])
    assert [address for address, _ in rtu_peer.writes] == [100, 300]
    await link.close()


async def test_cancel_at_every_loop_step(peer, link):
    """Cancel after n turns of the event loop, for all n until the request is through: the next answer is always the right one."""
    for turns in range(60):
        task = asyncio.create_task(link.read(100 + turns, 1))
        for _ in range(turns):
            await asyncio.sleep(0)
        was_done = task.done()
        task.cancel()
        try:
            assert await task == (100 + turns,)
            assert was_done
        except asyncio.CancelledError:
            assert not was_done
        assert await link.read(700 + turns, 1) == (700 + turns,)
        if turns > 20 and was_done:
            break


async def test_outer_timeout_is_a_timeout_error(peer, link):
    peer.always = silent
    with pytest.raises(TimeoutError) as caught:
        async with asyncio.timeout(TIMEOUT_S / 5):
            await link.read(100, 1)
    assert not isinstance(caught.value, ReplyTimeout)


async def test_many_callers_take_turns(peer, link):
    answers = await asyncio.gather(*(link.read(address, 2) for address in range(0, 100, 2)))
    assert answers == [(address, address + 1) for address in range(0, 100, 2)]


async def test_close_ends_a_pending_request(peer, link):
    peer.always = silent
    task = asyncio.create_task(link.read(100, 1))
    await peer.asked.wait()
    await link.close()
    with pytest.raises(LinkDown):
        await task
    with pytest.raises(LinkDown):
        await link.read(100, 1)
    await link.close()


async def test_a_babbling_rtu_line_is_reported(rtu_peer):
    link = await ModbusLink.connect(parse_url(rtu_peer.url), timeout_s=0.05)
    rtu_peer.tricks = [silent]
    loop = asyncio.get_running_loop()
    talking = True

    def babble() -> None:
        if talking and rtu_peer.master >= 0:
            rtu_peer.write(b"\x11\x22\x33")
            loop.call_later(0.01, babble)

    with pytest.raises(ReplyTimeout):
        await link.write(1, [1])
    babble()
    with pytest.raises(LinkDown, match="silent"):
        await link.read(1, 1)
    talking = False
    await link.close()


@pytest.mark.parametrize("count", [0, 126])
async def test_impossible_counts(link, count):
    with pytest.raises(ValueError, match="Modbus"):
        await link.read(0, count)
    with pytest.raises(ValueError, match="Modbus"):
        await link.write(0, [0] * count)
