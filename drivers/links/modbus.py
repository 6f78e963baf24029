"""Modbus TCP and RTU behind four calls: connect, read, write, close. The only file that knows pymodbus.

What the library (3.16.1) does not do by itself and this file adds: one request at a time, no hidden repetition of writes, no hidden
reconnects, every reply compared with its request, and no way for a late reply to answer the next question.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass

from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Refused, ReplyTimeout
from drivers.links.modbus_reply import EXCEPTION_TEXT, rtu_mismatch, tcp_mismatch
from drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl

# Everything that goes wrong leaves here as a typed error: the library's own lines would only repeat it on stderr.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

MAX_READ = 125
MAX_WRITE = 123
_BABBLE_LIMIT = 5


@dataclass(frozen=True, slots=True)
class _Request:
    address: int
    count: int
    values: tuple[int, ...] | None  # None: a read

    def __str__(self) -> str:
        return f"{'read' if self.values is None else 'write'} registers {self.address}..{self.address + self.count - 1}"


class ModbusLink:
    """One Modbus unit.

    Parameters
    ----------
    url : ModbusTcpUrl or ModbusRtuUrl
        Where the unit is.
    timeout_s : float
        Longest wait for one reply, and for one connection.
    """

    def __init__(self, url: ModbusTcpUrl | ModbusRtuUrl, *, timeout_s: float = 1.0) -> None:
        self._url = url
        self.name = str(url)
        self._timeout_s = timeout_s
        self._rtu = isinstance(url, ModbusRtuUrl)
        self._client: AsyncModbusTcpClient | AsyncModbusSerialClient | None = None
        self._lock = asyncio.Lock()
        self._task: asyncio.Task[tuple[int, ...]] | None = None
        self._deadline: asyncio.Timeout | None = None
        self._on_wire = False
        self._lost = False
        self._closed = False
        self._dirty = False
        self._sent = b""
        self._heard = b""
        self._heard_at = 0.0
        self._complaint = ""
        self.connections = 0
        """How often the link was (re)connected: a change means that the device may have been restarted in between."""

    @classmethod
    async def connect(cls, url: ModbusTcpUrl | ModbusRtuUrl, *, timeout_s: float = 1.0) -> ModbusLink:
        """Open a link.

        Raises
        ------
        LinkDown
            Nobody answers there, or the port cannot be opened.
        """
        link = cls(url, timeout_s=timeout_s)
        await link._connected()
        return link

    async def read(self, address: int, count: int) -> tuple[int, ...]:
        """Read ``count`` (1..125) registers with one request (FC3), repeated once over a new connection if the first one failed.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= count <= MAX_READ:
            raise ValueError(f"a Modbus read takes 1..{MAX_READ} registers, not {count}")
        return await self._transact(_Request(address, count, None))

    async def write(self, address: int, values: Sequence[int]) -> None:
        """Write 1..123 registers with exactly one request (FC16). Never repeated: after an error the caller must look what happened.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request: the write may or may not have happened.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= len(values) <= MAX_WRITE:
            raise ValueError(f"a Modbus write takes 1..{MAX_WRITE} registers, not {len(values)}")
        await self._transact(_Request(address, len(values), tuple(values)))

    async def close(self) -> None:
        """Close the link; a pending request ends with ``LinkDown``. Closing twice does nothing."""
        self._closed = True
        self._give_up()
        try:
            if self._task is not None:
                await asyncio.wait([self._task])
        finally:
            self._drop()
        await asyncio.sleep(0)  # lets the transport finish its own closing

    async def _transact(self, request: _Request) -> tuple[int, ...]:
        await self._lock.acquire()
        # The exchange is a task of its own that keeps the lock: a caller who is cancelled goes at once, but a request that is already on
        # the wire is still waited for, so its reply can never meet the next request.
        self._on_wire = False
        task = asyncio.get_running_loop().create_task(self._exchange(request))
        self._task = task
        task.add_done_callback(self._finished)
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if not self._on_wire:
                task.cancel()  # nothing was sent yet: then nothing shall be
            raise

    def _finished(self, task: asyncio.Task[tuple[int, ...]]) -> None:
        if not task.cancelled():
            task.exception()  # marks it as seen: a cancelled caller is no longer there to see it
        self._task = None
        self._lock.release()

    async def _exchange(self, request: _Request) -> tuple[int, ...]:
        try:
            return self._result(request, await self._ask(request))
        except (LinkDown, ReplyTimeout, BadFrame):
            # _on_wire is False when there was no connection in the first place: a second attempt would only hammer the device
            retry = self._on_wire and request.values is None and self._client is None and not self._closed
            if not retry:
                raise
        return self._result(request, await self._ask(request))

    async def _ask(self, request: _Request) -> ModbusPDU:
        client = await self._connected()
        self._sent, self._heard, self._complaint = b"", b"", ""
        self._on_wire = True
        unit = self._url.unit
        try:
            async with asyncio.timeout(self._timeout_s) as self._deadline:
                if request.values is None:
                    return await client.read_holding_registers(request.address, count=request.count, device_id=unit)
                return await client.write_registers(request.address, list(request.values), device_id=unit)
        except TimeoutError:
            error = self._why(request)
            self._drop()
            raise error from None
        except ModbusException as trouble:
            self._drop()
            raise LinkDown(self.name, str(request), str(trouble), "device and network on?") from trouble
        finally:
            self._deadline = None

    def _why(self, request: _Request) -> DriverError:
        if self._complaint:
            return BadFrame(self.name, str(request), f"the reply does not fit: {self._complaint} [{self._heard[:40].hex(' ')}]")
        if self._lost or self._closed:
            return LinkDown(self.name, str(request), "the connection was closed", "device restarted, or cable unplugged?")
        if self._heard:
            return BadFrame(
                self.name, str(request), f"no valid reply, only [{self._heard[:40].hex(' ')}]", "line noise? unit and baud right?"
            )
        return ReplyTimeout(self.name, str(request), f"no reply within {self._timeout_s:g} s", "device on? unit number right?")

    def _result(self, request: _Request, reply: ModbusPDU) -> tuple[int, ...]:
        if not reply.isError():
            return tuple(reply.registers)
        code = reply.exception_code
        detail = f"exception {code}: {EXCEPTION_TEXT.get(code, 'unknown')}"
        if code in (1, 2, 3):
            raise Refused(self.name, str(request), detail, "does the register map fit this device?")
        if code in (5, 6):
            raise ReplyTimeout(self.name, str(request), detail, "try again in a moment")
        raise DeviceFault(self.name, str(request), detail, "look at the device's own diagnostics")

    async def _connected(self) -> AsyncModbusTcpClient | AsyncModbusSerialClient:
        if self._closed:
            raise LinkDown(self.name, "connect", "the link was closed")
        if self._lost or (self._client is not None and not self._client.connected):
            self._drop()
        if self._client is None:
            self._client = await self._open()
            self.connections += 1
        if self._dirty:
            await self._silence()
        return self._client

    async def _open(self) -> AsyncModbusTcpClient | AsyncModbusSerialClient:
        client = self._new_client()
        self._lost = False
        connected = False
        try:
            async with asyncio.timeout(self._timeout_s):
                connected = await client.connect()
        except TimeoutError:
            pass
        finally:
            if not connected:
                client.close()
        if not connected:
            raise LinkDown(self.name, "connect", "refused, busy or unreachable", self._remedy())
        return client

    def _new_client(self) -> AsyncModbusTcpClient | AsyncModbusSerialClient:
        # Always a new object: the library's connection state does not survive every kind of loss. reconnect_delay=0 is the documented and
        # (in 3.16.1) safe way to switch its reconnects off. Its own timeout is longer than ours, so that ours decides.
        url, slack = self._url, self._timeout_s + 5.0
        if isinstance(url, ModbusTcpUrl):
            return AsyncModbusTcpClient(
                url.host,
                port=url.port,
                timeout=slack,
                retries=0,
                reconnect_delay=0,
                trace_packet=self._trace,
                trace_connect=self._trace_connect,
            )
        return AsyncModbusSerialClient(
            url.path,
            framer=FramerType.RTU,
            baudrate=url.baud,
            timeout=slack,
            retries=0,
            reconnect_delay=0,
            trace_packet=self._trace,
            trace_connect=self._trace_connect,
        )

    async def _silence(self) -> None:
        # RTU has no transaction number: wait until the line was silent for a whole reply timeout, so that whatever was late has come
        # and gone. Reopening the port alone does not help against a reply that is still being computed.
        loop = asyncio.get_running_loop()
        start = self._heard_at = loop.time()
        while (left := self._heard_at + self._timeout_s - loop.time()) > 0:
            if self._closed or loop.time() - start > _BABBLE_LIMIT * self._timeout_s:
                self._drop()
                raise LinkDown(
                    self.name, "wait for silence", "the line never falls silent", "second master on the line, or wrong baud rate?"
                )
            await asyncio.sleep(left)
        self._dirty = False

    def _remedy(self) -> str:
        if isinstance(self._url, ModbusTcpUrl):
            return "address and port right? device on? only one connection allowed and somebody else has it?"
        path = self._url.path
        if not os.path.exists(path):
            return "adapter plugged in? device path right?"
        return (
            "another program holds the port?" if os.access(path, os.R_OK | os.W_OK) else "no permission: add this user to the port's group"
        )

    def _drop(self) -> None:
        client, self._client = self._client, None
        self._lost = False
        if client is not None:
            self._dirty = self._rtu
            client.close()

    def _give_up(self) -> None:
        if self._deadline is not None and not self._deadline.expired():
            self._deadline.reschedule(asyncio.get_running_loop().time())

    def _trace(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._sent = data
            return data
        self._heard, self._heard_at = data, asyncio.get_running_loop().time()
        if self._deadline is None or self._deadline.expired():
            return b""  # nobody asked: quarantine hears it, nobody reads it
        self._complaint = rtu_mismatch(self._sent, data) if self._rtu else tcp_mismatch(self._sent, data)
        if not self._complaint:
            return data
        self._give_up()
        return b""

    def _trace_connect(self, connected: bool) -> None:
        if not connected:
            self._lost = True
            self._give_up()
