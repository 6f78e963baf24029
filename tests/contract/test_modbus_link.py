"""The Modbus link against a peer that misbehaves, over real sockets and ptys."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from drivers.errors import BadFrame, DeviceFault, LinkDown, Refused, ReplyTimeout
from drivers.links.modbus import ModbusLink
from drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, parse_url

TIMEOUT_S = 0.15


@pytest.fixture
async def link(peer) -> AsyncIterator[ModbusLink]:
    for address in range(1000):
        peer.words[address] = address
    url = parse_url(peer.url)
    assert isinstance(url, ModbusTcpUrl | ModbusRtuUrl)
    opened = await ModbusLink.connect(url, timeout_s=TIMEOUT_S)
    yield opened
    await opened.close()


async def silent(exchange) -> None:
    return


def times(trick, n=2):
    """Reads are repeated once, so a trick has to be played twice to reach the caller."""
    return [trick] * n


async def test_reads_and_writes(peer, link):
    assert await link.read(100, 3) == (100, 101, 102)
    assert await link.read(0, 125) == tuple(range(125))
    await link.write(200, [1, 2, 0xFFFF])
    assert peer.writes == [(200, (1, 2, 0xFFFF))]
    assert await link.read(200, 3) == (1, 2, 0xFFFF)


async def test_silence_is_a_reply_timeout_and_the_link_recovers(peer, link):
    peer.tricks = times(silent)
    with pytest.raises(ReplyTimeout) as caught:
        await link.read(100, 2)
    assert caught.value.retryable
    assert await link.read(100, 2) == (100, 101)


async def test_a_read_is_repeated_once(peer, link):
    peer.tricks = [silent]
    assert await link.read(100, 2) == (100, 101)
    assert len(peer.requests) == 2


async def test_a_write_is_never_repeated(peer, link):
    peer.tricks = [silent]
    with pytest.raises(ReplyTimeout):
        await link.write(100, [1])
    assert await link.read(300, 1) == (300,)
    assert [request[0] for request in peer.requests] == [16, 3]


@pytest.mark.parametrize("count", [2, 1])
async def test_a_late_reply_is_never_taken_for_the_next_answer(peer, link, count):
    release = asyncio.Event()
    done = asyncio.Event()

    async def late(exchange) -> None:
        await release.wait()
        exchange.reply()
        done.set()

    peer.tricks = [late] if not peer.rtu else [silent, late]
    if not peer.rtu:
        assert await link.read(100, count) == tuple(range(100, 100 + count))  # repeated over a new connection
        release.set()
        await done.wait()
    else:
        with pytest.raises(ReplyTimeout):
            await link.read(100, count)
        asyncio.get_running_loop().call_later(TIMEOUT_S / 2, release.set)  # during the quarantine of the next request
    for address in (200, 300, 400):
        assert await link.read(address, count) == tuple(range(address, address + count))


async def test_late_write_echo_is_not_the_echo_of_the_next_write(peer, link):
    async def late(exchange) -> None:
        await asyncio.sleep(1.3 * TIMEOUT_S)
        exchange.reply()

    peer.tricks = [late]
    with pytest.raises(ReplyTimeout):
        await link.write(100, [1, 2])
    await link.write(110, [3, 4])
    assert peer.writes == [(100, (1, 2)), (110, (3, 4))]


WRONG = {
    "unit": lambda x: x.send(x.frame(x.honest, unit=2)),
    "fewer registers": lambda x: x.send(x.frame(b"\x03\x02\x00\x01")),
    "more registers": lambda x: x.send(x.frame(b"\x03\x06\x00\x01\x00\x02\x00\x03")),
    "function": lambda x: x.send(x.frame(b"\x04" + x.honest[1:])),
    "unknown function": lambda x: x.send(x.frame(b"\x55" + x.honest[1:])),
    "exception of another function": lambda x: x.send(x.frame(b"\x90\x02")),
    "byte count lies": lambda x: x.send(x.frame(b"\x03\x04\x00\x01")),
    "garbage": lambda x: x.send(b"\xff" * 20),
    "text": lambda x: x.send(b"HTTP/1.1 400 Bad Request\r\n\r\n"),
    "cut short": lambda x: x.send(x.frame(x.honest)[:-1]),
    "one byte": lambda x: x.send(x.frame(x.honest)[:1]),
    "twice": lambda x: x.send(2 * x.frame(x.honest)),
}


@pytest.mark.parametrize("wrong", WRONG)
async def test_a_wrong_reply_to_a_read_is_refused(peer, link, wrong):
    async def trick(exchange) -> None:
        WRONG[wrong](exchange)

    peer.tricks = times(trick)
    with pytest.raises(BadFrame):
        await link.read(100, 2)
    assert await link.read(500, 2) == (500, 501)


@pytest.mark.parametrize("changes", [{"tid": 0}, {"tid": 77}, {"pid": 1}, {"length": 4}, {"length": 60000}, {"length": 0}])
async def test_a_wrong_tcp_header_is_refused(tcp_peer, changes):
    async def trick(exchange) -> None:
        exchange.reply(**changes)

    tcp_peer.always = trick
    link = await ModbusLink.connect(parse_url(tcp_peer.url), timeout_s=TIMEOUT_S)
    with pytest.raises(BadFrame):
        await link.read(100, 2)
    await link.close()


async def test_a_wrong_rtu_check_sum_is_refused(rtu_peer):
    async def trick(exchange) -> None:
        frame = exchange.frame(exchange.honest)
        exchange.send(frame[:-1] + bytes([frame[-1] ^ 1]))

    rtu_peer.always = trick
    link = await ModbusLink.connect(parse_url(rtu_peer.url), timeout_s=TIMEOUT_S)
    with pytest.raises(BadFrame):
        await link.read(100, 2)
    await link.close()


@pytest.mark.parametrize(
    "echo", [b"\x10\x00\x64\x00\x01", b"\x10\x00\x65\x00\x02", b"\x06\x00\x64\x00\x02", b"\x10\x00\x64", b"\x10\x00\x64\x00\x02\x00"]
)
async def test_a_wrong_echo_of_a_write_is_refused(peer, link, echo):
    async def trick(exchange) -> None:
        exchange.send(exchange.frame(echo))

    peer.tricks = [trick]
    with pytest.raises(BadFrame):
        await link.write(100, [1, 2])
    assert len(peer.requests) == 1


@pytest.mark.parametrize(
    ("code", "error", "retryable"),
    [
        (1, Refused, False),
        (2, Refused, False),
        (3, Refused, False),
        (4, DeviceFault, False),
        (5, ReplyTimeout, True),
        (6, ReplyTimeout, True),
        (8, DeviceFault, False),
        (10, DeviceFault, False),
        (11, DeviceFault, False),
        (99, DeviceFault, False),
    ],
)
@pytest.mark.parametrize("write", [False, True])
async def test_exception_codes(peer, link, code, error, retryable, write):
    async def trick(exchange) -> None:
        exchange.send(exchange.frame(bytes([exchange.pdu[0] | 0x80, code])))

    peer.tricks = [trick]
    with pytest.raises(error, match=f"exception {code}") as caught:
        await (link.write(100, [1]) if write else link.read(100, 1))
    assert caught.value.retryable is retryable
    assert len(peer.requests) == 1
    assert await link.read(400, 1) == (400,)
    assert link.connections == 1  # an exception is a good reply: the link stays


async def test_one_byte_at_a_time(peer, link):
    async def slow(exchange) -> None:
        for byte in exchange.frame(exchange.honest):
            exchange.send(bytes([byte]))
            await asyncio.sleep(0)

    peer.always = slow
    assert await link.read(100, 4) == (100, 101, 102, 103)
    await link.write(10, [1, 2])


async def test_hang_up_during_a_write_is_link_down_at_once(peer, link):
    async def hang_up(exchange) -> None:
        exchange.hang_up()

    peer.tricks = [hang_up]
    loop = asyncio.get_running_loop()
    start = loop.time()
    with pytest.raises(LinkDown, match="closed"):
        await link.write(100, [1])
    assert loop.time() - start < TIMEOUT_S
    if not peer.rtu:
        assert await link.read(400, 1) == (400,)
        assert link.connections == 2
    else:
        with pytest.raises(LinkDown, match="plugged in"):
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
    with pytest.raises(LinkDown, match="plugged in"):
        await ModbusLink.connect(parse_url("modbus+rtu:///dev/no-such-port"))


async def test_a_port_in_use_is_refused(rtu_peer):
    first = await ModbusLink.connect(parse_url(rtu_peer.url))
    with pytest.raises(LinkDown, match="another program"):
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
