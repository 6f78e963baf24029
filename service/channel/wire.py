"""One end of the channel: four bytes of length, then JSON, over a socket pair without an address that the parent created.

No other process can connect to it: there is no file, no port and no name.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Self

from abbe.service.channel.messages import LARGEST_B, FromCore, FromWeb, encode
from abbe.service.errors import ChannelBroken

_LENGTH = struct.Struct(">I")
FULL_B = 2 * LARGEST_B
"""Bytes that may wait for the reader. Beyond them the sender skips updates, since newer ones follow."""


class Wire:
    """Sends and receives whole messages; created by `Wire.over`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def over(cls, end: socket.socket) -> Self:
        """Take over one end of a socket pair."""
        end.setblocking(False)
        return cls(*await asyncio.open_connection(sock=end, limit=LARGEST_B + _LENGTH.size))

    @property
    def is_full(self) -> bool:
        """Whether so much waits for the reader that updates should be skipped."""
        return self._writer.transport.get_write_buffer_size() > FULL_B

    def send(self, message: FromCore | FromWeb) -> None:
        """Send without waiting; a message to a closed channel is lost, and the reading side notices the end.

        Raises
        ------
        ChannelBroken
            The message does not match its type.
        """
        body = encode(message)
        if not self._writer.is_closing():
            self._writer.write(_LENGTH.pack(len(body)) + body)

    async def receive(self) -> bytes | None:
        """Return the next message; None when the other side has ended.

        Raises
        ------
        ChannelBroken
            The announced length is too large.
        """
        try:
            (size,) = _LENGTH.unpack(await self._reader.readexactly(_LENGTH.size))
            if size > LARGEST_B:
                raise ChannelBroken(f"a message of {size} bytes was announced on the channel of the service; allowed are {LARGEST_B}")
            return await self._reader.readexactly(size)
        except (asyncio.IncompleteReadError, ConnectionError):
            return None

    def close(self) -> None:
        """Close this end; the other side reads the end of the stream."""
        self._writer.close()
