"""One end of the channel: four bytes of length, then JSON, over a pair of sockets that was made by the parent and has no address.

Nobody but the two processes can ever be at either end: there is no file, no port and no name to connect to.
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
"""So much may wait for a reader; news that would come on top of it is left out, since newer news follow."""


class Wire:
    """Sends and receives whole messages. Make it with `Wire.over`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def over(cls, end: socket.socket) -> Self:
        """One end of a pair of sockets, from now on ours."""
        end.setblocking(False)
        return cls(*await asyncio.open_connection(sock=end, limit=LARGEST_B + _LENGTH.size))

    @property
    def is_full(self) -> bool:
        """Whether the other side has not read for so long that news are better left out."""
        return self._writer.transport.get_write_buffer_size() > FULL_B

    def send(self, message: FromCore | FromWeb) -> None:
        """Send without waiting. What cannot be sent any more is lost: the end of the channel is noticed where it is read.

        Raises
        ------
        ChannelBroken
            The message is not what its type says.
        """
        body = encode(message)
        if not self._writer.is_closing():
            self._writer.write(_LENGTH.pack(len(body)) + body)

    async def receive(self) -> bytes | None:
        """Return the next message; None when the other side has ended.

        Raises
        ------
        ChannelBroken
            It announces one that is too long.
        """
        try:
            (size,) = _LENGTH.unpack(await self._reader.readexactly(_LENGTH.size))
            if size > LARGEST_B:
                raise ChannelBroken(f"a message of {size} bytes was announced on the channel of the service; allowed are {LARGEST_B}")
            return await self._reader.readexactly(size)
        except (asyncio.IncompleteReadError, ConnectionError):
            return None

    def close(self) -> None:
        """End it; the other side reads its end."""
        self._writer.close()
