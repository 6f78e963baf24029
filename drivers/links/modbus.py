"""One Modbus connection, TCP or RTU: open it, send one request at a time, close it. The only file that uses pymodbus.

Differences from plain pymodbus (3.16.1): no hidden repetition of writes, no hidden reconnects, a comparison of every reply with its request
(`tcp_mismatch`, `rtu_mismatch`) before pymodbus gets the reply, closing of the old socket before a new one opens, and detection of
unsolicited bytes.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
from dataclasses import dataclass

from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from abbe.drivers.errors import BadFrame, DriverError, LinkDown, ReplyTimeout, run_to_end
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl

_TCP_HEADER = 7
_READ = (3, 4)


def tcp_mismatch(sent: bytes, heard: bytes) -> str:
    """Compare the bytes received so far on Modbus TCP with the request frame.

    ``heard``: all bytes since the request, possibly incomplete. Returns the mismatch, or ``""``.
    """
    if len(heard) >= 2 and heard[:2] != sent[:2]:
        return f"transaction id {int.from_bytes(heard[:2], 'big')} instead of {int.from_bytes(sent[:2], 'big')}"
    if len(heard) >= 4 and heard[2:4] != b"\x00\x00":
        return f"protocol id {int.from_bytes(heard[2:4], 'big')} instead of 0"
    if len(heard) >= _TCP_HEADER and heard[6] != sent[6]:
        return f"unit {heard[6]} instead of {sent[6]}"
    complaint = _pdu_mismatch(sent[_TCP_HEADER:], heard[_TCP_HEADER:])
    if complaint or len(heard) <= _TCP_HEADER:
        return complaint
    size, expected = int.from_bytes(heard[4:6], "big"), 1 + _pdu_size(sent[_TCP_HEADER:], heard[_TCP_HEADER])
    if size != expected:
        return f"length {size} instead of {expected}"
    if len(heard) > 6 + size:
        return f"{len(heard) - 6 - size} bytes too many"
    return ""


def rtu_mismatch(sent: bytes, heard: bytes) -> str:
    """Compare the bytes received so far on Modbus RTU with the request frame; the library verifies the check sum.

    ``heard``: all bytes since the request, possibly incomplete. Returns the mismatch, or ``""``.
    """
    if heard and heard[0] != sent[0]:
        return f"unit {heard[0]} instead of {sent[0]}"
    complaint = _pdu_mismatch(sent[1:-2], heard[1:])
    if complaint or len(heard) < 2:
        return complaint
    extra = len(heard) - (1 + _pdu_size(sent[1:-2], heard[1]) + 2)
    return f"{extra} bytes too many" if extra > 0 else ""


def _pdu_size(asked: bytes, function: int) -> int:
    if function & 0x80:
        return 2
    return 2 + 2 * int.from_bytes(asked[3:5], "big") if asked[0] in _READ else 5


def _pdu_mismatch(asked: bytes, heard: bytes) -> str:
    if not heard:
        return ""
    if heard[0] not in (asked[0], asked[0] | 0x80):
        return f"function {heard[0]} instead of {asked[0]}"
    if heard[0] & 0x80:
        return ""
    if asked[0] in _READ:
        expected = 2 * int.from_bytes(asked[3:5], "big")
        return f"{heard[1]} data bytes instead of {expected}" if len(heard) >= 2 and heard[1] != expected else ""
    if len(heard) >= 3 and heard[1:3] != asked[1:3]:
        return f"echo of address {int.from_bytes(heard[1:3], 'big')} instead of {int.from_bytes(asked[1:3], 'big')}"
    if len(heard) >= 5 and heard[3:5] != asked[3:5]:
        return f"echo of count {int.from_bytes(heard[3:5], 'big')} instead of {int.from_bytes(asked[3:5], 'big')}"
    return ""


# All failures become typed errors here: the library's own log would only repeat them on stderr.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

READ_HOLDING, READ_INPUT, WRITE, WRITE_ONE = 3, 4, 16, 6
WRITES = (WRITE, WRITE_ONE)
_PARITY = {"none": "N", "even": "E", "odd": "O"}
# With these options the kernel, too, detects within 3 s that a peer has vanished.
_KEEPALIVE = (("TCP_KEEPIDLE", 1), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 2), ("TCP_USER_TIMEOUT", 2500))
_BITS_PER_BYTE = 11
_TURNS = 20
_SHORTEST_GAP_S = 0.00175  # 3.5 characters; above 19200 Bd the standard fixes it


@dataclass(frozen=True, slots=True)
class Request:
    """One Modbus request; ``values``: registers to write, empty for a read."""

    function: int
    address: int
    count: int
    values: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{'write' if self.function in WRITES else 'read'} registers {self.address}..{self.address + self.count - 1}"


@dataclass(frozen=True, slots=True)
class ModbusReply:
    """A matching reply: the registers of a read, or the exception code."""

    registers: tuple[int, ...] = ()
    exception: int = 0


TURNS_TO_OPEN = 2
"""Turns of the event loop until pymodbus can close a serial port that it has just opened."""


class ModbusWire:
    """Connects to one Modbus unit; opens at most one connection at a time."""

    def __init__(self, url: ModbusTcpUrl | ModbusRtuUrl) -> None:
        self._url = url
        self.name = str(url)
        self.rtu = isinstance(url, ModbusRtuUrl)
        self._client: AsyncModbusTcpClient | AsyncModbusSerialClient | None = None
        self._deadline: asyncio.Timeout | None = None
        self._lost = False
        self._sent = b""
        self._heard = b""
        self._complaint = ""
        self.heard_at = float("-inf")
        """Loop time of the last byte."""
        self.strays = 0
        """Number of unsolicited bytes since the connection was made or ``forget`` was called."""

    @property
    def up(self) -> bool:
        """Whether there is a connection that is not known to be lost."""
        return self._client is not None and self._client.connected and not self._lost

    async def open(self, timeout_s: float) -> None:
        """Connect, after closing any former connection.

        Raises
        ------
        LinkDown
            No answer at the address, or the serial port cannot be opened.
        """
        await self.drop()
        client, self._lost, self.strays = self._new_client(timeout_s), False, 0
        # In a task: before Python 3.12, the wait_for in connect() swallows a cancellation that meets its result.
        connecting, connected = asyncio.create_task(client.connect()), False
        try:
            await asyncio.wait({connecting}, timeout=timeout_s)
            connected = connecting.done() and connecting.result()
        finally:
            if not connected:
                await run_to_end(_given_up(client, connecting))
        if not connected:
            raise LinkDown(self.name, "connect", "the device refused the connection, is busy or cannot be reached", self._remedy())
        self._client = client
        self._keep_alive()

    async def ask(self, request: Request, timeout_s: float) -> ModbusReply:
        """Send a request once and wait for its answer.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, a lost connection, or a reply that does not answer the request.
        """
        client, unit = self._client, self._url.unit
        if client is None:
            raise LinkDown(self.name, str(request), "there is no connection")
        self._sent, self._heard, self._complaint = b"", b"", ""
        me = asyncio.current_task()
        assert me is not None
        cancels = me.cancelling()
        try:
            async with asyncio.timeout(timeout_s) as self._deadline:
                match request.function:
                    case 16:
                        reply = await client.write_registers(request.address, list(request.values), device_id=unit)
                    case 6:
                        reply = await client.write_register(request.address, request.values[0], device_id=unit)
                    case 4:
                        reply = await client.read_input_registers(request.address, count=request.count, device_id=unit)
                    case _:
                        reply = await client.read_holding_registers(request.address, count=request.count, device_id=unit)
        except TimeoutError:
            raise self._why(request, timeout_s) from None
        except ModbusException as trouble:
            raise LinkDown(self.name, str(request), str(trouble), "check that device and network are on") from trouble
        finally:
            self._deadline = None
        if me.cancelling() > cancels:  # lost in pymodbus, see `open`
            raise asyncio.CancelledError
        return ModbusReply(exception=reply.exception_code) if reply.isError() else ModbusReply(tuple(reply.registers))

    async def drop(self) -> None:
        """Close the connection, if any, and wait until it is closed: a device that allows one socket must never see two."""
        client, self._client, self._lost = self._client, None, False
        if client is None:
            return
        transport = client.ctx.transport
        client.close()
        if isinstance(transport, asyncio.Transport):
            transport.abort()  # discards unsent bytes
        end = transport.get_extra_info("socket") if isinstance(transport, asyncio.Transport) and not self.rtu else None
        for _ in range(_TURNS):  # the event loop closes a socket in one of its next turns
            await asyncio.sleep(0)
            if end is None or end.fileno() == -1:
                return

    def hang_up(self) -> None:
        """End a pending ``ask`` with ``LinkDown``."""
        self._lost = True
        self._interrupt()

    def _interrupt(self) -> None:
        if self._deadline is not None and not self._deadline.expired():
            self._deadline.reschedule(asyncio.get_running_loop().time())

    async def gap(self) -> None:
        """On RTU, wait until 3.5 characters have passed since the last byte. Bytes that come meanwhile count as strays."""
        if self.rtu:
            gap_s = max(_SHORTEST_GAP_S, 3.5 * _BITS_PER_BYTE / self._baud)
            await asyncio.sleep(max(0.0, self.heard_at + gap_s - asyncio.get_running_loop().time()))

    def forget(self) -> None:
        """Reset the count of unsolicited bytes (``strays``)."""
        self.strays = 0

    @property
    def _baud(self) -> int:
        return self._url.baud if isinstance(self._url, ModbusRtuUrl) else 1

    def _why(self, request: Request, timeout_s: float) -> DriverError:
        if self._complaint:
            detail = f"the reply does not fit the request: {self._complaint} [{self._heard[:40].hex(' ')}]"
            return BadFrame(self.name, str(request), detail, "look for line noise, a second Modbus master or a wrong device")
        if self._lost or not self.up:
            return LinkDown(self.name, str(request), "the connection was closed", "check the cable, and whether the device restarted")
        if self._heard:
            detail = f"no valid reply, only [{self._heard[:40].hex(' ')}]"
            return BadFrame(self.name, str(request), detail, "check unit number and baud rate; look for line noise")
        return ReplyTimeout(self.name, str(request), f"no reply within {timeout_s:g} s", "check that the device is on, and its unit number")

    def _new_client(self, timeout_s: float) -> AsyncModbusTcpClient | AsyncModbusSerialClient:
        # Always a new object: the library's connection state does not survive every kind of loss. reconnect_delay=0 is the documented and
        # (in 3.16.1) safe way to switch its reconnects off. Its own timeout is longer than ours, so that ours decides.
        url, slack_s = self._url, timeout_s + 5.0
        if isinstance(url, ModbusTcpUrl):
            return AsyncModbusTcpClient(
                url.host,
                port=url.port,
                timeout=slack_s,
                retries=0,
                reconnect_delay=0,
                trace_packet=self._trace,
                trace_connect=self._trace_connect,
            )
        return AsyncModbusSerialClient(
            url.path,
            framer=FramerType.RTU,
            baudrate=url.baud,
            parity=_PARITY[url.parity],
            timeout=slack_s,
            retries=0,
            reconnect_delay=0,
            trace_packet=self._trace,
            trace_connect=self._trace_connect,
        )

    def _keep_alive(self) -> None:
        transport = self._client.ctx.transport if self._client is not None else None
        if self.rtu or not isinstance(transport, asyncio.Transport):
            return
        end = transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # without keep-alive the deadlines and the heartbeat remain
            end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEPALIVE:
                if (option := getattr(socket, name, None)) is not None:
                    end.setsockopt(socket.IPPROTO_TCP, option, value)

    def _remedy(self) -> str:
        if isinstance(self._url, ModbusTcpUrl):
            return "check address and port, that the device is on, and that no other program holds its only connection"
        path = self._url.path
        if not os.path.exists(path):
            return "plug the adapter in, or correct the path of the port"
        return (
            "close the other program that may hold the port"
            if os.access(path, os.R_OK | os.W_OK)
            else "no permission: add this user to the port's group"
        )

    def _trace(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._sent = data
            return data
        self.heard_at = asyncio.get_running_loop().time()
        if self._deadline is None or self._deadline.expired():
            self.strays += len(data)
            return b""  # unsolicited: counted for the quarantine, never read as a reply
        self._heard = data
        self._complaint = rtu_mismatch(self._sent, data) if self.rtu else tcp_mismatch(self._sent, data)
        if not self._complaint:
            return data
        self._interrupt()
        return b""

    def _trace_connect(self, connected: bool) -> None:
        if not connected:
            self._lost = True
            self._interrupt()


async def _given_up(client: AsyncModbusTcpClient | AsyncModbusSerialClient, connecting: asyncio.Task[bool]) -> None:
    """End an attempt to connect, and close what it has opened so far."""
    connecting.cancel()
    await asyncio.wait({connecting})
    for _ in range(TURNS_TO_OPEN):
        await asyncio.sleep(0)
    client.close()
