"""Bytes over a serial port or a raw TCP socket (the only file with pyserial).

The event loop itself reads and writes, so that a cancelled read really ends and an unplugged adapter is detected at once. Measurements use
a reading thread instead (`start_reading`), so that no byte is lost while the loop is busy.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import serial
from serial.tools import list_ports

from abbe.drivers.errors import LinkDown, ReplyTimeout, WrongDevice
from abbe.drivers.links.reading import ReadingThread, Ring
from abbe.drivers.links.urls import SerialUrl, SocketUrl

try:
    from termios import error as terminal_error
except ImportError:  # Windows
    terminal_error = OSError  # type: ignore[misc,assignment]


@dataclass(frozen=True, slots=True)
class Adapter:
    """A serial adapter as listed by the system. ``node``: current device path; ``kind`` and ``serial_number``: its identity."""

    node: str
    kind: str
    serial_number: str

    def __str__(self) -> str:
        return f"{self.kind} {self.serial_number}"


def adapter_at(path: str, listed: Sequence[Adapter]) -> Adapter | None:
    """Return the adapter behind a path (following links); None if it has no serial number."""
    real = os.path.realpath(path)
    found = [adapter for adapter in listed if os.path.realpath(adapter.node) == real]
    return found[0] if found and found[0].serial_number else None


def path_to_open(device: str, path: str, known: Adapter | None, listed: Sequence[Adapter]) -> str:
    """Return the current path of the adapter that was opened last (``known``), or the configured path if ``known`` is None.

    Raises
    ------
    LinkDown
        The adapter is not plugged in.
    WrongDevice
        The adapter is not plugged in, and another one has its path.
    """
    if known is None:
        return path
    for adapter in listed:
        if (adapter.kind, adapter.serial_number) == (known.kind, known.serial_number):
            return adapter.node
    other = adapter_at(path, listed)
    if other is not None:
        raise WrongDevice(device, "open", f"adapter {other} is there instead of {known}", "plug the right adapter in")
    raise LinkDown(device, "open", f"adapter {known} is not plugged in", "plug it in, at any socket of this computer")


_CONNECT_S = 5.0


async def connected(url: SocketUrl) -> socket.socket:
    """Connect a socket. Raises LinkDown if refused, unreachable, or without an answer within 5 s."""
    # pyserial's socket:// connects blockingly, which would freeze all other devices of the service for seconds
    try:
        async with asyncio.timeout(_CONNECT_S):
            return await _connect_any(url)
    except TimeoutError:
        raise LinkDown(
            str(url), "open", f"no connection within {_CONNECT_S:g} s", "check the address, and that device and network are on"
        ) from None
    except OSError as error:
        raise LinkDown(str(url), "open", str(error), "check address and port, and that the device server runs") from error


async def _connect_any(url: SocketUrl) -> socket.socket:
    # a name may have several addresses (localhost: ::1 and 127.0.0.1), of which only one is served
    loop = asyncio.get_running_loop()
    refused = OSError(f"{url.host} has no address")
    for family, kind, protocol, _, address in await loop.getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM):
        sock = socket.socket(family, kind, protocol)
        connected = False
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await loop.sock_connect(sock, address)
            connected = True
        except OSError as error:
            refused = error
        finally:
            if not connected:
                sock.close()
        if connected:
            return sock
    raise refused


_DRAIN_S = 0.5
_POLL_S = 0.01
_PARITY = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}
_UNPLUGGED = "check whether cable or adapter is unplugged, then try again"


class ByteLink:
    """A byte pipe to one device, even if the device returns at another port.

    A serial port is locked: no second program (or link) can open it. An adapter with a serial number is found again at any port, and no
    other adapter is accepted instead; ``adapters`` returns the adapters now plugged in. ``bits``, ``stop``: data and stop bits of a
    character.
    """

    def __init__(
        self, url: SerialUrl | SocketUrl, adapters: Callable[[], list[Adapter]] | None = None, *, bits: int = 8, stop: int = 1
    ) -> None:
        self._url = url
        self._bits, self._stop = bits, stop
        self._adapters = adapters or plugged_in
        self._adapter: Adapter | None = None
        self.name = str(url)
        self._port: serial.Serial | socket.socket | None = None
        self._waiting: set[asyncio.Future[None]] = set()
        self._reading: ReadingThread | None = None

    @property
    def serial_no(self) -> int | None:
        """Serial number that the URL requires, or None."""
        return self._url.serial_no

    @property
    def is_open(self) -> bool:
        """Whether the port is open: from ``open`` until ``close`` or the loss of the device."""
        return self._port is not None

    async def open(self) -> None:
        """Open the port if it is not open.

        Raises
        ------
        LinkDown
            The port is missing, forbidden, busy or unreachable.
        WrongDevice
            Another adapter now has the path of the one opened before.
        """
        if self._port is None:
            self._port = self._open_serial(self._url) if isinstance(self._url, SerialUrl) else await connected(self._url)

    async def read(self, max_bytes: int, *, timeout_s: float) -> tuple[float, bytes]:
        """Wait for bytes and return all available ones, at least one.

        Returns
        -------
        tuple of (float, bytes)
            Monotonic host seconds at the read, and the bytes.

        Raises
        ------
        ReplyTimeout
            No byte within ``timeout_s``.
        LinkDown
            The device is lost.
        """
        descriptor = self._descriptor("read")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(timeout_s):
                while True:
                    # Always wait for readiness first: an idle serial line reads as b"", which would look like a hang-up.
                    await self._ready(descriptor, loop.add_reader, loop.remove_reader)
                    try:
                        data = os.read(descriptor, max_bytes)
                    except BlockingIOError:
                        continue
                    break
        except TimeoutError:
            raise ReplyTimeout(
                self.name, "read", f"no byte within {timeout_s:g} s", "check that the device is on, and the baud rate"
            ) from None
        except OSError as error:
            raise self._lost("read", error) from error
        if not data:
            raise self._lost("read", None)
        return time.monotonic(), data

    def start_reading(self, ring: Ring, on_lost: Callable[[LinkDown], None]) -> None:
        """Start a thread that reads every byte into ``ring`` until ``close``; meanwhile ``read`` is not allowed.

        ``on_lost`` is called in the event loop when the device is lost; the port is closed then.

        Raises
        ------
        LinkDown
            The port is not open.
        """
        descriptor = self._descriptor("read")
        loop = asyncio.get_running_loop()

        def lost(error: OSError | None) -> None:
            with suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(report, error)

        def report(error: OSError | None) -> None:
            if self._reading is reading:  # else the port was closed on purpose
                on_lost(self._lost("read", error))

        reading = self._reading = ReadingThread(descriptor, ring, lost, self.name)

    async def write(self, data: bytes, *, timeout_s: float = 1.0) -> None:
        """Send all bytes.

        Raises
        ------
        ReplyTimeout
            The line did not accept them within ``timeout_s`` (flow control, stuck adapter).
        LinkDown
            The device is lost.
        """
        descriptor = self._descriptor("write")
        loop = asyncio.get_running_loop()
        rest = memoryview(data)
        try:
            async with asyncio.timeout(timeout_s):
                while rest:
                    try:
                        rest = rest[os.write(descriptor, rest) :]
                    except BlockingIOError:
                        await self._ready(descriptor, loop.add_writer, loop.remove_writer)
        except TimeoutError:
            raise ReplyTimeout(
                self.name,
                "write",
                f"the line accepted no bytes for {timeout_s:g} s",
                "switch flow control off, or plug the adapter in again",
            ) from None
        except OSError as error:
            raise self._lost("write", error) from error

    def drop_input(self) -> None:
        """Discard unread bytes, so that a late reply cannot pass for a new one."""
        if isinstance(self._port, serial.Serial):
            try:
                self._port.reset_input_buffer()
            except (OSError, terminal_error) as error:  # pyserial passes it on, which is not an OSError
                raise self._lost("drop input", error) from error
        elif self._port is not None:
            try:
                while self._port.recv(65536):
                    pass
            except BlockingIOError:
                pass
            except OSError as error:
                raise self._lost("drop input", error) from error

    async def close(self) -> None:
        """Close the port; a pending ``read`` or ``write`` raises ``LinkDown``. Closing twice does nothing.

        Written bytes are sent first, for at most half a second; received bytes go into the ring of `start_reading`.
        """
        await self._drain()
        self._release()

    async def _drain(self) -> None:
        port = self._port
        if not isinstance(port, serial.Serial):
            return
        clock = asyncio.get_running_loop().time
        until_s = clock() + _DRAIN_S
        with suppress(OSError, terminal_error):
            while port.is_open and port.out_waiting and clock() < until_s:  # noqa: ASYNC110 - the system does not signal an empty buffer
                await asyncio.sleep(_POLL_S)
            if port.is_open:
                port.reset_output_buffer()  # else a stopped line (XOFF) delays the close by half a minute

    def _open_serial(self, url: SerialUrl) -> serial.Serial:
        listed = self._adapters()
        path = path_to_open(self.name, url.path, self._adapter, listed)
        try:
            port = serial.serial_for_url(
                path,
                baudrate=url.baud,
                parity=_PARITY[url.parity],
                timeout=0,
                write_timeout=0,
                exclusive=True,
                bytesize=self._bits,
                stopbits=self._stop,
            )
        except (OSError, ValueError, terminal_error) as error:  # SerialException is an OSError, that of termios is not
            raise LinkDown(self.name, "open", str(error), serial_remedy(path, error)) from error
        self._adapter = adapter_at(path, listed) or self._adapter
        return port

    def _descriptor(self, operation: str) -> int:
        if self._port is None:
            raise LinkDown(self.name, operation, "the port is not open")
        return self._port.fileno()

    async def _ready(self, descriptor: int, add: Callable[..., None], remove: Callable[[int], bool]) -> None:
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.add(waiter)
        add(descriptor, _wake, waiter)
        try:
            await waiter
        finally:
            self._waiting.discard(waiter)
            if self._port is not None:  # after close() the number may already belong to another file
                remove(descriptor)

    def _lost(self, operation: str, error: Exception | None) -> LinkDown:
        self._release()
        return LinkDown(self.name, operation, f"the device is gone ({'end of file' if error is None else error})", _UNPLUGGED)

    def _release(self) -> None:
        port, self._port = self._port, None
        reading, self._reading = self._reading, None
        if port is None:
            return
        if reading is not None:
            reading.stop()
        loop = asyncio.get_running_loop()
        loop.remove_reader(port.fileno())
        loop.remove_writer(port.fileno())
        for waiter in self._waiting:
            if not waiter.done():
                waiter.set_exception(LinkDown(self.name, "wait", "the port was closed"))
        port.close()


def _wake(waiter: asyncio.Future[None]) -> None:
    if not waiter.done():
        waiter.set_result(None)


def plugged_in() -> list[Adapter]:
    """Return the serial adapters plugged into this computer."""
    return [
        Adapter(port.device, f"{port.vid:04x}:{port.pid:04x}", port.serial_number or "")
        for port in list_ports.comports()
        if port.vid is not None and port.pid is not None
    ]


def serial_remedy(path: str, error: Exception) -> str:
    """Return the remedy for a serial port that does not open."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT or not os.path.exists(path):
        return "plug the adapter in, or correct the path of the port; best is the adapter's link in /dev/serial/by-id"
    if number in (errno.EACCES, errno.EPERM) or not os.access(path, os.R_OK | os.W_OK):
        return "no permission: add this user to the group that owns the port (often dialout)"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "lock" in str(error):
        return "another program holds the port: close that program"
    return "check that this is a serial port, and that it supports this baud rate"
