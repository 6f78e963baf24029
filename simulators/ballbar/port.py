"""The line of the ball-bar's box: bytes in, bytes out, a bounded buffer, never blocking."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from abbe.simulators.pseudo_serial import PseudoSerial

BUFFER_BYTES = 65536
BAUD = 460800

Received = Callable[[bytes], None]


class BytePort(Protocol):
    """The line of the box, as `BallbarWire` needs it."""

    @property
    def url(self) -> str:
        """URL at which a host reaches the box."""
        ...

    def room(self) -> int:
        """Return the number of bytes that the buffer still takes."""
        ...

    def send(self, data: bytes) -> None:
        """Send bytes (replies may exceed the room)."""
        ...

    def pump(self) -> None:
        """Send the buffered bytes, as far as the line accepts them."""
        ...

    async def open(self, received: Received) -> None:
        """Open the line; ``received`` gets the host's bytes."""
        ...

    async def close(self) -> None:
        """Close the line; the host gets end of file."""
        ...


class PtyPort:
    """A serial line: a pseudo terminal, at a stable path if ``link`` is given. The box buffers ``buffer_bytes`` for a slow host."""

    def __init__(self, link: Path | None, buffer_bytes: int = BUFFER_BYTES) -> None:
        self._link = link
        self._buffer_bytes = buffer_bytes
        self._serial: PseudoSerial | None = None

    @property
    def url(self) -> str:
        """``serial://`` and the path of the terminal or of its link."""
        path = "" if self._serial is None else self._serial.path
        return f"serial://{path}?baud={BAUD}"

    def room(self) -> int:
        """Return the number of bytes that the buffer can still take; 0 while unplugged."""
        return 0 if self._serial is None else max(0, self._buffer_bytes - self._serial.backlog)

    @property
    def backlog(self) -> int:
        """Bytes that the terminal has not taken yet."""
        return 0 if self._serial is None else self._serial.backlog

    def send(self, data: bytes) -> None:
        """Send bytes."""
        if self._serial is not None:
            self._serial.send(data)

    def pump(self) -> None:
        """Send the buffered bytes, as far as the terminal accepts them."""
        if self._serial is not None:
            self._serial.pump()

    async def open(self, received: Received) -> None:
        """Open the terminal."""
        self._serial = PseudoSerial(received, self._link)

    async def close(self) -> None:
        """Hang up and remove the link."""
        if self._serial is not None:
            self._serial.close()
            self._serial = None


class TcpPort:
    """A raw TCP port on 127.0.0.1 in place of a serial line; a new connection replaces the old one."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._received: Received = lambda data: None

    @property
    def url(self) -> str:
        """``socket://`` and the address."""
        return f"socket://127.0.0.1:{self._port}"

    def room(self) -> int:
        """Return the number of bytes that the buffer can still take; 0 if no host is connected."""
        if self._writer is None:
            return 0
        return max(0, BUFFER_BYTES - self._writer.transport.get_write_buffer_size())

    @property
    def backlog(self) -> int:
        """Always 0: the transport sends its buffer by itself."""
        return 0

    def send(self, data: bytes) -> None:
        """Send bytes."""
        if self._writer is not None:
            self._writer.write(data)

    def pump(self) -> None:
        """Do nothing: the transport sends its buffer by itself."""

    async def open(self, received: Received) -> None:
        """Listen; the next ``open`` uses the same port again."""
        self._received = received
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self._port)
        self._port = int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop listening and close the host's connection."""
        self._drop()
        if self._server is not None:
            self._server.close()
            self._server = None

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._drop()
        self._writer = writer
        with suppress(ConnectionError):
            while data := await reader.read(4096):
                self._received(data)
        if self._writer is writer:
            self._writer = None
        writer.close()

    def _drop(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
