"""A control with one table in place of two banks, and its driver: `abbe.drivers.api.OneBank` over the same lines of text."""

from __future__ import annotations

import asyncio
import zlib
from dataclasses import dataclass
from urllib.parse import urlsplit

from abbe.drivers.api import TableState
from tests.drivers.acme.control import AcmeControl, NoError
from tests.drivers.acme.driver import AcmeController


@dataclass
class OneTableControl(AcmeControl):
    """Its table is bank 0 of the other. ``guards``, ``compares``: what a worse control does not do."""

    acts: bool = True
    number: int = 0
    guards: bool = True
    compares: bool = True
    hangs_up_at: str = ""
    from_number: int = 0
    """Word of the request behind which the connection ends, once that many switches were executed."""

    def answer(self, line: str) -> str:
        said = super().answer(line)
        if self.hangs_up_at and line.startswith(self.hangs_up_at) and self.number >= self.from_number:
            self.hangs_up_at = ""
            raise ConnectionError
        return said

    def _state(self) -> str:
        return f"99 {int(self.acts)} {self.number}"

    def _read(self) -> str:
        return bytes(self.banks[0]).hex()

    def _write(self, first: str, data: str) -> None:
        if self.acts and self.guards:
            raise NoError("the table acts")
        new = bytes.fromhex(data)
        self.banks[0][2 * int(first) : 2 * int(first) + len(new)] = new

    def _switch(self, number: str, on: str, crc: str) -> None:
        held = self.banks[0]
        image = held[: 2 * int.from_bytes(held[6:8], "big")]
        if int(number) != self.number + 1:
            raise NoError("an old request")
        self.number += 1
        if self.compares and (zlib.crc32(image) != int(crc) or bool(int(on)) == self.acts):
            raise NoError("another table, or switched so already")
        self.acts = bool(int(on))


class OneTableAcme(AcmeController):
    """The four calls of a control with one table."""

    async def table_state(self) -> TableState:
        start, acts, _ = (int(v) for v in await self._ask("state"))
        return TableState(start, bool(acts))

    async def read_table(self) -> bytes:
        return bytes.fromhex("".join(await self._ask("read")))

    async def write_table(self, data: bytes, *, first: int) -> None:
        await self._ask("write", first, data.hex())

    async def switch(self, *, on: bool, expect_crc: int) -> None:
        number = int((await self._ask("state"))[2])
        await self._ask("switch", number + 1, int(on), expect_crc)


async def open_one_table(url: str) -> OneTableAcme:
    """Open the control behind ``acme://host:port``."""
    where = urlsplit(url)
    return OneTableAcme(url, *await asyncio.open_connection(where.hostname, where.port, limit=1 << 20))


DRIVER = {"cnc": open_one_table}
