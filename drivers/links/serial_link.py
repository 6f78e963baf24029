"""Bytes over a serial port or a raw TCP socket, read and written by the event loop itself (the only file with pyserial).

No thread: cancelling a read really ends it, and an unplugged adapter is noticed at once.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import termios
import time
from collections.abc import Callable

import serial

from drivers.errors import LinkDown, ReplyTimeout
from drivers.links.urls import SerialUrl, SocketUrl

_CONNECT_S = 5.0
_UNPLUGGED = "cable or adapter unplugged? check it, then try again"


class ByteLink:
    """A byte pipe to one device.

    Parameters
    ----------
    url : SerialUrl or SocketUrl
        Where the device is. A serial port is locked: a second program (or a second link) cannot open it.
    """

    def __init__(self, url: SerialUrl | SocketUrl) -> None:
        self._url = url
        self.name = str(url)
        self._port: serial.Serial | socket.socket | None = None
        self._waiting: set[asyncio.Future[None]] = set()

    @property
    def is_open(self) -> bool:
        """True from a successful ``open`` until ``close`` or the loss of the device."""
        return self._port is not None

    async def open(self) -> None:
        """Open the port; does nothing when it is open.

        Raises
        ------
        LinkDown
            Missing, forbidden, busy or unreachable; the text says which and what to do.
        """
        if self._port is None:
            self._port = _open_serial(self._url) if isinstance(self._url, SerialUrl) else await _open_socket(self._url)

    async def read(self, max_bytes: int, *, timeout_s: float) -> tuple[float, bytes]:
        """Wait for bytes and return all that are there, at least one.

        Returns
        -------
        tuple of (float, bytes)
            Monotonic host seconds at the read, and the bytes.

        Raises
        ------
        ReplyTimeout
            Not a single byte within ``timeout_s``.
        LinkDown
            The device has gone.
        """
        descriptor = self._descriptor("read")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(timeout_s):
                while True:
                    # Always wait for readiness first: a serial line without data reads as b"", which would look like a hang-up.
                    await self._ready(descriptor, loop.add_reader, loop.remove_reader)
                    try:
                        data = os.read(descriptor, max_bytes)
                    except BlockingIOError:
                        continue
                    break
        except TimeoutError:
            raise ReplyTimeout(self.name, "read", f"no byte within {timeout_s:g} s", "device switched on? baud rate right?") from None
        except OSError as error:
            raise self._lost("read", error) from error
        if not data:
            raise self._lost("read", None)
        return time.monotonic(), data

    async def write(self, data: bytes, *, timeout_s: float = 1.0) -> None:
        """Send all bytes.

        Raises
        ------
        ReplyTimeout
            The line did not take them within ``timeout_s`` (flow control, stuck adapter).
        LinkDown
            The device has gone.
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
            raise ReplyTimeout(self.name, "write", f"line takes no bytes for {timeout_s:g} s", "flow control or adapter stuck?") from None
        except OSError as error:
            raise self._lost("write", error) from error

    def drop_input(self) -> None:
        """Throw away what has arrived and was not read yet, so that a late answer cannot pass for a new one."""
        if isinstance(self._port, serial.Serial):
            try:
                self._port.reset_input_buffer()
            except (OSError, termios.error) as error:  # pyserial lets termios.error through, which is not an OSError
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
        """Close the port; whoever waits in ``read`` or ``write`` gets ``LinkDown``. Closing twice does nothing."""
        self._release()

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
            if self._port is not None:  # after close() the number may already belong to somebody else
                remove(descriptor)

    def _lost(self, operation: str, error: Exception | None) -> LinkDown:
        self._release()
        return LinkDown(self.name, operation, f"the device has gone ({'end of file' if error is None else error})", _UNPLUGGED)

    def _release(self) -> None:
        port, self._port = self._port, None
        if port is None:
            return
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


def _open_serial(url: SerialUrl) -> serial.Serial:
    try:
        port = serial.serial_for_url(url.path, baudrate=url.baud, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError, termios.error is not
        raise LinkDown(str(url), "open", str(error), serial_remedy(url.path, error)) from error
    return port


async def _open_socket(url: SocketUrl) -> socket.socket:
    # pyserial's own socket:// connects blockingly, which would freeze every other device of the service for seconds
    try:
        async with asyncio.timeout(_CONNECT_S):
            return await _connect_any(url)
    except TimeoutError:
        raise LinkDown(str(url), "open", f"no connection within {_CONNECT_S:g} s", "address right? device and network on?") from None
    except OSError as error:
        raise LinkDown(str(url), "open", str(error), "address and port right? device server running?") from error


async def _connect_any(url: SocketUrl) -> socket.socket:
    # a name may stand for several addresses (localhost: ::1 and 127.0.0.1) of which only one is served
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


def serial_remedy(path: str, error: Exception) -> str:
    """Say what a person can do about a serial port that does not open.

    Parameters
    ----------
    path : str
        Device path.
    error : Exception
        What the attempt raised.
    """
    number = getattr(error, "errno", None)
    if number == errno.ENOENT or not os.path.exists(path):
        return "adapter plugged in? device path right? prefer the by-id link of the adapter"
    if number in (errno.EACCES, errno.EPERM) or not os.access(path, os.R_OK | os.W_OK):
        return "no permission: add this user to the group that owns the port (often dialout)"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "lock" in str(error):
        return "another program holds the port: close it"
    return "is this really a serial port, and is the baud rate one it can do?"
