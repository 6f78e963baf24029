"""A driver as a customer would write it for another control: lines of text over TCP, micrometres, letters for conditions, words for banks.

It imports `abbe.drivers` alone. An entry point ``acme = tests.drivers.acme.driver:DRIVER`` of the group ``abbe.drivers`` is all that makes
it known (`tests/service/devices/test_second_controller.py`).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

from abbe.drivers.api import NOTHING_HOLDS, BankState, CompStatus, Condition, ControllerStatus, DeviceInfo, Point, TableFormat
from abbe.drivers.errors import LinkDown, Refused, ReplyTimeout

LETTERS = {
    "!": Condition.ESTOP, "d": Condition.DOOR_OPEN, "a": Condition.ALARM, "r": Condition.REMOTE, "h": Condition.REFERENCED,
    "p": Condition.DRIVES_ON, "m": Condition.MOVING, "i": Condition.IN_POSITION, "f": Condition.FEED_HOLD, "w": Condition.PATH_RUNNING,
    "c": Condition.COMPENSATION_ON, "n": Condition.NC_PROGRAM, "s": Condition.SPINDLE,
}  # fmt: skip
BANKS = {"blank": BankState.EMPTY, "open": BankState.WRITING, "locked": BankState.SEALED, "next": BankState.LAID_ASIDE}
ANSWER_S, POLL_S = 2.0, 0.005


async def open_acme(url: str) -> AcmeController:
    """Open the control behind ``acme://host:port``."""
    where = urlsplit(url)
    try:
        return AcmeController(url, *await asyncio.open_connection(where.hostname, where.port))
    except OSError as error:
        raise LinkDown(url, "connect", str(error), "is it switched on?") from None


class AcmeController:
    """One connection; one request at a time."""

    def __init__(self, url: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._url, self._reader, self._writer, self._one = url, reader, writer, asyncio.Lock()

    async def _ask(self, *words: object) -> list[str]:
        line = " ".join(str(word) for word in words)
        async with self._one:
            self._writer.write(f"{line}\n".encode())
            try:
                async with asyncio.timeout(ANSWER_S):
                    answer = (await self._reader.readline()).decode().split()
            except TimeoutError:
                raise ReplyTimeout(self._url, line, f"no answer within {ANSWER_S:g} s") from None
        if not answer:
            raise LinkDown(self._url, line, "the connection was closed")
        if answer[0] != "yes":
            raise Refused(self._url, line, " ".join(answer[1:]))
        return answer[1:]

    # ---- Identity

    async def identify(self) -> DeviceInfo:
        model, serial_no, start = await self._ask("who")
        return DeviceInfo("cnc", model, serial_no, int(start), "acme 7")

    async def status(self) -> ControllerStatus:
        answer = await self._ask("how")
        now, x_um, y_um, z_um, done, start, end, since = (int(word) for word in answer[1:])
        holds = NOTHING_HOLDS
        for letter in answer[0]:
            holds |= LETTERS[letter]
        position = (x_um / 1000, y_um / 1000, z_um / 1000)
        return ControllerStatus(time.monotonic(), now, holds, position, done, start, end, 100, since)

    async def comp_status(self) -> CompStatus:
        (start, gen, active, crc0, crc1, left), (one, two), owner = await self._tables()
        return CompStatus(start, gen, active, (crc0, crc1), (BANKS[one], BANKS[two]), owner, left)

    async def _tables(self) -> tuple[list[int], tuple[str, str], int]:
        start, gen, active, crc0, crc1, one, two, owner, left = await self._ask("tables")
        return [int(v) for v in (start, gen, active, crc0, crc1, left)], (one, two), int(owner)

    async def table_format(self) -> TableFormat:
        return TableFormat(100, 4800)

    async def close(self) -> None:
        self._writer.close()

    # ---- Motion and Paths

    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus:
        await self._ask("go", *(round(1000 * v) for v in target_mm), feed_mm_min)
        async with asyncio.timeout(timeout_s):
            while (status := await self.status()).moving:  # noqa: ASYNC110 - the control is asked
                await asyncio.sleep(POLL_S)
        return status

    async def hold(self) -> None:
        await self._ask("hold")

    async def abort(self) -> None:
        await self._ask("stop")

    async def load_path(self, points_mm: Sequence[Point]) -> None:
        await self._ask("path", *(round(1000 * v) for point in points_mm for v in point))

    async def start_path(self, *, feed_mm_min: float) -> None:
        await self._ask("run", feed_mm_min)

    # ---- Tables

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None:
        await self._ask("take", owner, lease_ms)

    async def release(self, owner: int, *, anyway: bool = False) -> None:
        await self._ask("free", owner)

    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes:
        return bytes.fromhex("".join(await self._ask("get", bank, 2 * first, -1 if n_bytes is None else n_bytes)))

    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None:
        await self._ask("put", bank, 2 * first, data.hex())

    async def seal(self, bank: int, owner: int) -> None:
        await self._ask("lock", bank, owner)

    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None:
        await self._ask("use", bank, expect_crc, expect_gen, owner)


DRIVER = {"cnc": open_acme}
