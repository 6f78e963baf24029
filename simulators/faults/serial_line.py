"""A serial line between the ball-bar's box and the host, which tests can unplug, stall and corrupt.

`heard` simulates a serial receiver with another baud rate or parity than the sender's, which samples the bits at wrong instants.
"""

import asyncio
import os
import termios
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from abbe.simulators.ballbar.port import BUFFER_BYTES, Received
from abbe.simulators.pseudo_serial import PseudoSerial

PARITIES = ("none", "even", "odd")


@dataclass(frozen=True, slots=True)
class Uart:
    """Settings of one end of the line: 8 data bits, 1 stop bit."""

    baud: int
    parity: str = "none"


def heard(data: bytes, sender: Uart, receiver: Uart) -> bytes:
    """Return the bytes that the receiver reads, sent without pauses; a character without a stop bit reads as 0, as under Linux."""
    if sender == receiver:
        return data
    line = _bits(data, sender.parity)
    ratio = sender.baud / receiver.baud
    length = len(line) / ratio  # in bits of the receiver
    size = 10 + (receiver.parity != "none")
    out = bytearray()
    at = 0.0
    while at < length:
        if line[int(at * ratio)]:  # idle: search for the start bit in steps of 1/16 bit, as receivers do
            at += 1.0 / 16.0
            continue
        taken = [_level(line, (at + k + 0.5) * ratio) for k in range(size)]
        out.append(sum(bit << k for k, bit in enumerate(taken[1:9])) if taken[-1] else 0)
        at += size - 0.5  # from the middle of the stop bit on, the next start bit may come
        while not taken[-1] and at < length and not line[int(at * ratio)]:
            at += 1.0 / 16.0  # after a broken character the line must be idle before the next one
    return bytes(out)


def _bits(data: bytes, parity: str) -> list[int]:
    bits: list[int] = []
    for byte in data:
        ones = [byte >> k & 1 for k in range(8)]
        check = [] if parity == "none" else [(sum(ones) + (parity == "odd")) % 2]
        bits += [0, *ones, *check, 1]
    return bits


def _level(line: list[int], at: float) -> int:
    return line[int(at)] if at < len(line) else 1


Spoil = Callable[[bytes], Iterable[bytes]]
"""Turns undamaged bytes into the pieces that arrive, in order; every piece is written separately."""


_BAUD = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


class _Terminal(PseudoSerial):
    """A pty that sends its buffered bytes as soon as the host reads, and that can stop the host's output."""

    def pump(self) -> None:
        """Send the buffered bytes, and continue when there is room."""
        super().pump()
        loop = asyncio.get_running_loop()
        loop.remove_writer(self._master)
        if self.backlog:
            loop.add_writer(self._master, self.pump)

    def close(self) -> None:
        """Hang up."""
        asyncio.get_running_loop().remove_writer(self._master)
        super().close()

    def hold(self, held: bool) -> None:
        """Stop the host's output (``held``), or let it continue, like a device that sends XOFF or XON."""
        termios.tcflow(self._slave, termios.TCOOFF if held else termios.TCOON)

    def stuff(self) -> int:
        """Stop reading, fill the terminal's buffer towards the device, and return the number of bytes that it took."""
        asyncio.get_running_loop().remove_reader(self._master)
        taken = 0
        os.set_blocking(self._slave, False)
        with suppress(BlockingIOError):
            while True:
                taken += os.write(self._slave, bytes(256))
        return taken

    def unstuff(self) -> None:
        """Discard the bytes of `stuff` and let the device read again."""
        termios.tcflush(self._slave, termios.TCOFLUSH)
        with suppress(BlockingIOError):
            while os.read(self._master, 65536):
                pass
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def host_baud(self) -> int:
        """Return the baud rate that the host has set, 0 if it is not a standard one."""
        return _BAUD.get(termios.tcgetattr(self._slave)[5], 0)


class FaultyLine:
    """A line of a ball-bar's box (a ``BytePort``) at a stable path.

    Parameters
    ----------
    link : Path
        Stable path at which the host finds the line. A change while the line is unplugged acts like another port of the computer.
    box : Uart
        Baud rate and parity of the box. The host's baud rate is read from the terminal; terminals store no parity, so the host's is set in
        ``host_parity``.
    """

    def __init__(self, link: Path, box: Uart) -> None:
        self.link, self._box = link, box
        self._terminal: _Terminal | None = None
        self._received: Received = lambda data: None
        self.host_parity = box.parity
        self.spoil: Spoil | None = None
        self._held_back: list[bytes] | None = None

    @property
    def url(self) -> str:
        """URL at which a host reaches the line."""
        return f"serial://{self.link.absolute()}?baud={self._box.baud}"

    @property
    def plugged(self) -> bool:
        """Whether the cable is in."""
        return self._terminal is not None

    @property
    def terminal(self) -> _Terminal:
        """The terminal of a line that is plugged in."""
        if self._terminal is None:
            raise RuntimeError("the line is not plugged in")
        return self._terminal

    def room(self) -> int:
        """Return the number of bytes that the buffer can still take; 0 while unplugged."""
        return 0 if self._terminal is None else max(0, BUFFER_BYTES - self._terminal.backlog)

    def send(self, data: bytes) -> None:
        """Send bytes to the host, after ``spoil`` and the effect of wrong settings of the host."""
        if self._terminal is None or not data:
            return
        for piece in self.spoil(data) if self.spoil is not None else (data,):
            if self._terminal is None:  # unplugged between two pieces
                return
            arrives = heard(piece, self._box, self._host())
            if self._held_back is not None:
                self._held_back.append(arrives)
            elif arrives:
                self._terminal.send(arrives)

    def pump(self) -> None:
        """Send the buffered bytes, as far as the terminal accepts them."""
        if self._terminal is not None:
            self._terminal.pump()

    def stall(self) -> None:
        """Hold back all bytes to the host until ``resume``; none is lost."""
        self._held_back = []

    def resume(self) -> None:
        """Send all bytes that were held back."""
        held, self._held_back = self._held_back or [], None
        if self._terminal is not None:
            self._terminal.send(b"".join(held))

    async def open(self, received: Received) -> None:
        """Plug in: open a new terminal at the stable path."""
        self._received = received
        self._terminal = _Terminal(self._hear, self.link)

    async def close(self) -> None:
        """Unplug."""
        self.pull()

    def pull(self) -> None:
        """Unplug at once: close both ends of the terminal and remove the path."""
        terminal, self._terminal, self._held_back = self._terminal, None, None
        if terminal is not None:
            terminal.close()

    def _host(self) -> Uart:
        baud = self._terminal.host_baud() if self._terminal is not None else 0
        # a terminal that no host has opened yet has the default speed of a modem, and no reader
        return Uart(baud, self.host_parity) if baud > 38400 else self._box

    def _hear(self, data: bytes) -> None:
        self._received(heard(data, self._host(), self._box))
