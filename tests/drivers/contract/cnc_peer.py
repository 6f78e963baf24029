"""A controller on a real socket that can misbehave, and what the tests of its driver share."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator

import pytest

from abbe.drivers.api import ControllerStatus
from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.cnc.registers import Bit
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.urls import parse_url

READY = Bit.REMOTE | Bit.REFERENCED | Bit.DRIVES_ON | Bit.IN_POSITION
TARGET = (100.0, -50.0, 25.5)


class Cnc:
    """A controller behind a Modbus peer, written from docs/protocols/cnc.md; axes jump to the target when ``finish`` is called."""

    def __init__(self, peer) -> None:
        self.peer = peer
        self.bits = int(READY)
        self.result = 0
        self.comp_result = 0
        self.auto_finish = True
        self.log: list[tuple[str, int]] = []
        self.fifo: list[tuple[int, int, int]] = []
        self.lose_points = 0
        self.moving = asyncio.Event()
        self.held = asyncio.Event()
        self.boot(100)
        peer.on_write = self.written
        peer.on_read = self.read

    def boot(self, boot_id: int) -> None:
        self.peer.put(0, "ifHII", 0x01020304, 1234.5, 1, boot_id, 1)
        self.peer.put(9, "HHHH", 3, 100, 4800, 8192)
        self.peer.put(22, "HHHH", 0, 0, 0, 0)
        self.peer.put(48, "HH", 0, 0)
        self.peer.put(208, "HIIHHHHII", 0, 0xAAAA5555, 0, 2, 0, 0, 0, 0, 0)
        self.time_us = 0

    def read(self, address: int, count: int) -> None:
        self.time_us += 1000
        self.peer.put(16, "QI", self.time_us, self.bits)
        self.peer.put(32, "H", 8192 - len(self.fifo))

    def written(self, address: int, values: tuple[int, ...]) -> int | None:
        if address == 64:
            return self.motion(values)
        if address == 80:
            return self.hold(values[0])
        if address == 96:
            return self.chunk(values)
        if address == 230:
            return self.comp(values)
        if 6000 <= address < 10800 or 1000 <= address < 5800:
            bank = int(address >= 6000)
            return 2 if self.peer.words[208] == bank else None
        return 2

    def motion(self, values: tuple[int, ...]) -> None:
        number, command = values[:2]
        if number != (self.peer.words[23] + 1) & 0xFFFF:
            return
        self.log.append(("motion", command))
        self.peer.put(23, "HH", number, self.result)
        if self.result:
            return
        if command == 2:
            self.fifo.clear()
        if command == 1:
            self.target = values[2:8]
            self.bits |= Bit.MOVING
            self.moving.set()
            if self.auto_finish:
                self.finish()

    def finish(self, there: bool = True) -> None:
        if there:
            for i, word in enumerate(self.target):
                self.peer.words[26 + i] = word
        self.bits &= ~Bit.MOVING
        self.peer.words[25] = self.peer.words[23]

    def hold(self, level: int) -> None:
        self.log.append(("hold", level))
        self.bits = self.bits | Bit.FEED_HOLD if level else self.bits & ~Bit.FEED_HOLD
        if level == 2 and self.bits & Bit.MOVING:
            self.finish(there=False)
        if level:
            self.held.set()

    def chunk(self, values: tuple[int, ...]) -> None:
        number, count = values[:2]
        if number != (self.peer.words[48] + 1) & 0xFFFF:
            return
        points = struct.unpack(f">{3 * count}i", struct.pack(f">{6 * count}H", *values[2:]))
        self.peer.put(48, "HH", number, self.result)
        if not self.result:
            self.fifo += [points[i : i + 3] for i in range(0, 3 * count, 3)][self.lose_points :]

    def comp(self, values: tuple[int, ...]) -> None:
        number, command, bank = values[:3]
        if number != (self.peer.words[215] + 1) & 0xFFFF:
            return
        self.log.append(("comp", command))
        self.peer.put(215, "HH", number, self.comp_result)
        if command == 1 and not self.comp_result:
            self.peer.put(213 + values[2], "H", 2)
        if command in (3, 4) and not self.comp_result:
            self.peer.put(217, "HH", *(values[7:9] if command == 3 else (0, 0)))
        if command == 2 and not self.comp_result:
            self.peer.words[208] = bank

    def image(self, bank: int, n_words: int) -> bytes:
        base = (1000, 6000)[bank]
        return struct.pack(f">{n_words}H", *(self.peer.words[base + i] for i in range(n_words)))


@pytest.fixture
def cnc(tcp_peer) -> Cnc:
    return Cnc(tcp_peer)


@pytest.fixture
async def controller(tcp_peer, cnc) -> AsyncIterator[ModbusController]:
    opened = ModbusController(await ModbusLink.connect(parse_url(tcp_peer.url), timeout_s=0.15))
    await opened.identify()
    yield opened
    await opened.close()


def move(controller: ModbusController, timeout_s: float = 5.0) -> asyncio.Task[ControllerStatus]:
    return asyncio.create_task(controller.move(TARGET, feed_mm_min=3000.0, timeout_s=timeout_s))


async def silent(exchange) -> None:
    return


async def honest(exchange) -> None:
    exchange.reply()


async def hang_up(exchange) -> None:
    exchange.hang_up()
