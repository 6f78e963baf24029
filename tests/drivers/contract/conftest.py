"""Peers that speak the real wires (sockets, ptys) and can misbehave on purpose. They share no code with the drivers."""

from __future__ import annotations

import asyncio
import binascii
import contextlib
import os
import struct
import tty
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress

import pytest

from tests.drivers.contract.cnc_peer import cnc as cnc  # fixtures
from tests.drivers.contract.cnc_peer import controller as controller
from tests.drivers.contract.link_peer import link as link

Trick = Callable[["Exchange"], Awaitable[None]]


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "speed(x): simulated seconds per second of the simulators in this test")


class Exchange:
    """One request as the peer sees it, with the honest answer ready and the means to do something else."""

    def __init__(self, peer: ModbusPeer, header: bytes, pdu: bytes, send: Callable[[bytes], None], hang_up: Callable[[], None]) -> None:
        self.peer, self.header, self.pdu, self.send, self.hang_up = peer, header, pdu, send, hang_up
        self.honest = peer.answer(pdu)

    def frame(self, pdu: bytes, *, unit: int = 1, tid: int | None = None, pid: int = 0, length: int | None = None) -> bytes:
        if self.peer.rtu:
            body = bytes([unit]) + pdu
            return body + modbus_crc(body)
        number = int.from_bytes(self.header[:2], "big") if tid is None else tid
        return struct.pack(">HHHB", number, pid, len(pdu) + 1 if length is None else length, unit) + pdu

    def reply(self, **changes: int) -> None:
        self.send(self.frame(self.honest, **changes))


class ModbusPeer:
    """A little Modbus server. ``tricks``: one per coming request, then honest again; ``always``: for every request."""

    rtu = False

    def __init__(self) -> None:
        self.words: defaultdict[int, int] = defaultdict(int)
        self.writes: list[tuple[int, tuple[int, ...]]] = []
        self.requests: list[bytes] = []
        self.tricks: list[Trick] = []
        self.always: Trick | None = None
        self.on_write: Callable[[int, tuple[int, ...]], int | None] = lambda address, values: None
        self.on_read: Callable[[int, int], None] = lambda address, count: None
        self.asked = asyncio.Event()
        self.connections = 0
        self.tasks: set[asyncio.Task[None]] = set()

    def answer(self, pdu: bytes) -> bytes:
        self.requests.append(pdu)
        function, address, count = struct.unpack_from(">BHH", pdu)
        if function in (3, 4):
            self.on_read(address, count)
            return struct.pack(f">BB{count}H", function, 2 * count, *(self.words[address + i] for i in range(count)))
        if function == 16:
            values = struct.unpack_from(f">{count}H", pdu, 6)
            refused = self.on_write(address, values)
            if refused:
                return bytes([function | 0x80, refused])
            self.writes.append((address, values))
            for i, value in enumerate(values):
                self.words[address + i] = value
            return pdu[:5]
        return bytes([function | 0x80, 1])

    def put(self, address: int, fmt: str, *values: float) -> None:
        data = struct.pack(">" + fmt, *values)
        for i in range(0, len(data), 2):
            self.words[address + i // 2] = int.from_bytes(data[i : i + 2], "big")

    async def handle(self, header: bytes, pdu: bytes, send: Callable[[bytes], None], hang_up: Callable[[], None]) -> None:
        exchange = Exchange(self, header, pdu, send, hang_up)
        trick = self.tricks.pop(0) if self.tricks else self.always
        self.asked.set()
        if trick is None:
            exchange.reply()
        else:
            await trick(exchange)


class TcpPeer(ModbusPeer):
    """Modbus TCP on 127.0.0.1."""

    async def start(self) -> None:
        self.server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        self.port: int = self.server.sockets[0].getsockname()[1]
        self.url = f"modbus+tcp://127.0.0.1:{self.port}?unit=1"
        self.writers: set[asyncio.StreamWriter] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self.writers.add(writer)
        with suppress(asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            while True:
                header = await reader.readexactly(7)
                pdu = await reader.readexactly(int.from_bytes(header[4:6], "big") - 1)
                await self.handle(header, pdu, writer.write, writer.close)
        writer.close()
        self.writers.discard(writer)

    async def stop(self) -> None:
        self.server.close()
        for writer in list(self.writers):
            writer.close()
        await self.server.wait_closed()


class RtuPeer(ModbusPeer):
    """Modbus RTU on the master side of a pty."""

    rtu = True

    async def start(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.url = f"modbus+rtu://{os.ttyname(self.slave)}?baud=115200&unit=1"
        self.buffer = b""
        self.one_at_a_time = asyncio.Lock()
        asyncio.get_running_loop().add_reader(self.master, self.readable)

    async def in_turn(self, header: bytes, pdu: bytes) -> None:
        """As a real device on a line: the next request is looked at when the last one is answered."""
        async with self.one_at_a_time:
            await self.handle(header, pdu, self.write, self.unplug)

    def readable(self) -> None:
        self.buffer += os.read(self.master, 4096)
        while len(self.buffer) >= 8:
            size = 9 + self.buffer[6] if self.buffer[1] == 16 else 8
            if len(self.buffer) < size:
                return
            frame, self.buffer = self.buffer[:size], self.buffer[size:]
            assert modbus_crc(frame[:-2]) == frame[-2:]
            task = asyncio.get_running_loop().create_task(self.in_turn(frame[:1], frame[1:-2]))
            self.tasks.add(task)
            task.add_done_callback(self.tasks.discard)

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def unplug(self) -> None:
        if self.master >= 0:
            asyncio.get_running_loop().remove_reader(self.master)
            os.close(self.master)
            os.close(self.slave)
            self.master = -1

    async def stop(self) -> None:
        for task in list(self.tasks):
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        self.unplug()


class BarPeer:
    """A ball-bar box on the master side of a pty, written from docs/protocols/ballbar.md."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.url = f"serial://{os.ttyname(self.slave)}?baud=460800"
        self.buffer = b""
        self.unsent = b""
        self.boot_id = 0xCAFE0001
        self.commands: list[tuple[int, int]] = []
        self.asked = asyncio.Event()
        self.mute: set[int] = set()
        self.result = 0
        self.tag_offset = 0
        self.started = asyncio.Event()
        self.stopped = asyncio.Event()
        self.on_start: Callable[[], None] = lambda: None
        asyncio.get_running_loop().add_reader(self.master, self.readable)

    @staticmethod
    def frame(kind: int, payload: bytes) -> bytes:
        body = bytes([kind, len(payload)]) + payload
        return b"\xa5\x5a" + body + struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))

    def sample(self, seq: int, us: int | None = None, reading: int = 0, status: int = 0) -> bytes:
        return self.frame(1, struct.pack("<IQiH", seq, 1_000_000 + seq * 1000 if us is None else us, reading, status))

    def readable(self) -> None:
        try:
            self.buffer += os.read(self.master, 4096)
        except OSError:
            return
        while len(self.buffer) >= 4 and len(self.buffer) >= self.buffer[3] + 6:
            size = self.buffer[3] + 6
            frame, self.buffer = self.buffer[:size], self.buffer[size:]
            assert self.frame(frame[2], frame[4:-2]) == frame
            self.command(frame[2], frame[4:-2])

    def command(self, kind: int, payload: bytes) -> None:
        tag = int.from_bytes(payload[:2], "little")
        self.commands.append((kind, tag))
        self.asked.set()
        if kind in self.mute:
            return
        tag = (tag + self.tag_offset) & 0xFFFF
        if kind == 0x81:
            self.send(self.frame(2, struct.pack("<HIIHHH12s", tag, self.boot_id, 4711, 0x0100, 1000, 0, b"ABB-1")))
            return
        self.send(self.frame(3, struct.pack("<HBB", tag, kind, self.result)))
        if kind == 0x82:
            self.started.set()
            self.on_start()
        else:
            self.stopped.set()

    def send(self, data: bytes) -> None:
        """Everything, in order: a pty takes only as much at once as its buffer has room for, so the rest waits its turn."""
        self.unsent += data
        self.writable()

    def writable(self) -> None:
        loop = asyncio.get_running_loop()
        with contextlib.suppress(BlockingIOError):
            self.unsent = self.unsent[os.write(self.master, self.unsent) :]
        if self.unsent:
            loop.add_writer(self.master, self.writable)
        else:
            loop.remove_writer(self.master)

    def unplug(self) -> None:
        if self.master >= 0:
            asyncio.get_running_loop().remove_reader(self.master)
            asyncio.get_running_loop().remove_writer(self.master)
            os.close(self.master)
            os.close(self.slave)
            self.master = -1


def modbus_crc(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


@pytest.fixture
async def tcp_peer() -> AsyncIterator[TcpPeer]:
    peer = TcpPeer()
    await peer.start()
    yield peer
    await peer.stop()


@pytest.fixture
async def rtu_peer() -> AsyncIterator[RtuPeer]:
    peer = RtuPeer()
    await peer.start()
    yield peer
    await peer.stop()


@pytest.fixture(params=["tcp", "rtu"])
async def peer(request: pytest.FixtureRequest) -> AsyncIterator[ModbusPeer]:
    made = TcpPeer() if request.param == "tcp" else RtuPeer()
    await made.start()
    yield made
    await made.stop()


@pytest.fixture
async def bar_peer() -> AsyncIterator[BarPeer]:
    made = BarPeer()
    yield made
    made.unplug()


@pytest.fixture(autouse=True)
async def no_task_is_left_behind() -> AsyncIterator[None]:
    yield
    await asyncio.sleep(0)
    mine = asyncio.current_task()
    names = [repr(task.get_coro()) for task in asyncio.all_tasks() if task is not mine and not task.done()]
    assert not [name for name in names if "drivers" in name or "ModbusLink" in name or "BallBar" in name]
