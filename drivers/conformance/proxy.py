"""A proxy in front of a device, for its test: it delays, doubles, spoils or drops one reply, or cuts the connection."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from enum import StrEnum
from typing import Any, TypeVar

from abbe.drivers.errors import DriverError, ReplyTimeout
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, SerialUrl, SocketUrl

_BYTES = 65536
_IDLE_S = 0.2


class Fault(StrEnum):
    """Fault applied to the next reply."""

    LATE = "late"
    DOUBLED = "doubled"
    SPOILT = "spoilt"
    MISSING = "missing"
    CUT = "connection cut"


U = TypeVar("U", bound=ModbusTcpUrl | ModbusRtuUrl | SerialUrl | SocketUrl)


class Proxy:
    """Passes bytes between a driver and a device. ``late_s``: delay of a late reply.

    In front of a device on TCP the proxy opens a TCP port of this computer, in front of a serial device a pseudo-terminal.
    """

    def __init__(self, late_s: float) -> None:
        self._late_s = late_s
        self.fault: Fault | None = None
        """Fault of the next reply; None once it was applied."""
        self.done = 0
        """Number of faults that were applied."""
        self.cuts = False
        """Whether there is a connection that can be cut."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._master = self._slave = -1

    async def front(self, url: U) -> U:
        """Start, and return the URL of the proxy in front of this device. Raises LinkDown if a serial device cannot be opened."""
        if isinstance(url, ModbusTcpUrl | SocketUrl):
            self.cuts = True
            self._server = await asyncio.start_server(lambda r, w: self._start(self._connection(url, r, w)), "127.0.0.1", 0)
            return replace(url, host="127.0.0.1", port=self._server.sockets[0].getsockname()[1])
        link = ByteLink(SerialUrl(url.path, url.baud, url.parity))
        await link.open()
        self._master, self._slave = os.openpty()  # without an open slave the master reads as lost
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._start(self._serial_up(link))
        self._start(self._down(link, self._write_master, lambda: None))
        return replace(url, path=os.ttyname(self._slave), parity="none")  # a pseudo-terminal has no parity

    async def close(self) -> None:
        """End the proxy and its connections."""
        if self._server is not None:
            self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _connection(self, url: ModbusTcpUrl | SocketUrl, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        link = ByteLink(SocketUrl(url.host, url.port))
        try:
            await link.open()
            self._start(self._down(link, writer.write, writer.transport.abort))
            while data := await reader.read(_BYTES):
                await link.write(data)
        except (DriverError, OSError):
            pass  # either end is gone: so is the other
        finally:
            writer.transport.abort()
            await link.close()

    async def _serial_up(self, link: ByteLink) -> None:
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(self._master, ready.set)
        try:
            while True:
                await ready.wait()
                ready.clear()
                with suppress(BlockingIOError):
                    await link.write(os.read(self._master, _BYTES))
        except (DriverError, OSError):
            return
        finally:
            loop.remove_reader(self._master)
            await link.close()

    def _write_master(self, data: bytes) -> None:
        with suppress(OSError):
            os.write(self._master, data)

    async def _down(self, link: ByteLink, write: Callable[[bytes], object], abort: Callable[[], object]) -> None:
        """Pass replies to the driver, with the fault of the moment."""
        while True:
            try:
                _, data = await link.read(_BYTES, timeout_s=_IDLE_S)
            except ReplyTimeout:
                continue
            except DriverError:
                abort()
                return
            fault, self.fault = self.fault, None
            self.done += fault is not None
            if fault is Fault.LATE:
                await asyncio.sleep(self._late_s)
            if fault is Fault.CUT:
                abort()
            elif fault is Fault.SPOILT:
                write(spoilt(data))
            elif fault is not Fault.MISSING:
                write(data * 2 if fault is Fault.DOUBLED else data)


def spoilt(data: bytes) -> bytes:
    """Flip one bit of the second byte: a transaction or function code of Modbus, a digit of a line."""
    at = min(1, len(data) - 1)
    return data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]
