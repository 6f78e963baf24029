"""Ask the person at the console without blocking the event loop."""

from __future__ import annotations

import asyncio
import os
import sys
from typing import TYPE_CHECKING

from abbe.service.errors import ConfigError

if TYPE_CHECKING:
    from abbe.service.devices.session import Ask


async def console_ask(text: str) -> None:
    """Print what to do and wait for Enter. Input typed before the question is discarded: people confirm only what they have read.

    Raises
    ------
    ConfigError
        No one is at the console (standard input is closed or not a terminal).
    """
    import termios  # here: a platform without termios still plans and reads

    if not sys.stdin.isatty():
        raise ConfigError(f"no one is at the console to: {text}", "run this from a terminal, or configure a remote fixture")
    # The descriptor itself: Python's buffer would keep a pasted second line for the next question, out of reach of tcflush.
    line = sys.stdin.fileno()
    termios.tcflush(line, termios.TCIFLUSH)
    sys.stderr.write(f"\n>> {text}\n   press Enter when done: ")
    sys.stderr.flush()
    if await _entered(line) == b"":
        raise ConfigError("standard input was closed", "start again from a terminal")


def person_at_console() -> Ask:
    """Return how to ask at this console: the person at the terminal, or `no_console`, which refuses before anything moves."""
    from abbe.service.devices.session import no_console

    return console_ask if sys.stdin is not None and sys.stdin.isatty() else no_console


async def _entered(line: int) -> bytes:
    """Return what is typed up to Enter; empty when the terminal is gone."""
    loop = asyncio.get_running_loop()
    entered: asyncio.Future[bytes] = loop.create_future()

    def ready() -> None:
        if entered.done():
            return
        try:
            entered.set_result(os.read(line, 4096))
        except OSError:
            entered.set_result(b"")  # the terminal is gone

    loop.add_reader(line, ready)
    try:
        return await entered
    finally:
        loop.remove_reader(line)


async def console_confirm(text: str) -> bool:
    """Ask a yes/no question; the answer is no if no one is at the console."""
    import termios

    if not sys.stdin.isatty():
        return False
    line = sys.stdin.fileno()
    termios.tcflush(line, termios.TCIFLUSH)
    sys.stderr.write(f"\n>> {text}\n   type yes, or press Enter for no: ")
    sys.stderr.flush()
    return (await _entered(line)).strip().lower() in (b"y", b"yes")
