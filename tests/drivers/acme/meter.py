"""A driver as a customer would write it for a meter of its own: packets of three numbers and a check sum, on request over TCP.

It imports `abbe.drivers` alone; an entry point ``acme-meter = tests.drivers.acme.meter:DRIVER`` of the group ``abbe.drivers`` makes it
known.
"""

from __future__ import annotations

import asyncio
import struct
import time
from urllib.parse import urlsplit
from zlib import crc32

from abbe.drivers.api import DeviceInfo, LaserFlag, LaserReading
from abbe.drivers.errors import BadFrame, DeviceFault, LinkDown, ReplyTimeout

PACKET = struct.Struct("<Iid")
"""Number of the reading, state (0: good), micrometres."""
ANSWER_S, NEW_S = 1.0, 2.0


async def open_acme(url: str) -> AcmeMeter:
    """Open the meter behind ``acme-meter://host:port``."""
    meter = AcmeMeter(url)
    await meter.identify()
    return meter


class AcmeMeter:
    """One connection, made anew when it was lost; one request at a time."""

    def __init__(self, url: str) -> None:
        self.name, self._streams, self._one = url, None, asyncio.Lock()
        self._zero_um: float | None = None
        self._count = 0

    async def _ask(self, request: bytes, size: int) -> bytes:
        async with self._one:
            try:
                async with asyncio.timeout(ANSWER_S):
                    if self._streams is None:
                        self._zero_um = None  # it may have been switched off
                        where = urlsplit(self.name)
                        self._streams = await asyncio.open_connection(where.hostname, where.port)
                    self._streams[1].write(request)
                    answer = await self._streams[0].read(4 * size)  # twice the answer is no answer
            except TimeoutError:
                await self._drop()  # a late answer must not meet the next question
                raise ReplyTimeout(self.name, "read", f"no answer within {ANSWER_S:g} s") from None
            except OSError as error:
                await self._drop()
                raise LinkDown(self.name, "read", str(error), "is it switched on?") from None
            if len(answer) != size or answer[:1] != request or crc32(answer[:-4]) != int.from_bytes(answer[-4:], "little"):
                await self._drop()
                raise BadFrame(self.name, "read", f"not one good answer to {request!r}: {answer.hex(' ')}")
            return answer[1:-4]

    async def _drop(self) -> None:
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].close()

    async def identify(self) -> DeviceInfo:
        return DeviceInfo("laser", "acme meter", (await self._ask(b"i", 13)).decode("ascii").strip(), 0, "")

    async def zero(self) -> None:
        _, status, um = await self._packet()
        if status:
            raise DeviceFault(self.name, "zero", "no target")
        self._zero_um = um

    async def clear_beam(self) -> None:
        return

    async def set_environment_compensation(self, on: bool) -> None:
        return

    async def _packet(self) -> tuple[int, int, float]:
        return PACKET.unpack(await self._ask(b"r", 5 + PACKET.size))

    async def peek(self) -> LaserReading:
        number, status, um = await self._packet()
        now_s, flags = time.monotonic(), LaserFlag.COMPENSATED
        flags |= LaserFlag.BEAM_LOST if status else LaserFlag(0)
        flags |= LaserFlag.ZEROED if self._zero_um is not None else LaserFlag(0)
        tenth_nm = round((um - (self._zero_um or 0.0)) * 1e4)
        unknown = float("nan")
        return LaserReading(now_s, number, round(now_s * 1e6), tenth_nm, 1000, int(flags), unknown, unknown, unknown, unknown)

    async def read(self, *, after_count: int | None = None) -> LaserReading:
        until_s = time.monotonic() + NEW_S
        while (reading := await self.peek()).sample_count == after_count:
            if time.monotonic() > until_s:
                raise ReplyTimeout(self.name, "read", f"reading {after_count} is repeated for {NEW_S:g} s")
            await asyncio.sleep(0.01)
        if reading.status & LaserFlag.BEAM_LOST or self._zero_um is None:
            raise DeviceFault(self.name, "read", "no target, or not zeroed since", "zero the meter, then repeat this test")
        return reading

    async def close(self) -> None:
        await self._drop()


DRIVER = {"laser": open_acme}
