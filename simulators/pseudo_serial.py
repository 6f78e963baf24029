"""A pseudo terminal that behaves like a serial line in an asyncio loop."""

import asyncio
import os
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


class PseudoSerial:
    """One open pty. The host opens ``path``; ``received`` gets the bytes that it writes.

    This process keeps the slave open, too: otherwise the master would read EIO whenever no host has it open.
    """

    def __init__(self, received: Callable[[bytes], None], link: Path | None = None) -> None:
        self._received = received
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._out = bytearray()
        self._link = link
        self.path = os.ttyname(self._slave)
        if link is not None:
            self._make_link(link)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._master, self._readable)

    def _make_link(self, link: Path) -> None:
        """Point the stable path at this terminal. Replaces an old link, but no other file."""
        link = link.absolute()
        if link.is_symlink():
            link.unlink()
        link.symlink_to(self.path)
        self.path = str(link)

    @property
    def backlog(self) -> int:
        """Bytes waiting because the host does not read."""
        return len(self._out)

    def send(self, data: bytes) -> None:
        """Send bytes; those that the terminal does not accept yet wait in a buffer."""
        self._out += data
        self.pump()

    def pump(self) -> None:
        """Send the buffered bytes, as far as the terminal accepts them."""
        while self._out:
            try:
                written = os.write(self._master, self._out)
            except OSError:  # full (EAGAIN), or hung up
                return
            del self._out[:written]

    def close(self) -> None:
        """Hang up: readers of the terminal get end of file."""
        self._loop.remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        if self._link is not None:
            with suppress(FileNotFoundError):
                self._link.unlink()

    def _readable(self) -> None:
        with suppress(OSError):
            data = os.read(self._master, 4096)
            if data:
                self._received(data)
