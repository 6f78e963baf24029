"""The Modbus link against a peer that misbehaves, over real sockets and ptys."""

from __future__ import annotations

import asyncio

import pytest

from abbe.drivers.errors import BadFrame, DeviceFault, LinkDown, Refused, ReplyTimeout
from abbe.drivers.links import modbus_link
from abbe.drivers.links.modbus_link import ModbusLink, ModbusOperation
from abbe.drivers.links.urls import parse_url
from tests.drivers.contract.link_peer import TIMEOUT_S, silent, times
from tests.drivers.contract.link_peer import patient as patient  # fixture


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
        (10, LinkDown, True),
        (11, LinkDown, True),
        (99, DeviceFault, False),
    ],
)
@pytest.mark.parametrize("write", [False, True])
async def test_exception_codes(peer, link, code, error, retryable, write, monkeypatch):
    monkeypatch.setattr(modbus_link, "BUSY_S", 0.2)

    async def trick(exchange) -> None:
        exchange.send(exchange.frame(bytes([exchange.pdu[0] | 0x80, code])))

    peer.always = trick
    with pytest.raises(error, match=f"exception {code}") as caught:
        await (link.write(100, [1]) if write else link.read(100, 1))
    assert caught.value.retryable is retryable
    if write or code not in (5, 6):
        assert len(peer.requests) == 1
    else:
        assert 2 <= len(peer.requests) <= 25  # a read waits while the device is busy, but not for ever
    peer.always = None
    assert await link.read(400, 1) == (400,)
    assert link.connections == 1  # an exception is a good reply: the link stays


@pytest.mark.parametrize(
    ("op", "code", "requests"),
    [(ModbusOperation.LEVEL, 5, 2), (ModbusOperation.LEVEL, 6, 2), (ModbusOperation.NUMBERED, 6, 2), (ModbusOperation.NUMBERED, 5, 1)],
)
async def test_a_busy_device_is_asked_again_only_where_that_does_no_harm(peer, link, op, code, requests):
    async def trick(exchange) -> None:
        exchange.send(exchange.frame(bytes([0x90, code])))

    peer.tricks = [trick]
    if requests == 2:
        await link.write(100, [1], op)
    else:
        with pytest.raises(ReplyTimeout, match="exception 5"):  # never taken for done: the acknowledge register will say
            await link.write(100, [1], op)
    assert len(peer.requests) == requests


@pytest.mark.parametrize(("op", "requests"), [(ModbusOperation.LEVEL, 2), (ModbusOperation.NUMBERED, 1), (ModbusOperation.TRIGGER, 1)])
async def test_only_a_level_is_written_again_after_silence(peer, link, op, requests):
    peer.tricks = [silent]
    if op is ModbusOperation.LEVEL:
        await link.write(100, [1], op)
    else:
        with pytest.raises(ReplyTimeout):
            await link.write(100, [1], op)
    assert len(peer.requests) == requests


@pytest.mark.parametrize("answer", ["silent", "busy"])
async def test_nothing_is_sent_again_for_a_caller_who_has_gone(peer, link, answer):
    gone = asyncio.Event()

    async def trick(exchange) -> None:
        await gone.wait()
        if answer == "busy":
            exchange.send(exchange.frame(b"\x90\x06"))

    peer.always = trick
    task = asyncio.create_task(link.write(100, [0], ModbusOperation.LEVEL))
    await peer.asked.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    gone.set()
    peer.always = None
    assert await link.read(300, 1) == (300,)
    assert [request[0] for request in peer.requests] == [16, 3]


async def test_one_byte_at_a_time(peer, link):
    async def slow(exchange) -> None:
        for byte in exchange.frame(exchange.honest):
            exchange.send(bytes([byte]))
            await asyncio.sleep(0)

    peer.always = slow
    assert await link.read(100, 4) == (100, 101, 102, 103)
    await link.write(10, [1, 2])
