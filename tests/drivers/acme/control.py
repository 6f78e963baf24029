"""The control at the other end of `tests.drivers.acme.driver`: what it holds, and the lines of text in which it is asked."""

from __future__ import annotations

import asyncio
import time
import zlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

BANK_BYTES = 9600
MOVE_S = 0.03


class NoError(Exception):
    """It refuses, and why."""


@dataclass
class AcmeControl:
    """Axes that take `MOVE_S` for every move, a path that takes the same for each point, and two banks."""

    factory: bytes
    flags: str = "rhp"
    """Conditions beside those of motion."""
    at_um: tuple[int, int, int] = (0, 0, 0)
    points: list[tuple[int, int, int]] = field(default_factory=list)
    start_us: int = 0
    end_us: int = 0
    gen: int = 1
    active: int = 0
    owner: int = 0
    lease_ends_us: int = 0
    port: int = 0

    def __post_init__(self) -> None:
        self.banks = [bytearray(self.factory.ljust(BANK_BYTES, b"\0")), bytearray(BANK_BYTES)]
        self.states, self.crc = ["locked", "blank"], [zlib.crc32(self.factory), 0]
        self._still_us = self._arrives_us = self.now_us()

    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def answer(self, line: str) -> str:
        """One line of text for another."""
        word, *rest = line.split()
        does: Callable[..., object] = getattr(self, f"_{word}")
        try:
            return f"yes {does(*rest) or ''}".strip()
        except NoError as why:
            return f"no {why}"

    def _who(self) -> str:
        return "mill-7 4711 99"

    def _how(self) -> str:
        now = self.now_us()
        moving = now < self._arrives_us
        runs = self.start_us > self.end_us and moving
        if self.start_us > self.end_us and not moving:
            self.end_us, self.at_um = now, self.points[-1]
        done = len(self.points) if not runs else int(len(self.points) * (now - self.start_us) / (self._arrives_us - self.start_us))
        flags = self.flags + ("m" if moving else "i") + ("w" if runs else "")
        return f"{flags} {now} {' '.join(str(v) for v in self.at_um)} {done} {self.start_us} {self.end_us} {self._arrives_us}"

    def _go(self, x: str, y: str, z: str, feed: str) -> None:
        if "!" in self.flags or "d" in self.flags:
            raise NoError("it is not safe")
        self.at_um, self._arrives_us = (int(x), int(y), int(z)), self.now_us() + round(1e6 * MOVE_S)

    def _path(self, *words: str) -> None:
        v = [int(word) for word in words]
        self.points = list(zip(v[::3], v[1::3], v[2::3], strict=True))

    def _run(self, feed: str) -> None:
        self.start_us = self.now_us()
        self._arrives_us = self.start_us + round(1e6 * MOVE_S * len(self.points))

    def _hold(self) -> None:
        self._arrives_us = self.now_us()

    def _stop(self) -> None:
        self._arrives_us = self.now_us()

    def _tables(self) -> str:
        left_ms = max(0, self.lease_ends_us - self.now_us()) // 1000
        return f"99 {self.gen} {self.active} {self.crc[0]} {self.crc[1]} {' '.join(self.states)} {self.owner} {left_ms}"

    def _take(self, owner: str, lease_ms: str) -> None:
        self._only(int(owner), free=True)
        self.owner, self.lease_ends_us = int(owner), self.now_us() + 1000 * int(lease_ms)

    def _free(self, owner: str) -> None:
        self._only(int(owner), free=True)
        self.owner = 0

    def _only(self, owner: int, *, free: bool = False) -> None:
        if self.owner != owner and not (free and self.owner == 0):
            raise NoError("another has the banks")

    def _get(self, bank: str, first: str, count: str) -> str:
        held = self.banks[int(bank)]
        end = int(first) + int(count) if int(count) >= 0 else 2 * int.from_bytes(held[6:8], "big")
        return held[int(first) : end].hex()

    def _put(self, bank: str, first: str, data: str) -> None:
        if int(bank) == self.active:
            raise NoError("this bank is in force")
        new = bytes.fromhex(data)
        self.banks[int(bank)][int(first) : int(first) + len(new)] = new
        self.states[int(bank)], self.crc[int(bank)] = "open", 0
        self.gen += 1

    def _lock(self, bank: str, owner: str) -> None:
        self._only(int(owner))
        image = bytes.fromhex(self._get(bank, "0", "-1"))
        self.states[int(bank)], self.crc[int(bank)] = "locked", zlib.crc32(image)
        self.gen += 1

    def _use(self, bank: str, crc: str, gen: str, owner: str) -> None:
        self._only(int(owner))
        if (self.crc[int(bank)], self.gen, self.states[int(bank)]) != (int(crc), int(gen), "locked"):
            raise NoError("another table than expected")
        self.active = int(bank)
        self.gen += 1


@asynccontextmanager
async def serving(control: AcmeControl) -> AsyncIterator[AcmeControl]:
    """The control on a free port of this computer."""
    writers: list[asyncio.StreamWriter] = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        with suppress(ConnectionError):
            while line := await reader.readline():
                writer.write(f"{control.answer(line.decode())}\n".encode())
        writer.close()

    server = await asyncio.start_server(talk, "127.0.0.1", limit=1 << 20)
    control.port = server.sockets[0].getsockname()[1]
    try:
        yield control
    finally:
        server.close()
        for writer in writers:
            writer.close()
        await asyncio.sleep(0)
