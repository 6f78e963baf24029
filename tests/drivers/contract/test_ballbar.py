"""The ball-bar driver against a box on a real pty that can misbehave."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Iterator

import pytest

from abbe.drivers.ballbar import driver as module
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.errors import BadFrame, LinkDown, LossyLine, Rebooted, Refused, ReplyTimeout
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import SocketUrl, parse_url
from abbe.drivers.registry import open_ballbar
from tests.faults.patient import patience
from tests.patience import within

STOP, START, IDENTIFY = 0x83, 0x82, 0x81


@pytest.fixture(scope="module", autouse=True)
def patient() -> Iterator[None]:
    """Box and driver live in one process: while it gets no core, no time passes for either."""
    with patience():
        yield


@pytest.fixture
async def bar(bar_peer) -> AsyncIterator[SerialBallBar]:
    opened = SerialBallBar(ByteLink(parse_url(bar_peer.url)))
    yield opened
    await opened.close()


@pytest.fixture
def impatient(monkeypatch) -> None:
    monkeypatch.setattr(module, "_ANSWER_S", 0.1)


async def collect(batches, n):
    """Read until n samples came; return (seqs, missing)."""
    seqs, missing = [], 0
    async for batch in batches:
        missing += batch.missing
        seqs += [sample.seq for sample in batch.samples]
        if len(seqs) >= n:
            return seqs, missing
    raise AssertionError


async def test_identify(bar):
    info = await bar.identify()
    assert (info.kind, info.model, info.serial_no, info.boot_id, info.firmware) == ("ballbar", "ABB-1", "4711", 0xCAFE0001, "1.0")


async def test_registry_opens_and_identifies(bar_peer):
    bar = await open_ballbar(bar_peer.url)
    assert bar_peer.commands == [(IDENTIFY, 1)]
    await bar.close()


async def test_stream_and_stop(bar_peer, bar):
    bar_peer.on_start = lambda: bar_peer.send(b"".join(bar_peer.sample(i, reading=-i, status=8) for i in range(100)))
    async with bar.stream(1000) as batches:
        first = await anext(batches)
        assert first.samples[0].reading_nm == 0
        assert first.samples[0].status == 8
        assert first.host_s > 0
        seqs, missing = await collect(batches, 100 - len(first.samples)) if len(first.samples) < 100 else ([], 0)
    assert len(first.samples) + len(seqs) == 100
    assert missing == 0
    assert [kind for kind, _ in bar_peer.commands] == [IDENTIFY, STOP, START, STOP]


async def test_gap_duplicates_and_garbage(bar_peer, bar):
    def misbehave() -> None:
        bar_peer.send(bar_peer.sample(0) + b"\xa5\x5a\x01\x12noise" + bar_peer.sample(1) * 2 + bar_peer.sample(5) + bar_peer.sample(6))

    bar_peer.on_start = misbehave
    with pytest.raises(LossyLine, match="3 of 7"):
        async with bar.stream(1000) as batches:
            assert await collect(batches, 4) == ([0, 1, 5, 6], 3)
    assert bar.counters.duplicates == 1
    assert bar.counters.bad_bytes == 9


@pytest.mark.parametrize("rate", [0, -1, 3, 2000])
async def test_impossible_rates_never_reach_the_box(bar_peer, bar, rate):
    with pytest.raises(Refused, match="divide"):
        async with bar.stream(rate):
            pass
    assert bar_peer.commands == []


async def test_the_box_refuses(bar_peer, bar):
    bar_peer.result = 1
    with pytest.raises(Refused, match="bad argument"):
        async with bar.stream(1000):
            pass


async def test_no_answer(bar_peer, bar, impatient):
    bar_peer.mute = {IDENTIFY}
    with pytest.raises(ReplyTimeout, match="no answer") as caught:
        await bar.identify()
    assert caught.value.remedy


async def test_an_answer_with_another_tag_is_no_answer(bar_peer, bar, impatient):
    bar_peer.tag_offset = 1
    with pytest.raises(ReplyTimeout):
        await bar.identify()
    bar_peer.tag_offset = 0
    await bar.identify()


async def test_an_ack_of_another_command_is_refused(bar_peer, bar, impatient):
    bar_peer.mute = {STOP}
    await bar.identify()
    bar_peer.send(bar_peer.frame(3, b"\x05\x00\x82\x00"))
    with pytest.raises((BadFrame, ReplyTimeout)):
        async with bar.stream(1000):
            pass


async def test_silence_is_told_from_a_reboot(bar_peer, bar, monkeypatch):
    bar_peer.on_start = lambda: bar_peer.send(bar_peer.sample(0))
    async with bar.stream(1000) as batches:
        await anext(batches)
        loop = asyncio.get_running_loop()
        start = loop.time()
        with pytest.raises(ReplyTimeout, match="no sample for 1 s"):
            await anext(batches)
        assert 0.9 < loop.time() - start < 3
    async with bar.stream(1000) as batches:
        await anext(batches)
        bar_peer.boot_id += 1
        with pytest.raises(Rebooted):
            await anext(batches)
    with pytest.raises(Rebooted):
        async with bar.stream(1000):
            pass
    await bar.identify()
    async with bar.stream(1000) as batches:
        await anext(batches)


async def test_samples_of_a_new_boot_are_never_joined(bar_peer, bar):
    bar_peer.on_start = lambda: bar_peer.send(b"".join(bar_peer.sample(i) for i in range(500)))
    async with bar.stream(1000) as batches:
        assert await collect(batches, 500) == (list(range(500)), 0)
        bar_peer.send(bar_peer.sample(0, us=17))
        with pytest.raises(Rebooted, match="went back"):
            await anext(batches)


async def test_foreign_info_with_new_boot_id_ends_the_stream(bar_peer, bar):
    async with bar.stream(1000) as batches:
        bar_peer.boot_id += 1
        bar_peer.command(IDENTIFY, b"\x00\x00")
        with pytest.raises(Rebooted, match="boot id"):
            await anext(batches)


async def test_unplug_while_streaming(bar_peer, bar):
    bar_peer.on_start = lambda: bar_peer.send(bar_peer.sample(0))
    async with bar.stream(1000) as batches:
        await anext(batches)
        bar_peer.unplug()
        with pytest.raises(LinkDown, match="unplugged"):
            await anext(batches)
    with pytest.raises(LinkDown):
        await bar.identify()


async def test_unplug_while_waiting_for_an_answer(bar_peer, bar):
    bar_peer.mute = {IDENTIFY}
    task = asyncio.create_task(bar.identify())
    await bar_peer.asked.wait()
    bar_peer.unplug()
    with pytest.raises(LinkDown):
        await task


async def test_a_slow_consumer_hears_what_it_missed(bar_peer, bar, monkeypatch):
    monkeypatch.setattr(module, "_BUFFER_S", 0.1)  # room for 100 samples

    def send_many() -> None:
        loop = asyncio.get_running_loop()
        bar_peer.send(b"".join(bar_peer.sample(i) for i in range(90)))
        for k in range(9):
            loop.call_later(0.02 * (k + 1), bar_peer.send, b"".join(bar_peer.sample(90 * (k + 1) + i) for i in range(90)))

    bar_peer.on_start = send_many
    async with bar.stream(1000) as batches:
        async with asyncio.timeout(within(5)):
            while bar.counters.overflow < 800:  # noqa: ASYNC110 - nothing to wait for: this consumer is the slow one
                await asyncio.sleep(0.01)
        first = await anext(batches)  # makes room: cut into pieces, the samples may have filled the buffer to its brim
        bar_peer.send(bar_peer.sample(900))
        delivered, missing, last = len(first.samples), first.missing, first.samples[-1].seq
        while last < 900:
            batch = await anext(batches)
            delivered, missing, last = delivered + len(batch.samples), missing + batch.missing, batch.samples[-1].seq
    assert missing >= bar.counters.overflow >= 800
    assert delivered + missing == 901


async def test_cancelling_the_consumer_stops_the_box(bar_peer, bar):
    async def consume() -> None:
        async with bar.stream(1000) as batches:
            async for _ in batches:
                pass

    task = asyncio.create_task(consume())
    await bar_peer.started.wait()
    bar_peer.stopped.clear()
    task.cancel()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert bar_peer.stopped.is_set()


async def test_cancel_at_every_loop_step_leaves_the_box_stopped(bar_peer, bar):
    async def consume() -> None:
        async with bar.stream(1000) as batches:
            async for _ in batches:
                pass

    await bar.identify()
    started = 0
    for turns in range(400):
        if started >= 10:
            break
        bar_peer.commands.clear()
        task = asyncio.create_task(consume())
        for _ in range(turns):
            await asyncio.sleep(0 if turns < 20 else 0.0002)  # answers come from a thread
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await bar.identify()  # a full turn: everything sent before has arrived
        kinds = [kind for kind, _ in bar_peer.commands]
        if START in kinds:
            started += 1
            assert STOP in kinds[kinds.index(START) :]
    assert started == 10


async def test_only_one_stream_at_a_time(bar):
    async with bar.stream(1000):
        with pytest.raises(Refused, match="already running"):
            async with bar.stream(500):
                pass


async def test_the_port_is_exclusive(bar_peer, bar):
    await bar.identify()
    with pytest.raises(LinkDown, match="holds the port"):
        await open_ballbar(bar_peer.url)


async def test_missing_port():
    with pytest.raises(LinkDown, match="plug the adapter in"):
        await open_ballbar("serial:///dev/no-such-port")


async def test_the_same_bytes_over_a_socket(bar_peer):
    """A serial device server: here simply a socket joined to the box's pty."""
    loop = asyncio.get_running_loop()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop.add_reader(bar_peer.slave, lambda: writer.write(os.read(bar_peer.slave, 4096)))
        while data := await reader.read(4096):
            os.write(bar_peer.slave, data)
        loop.remove_reader(bar_peer.slave)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    bar_peer.on_start = lambda: bar_peer.send(b"".join(bar_peer.sample(i) for i in range(50)))
    bar = await open_ballbar(f"socket://localhost:{server.sockets[0].getsockname()[1]}")
    async with bar.stream(1000) as batches:
        assert await collect(batches, 50) == (list(range(50)), 0)
    await bar.close()
    server.close()
    await server.wait_closed()


async def test_socket_refused():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(LinkDown, match="check address and port"):
        await open_ballbar(f"socket://127.0.0.1:{port}")


async def test_link_write_times_out_when_nobody_takes_the_bytes():
    received = asyncio.Event()

    async def deaf(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await received.wait()
        writer.close()

    server = await asyncio.start_server(deaf, "127.0.0.1", 0, limit=1024)
    link = ByteLink(SocketUrl("127.0.0.1", server.sockets[0].getsockname()[1]))
    await link.open()
    with pytest.raises(ReplyTimeout, match="accepted no bytes"):
        await link.write(bytes(50_000_000), timeout_s=0.1)
    await link.close()
    with pytest.raises(LinkDown, match="not open"):
        await link.write(b"x")
    received.set()
    server.close()
    await server.wait_closed()


async def test_link_reads_what_is_there_and_drops_what_is_old(bar_peer):
    link = ByteLink(parse_url(bar_peer.url))
    await link.open()
    bar_peer.send(b"old")
    host_s, data = await link.read(2, timeout_s=1.0)
    assert data == b"ol"
    assert host_s > 0
    link.drop_input()
    with pytest.raises(ReplyTimeout, match="no byte"):
        await link.read(10, timeout_s=0.05)
    waiting = asyncio.create_task(link.read(10, timeout_s=5.0))
    await asyncio.sleep(0)
    await link.close()
    with pytest.raises(LinkDown, match="closed"):
        await waiting
