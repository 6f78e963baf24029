"""Asking the person at the console, without stopping the event loop."""

from __future__ import annotations

import asyncio
import sys

from service.errors import ConfigError


async def console_ask(text: str) -> None:
    """Print what to do and wait for Enter.

    Raises
    ------
    ConfigError
        Nobody is at the console (standard input is closed or not a terminal).
    """
    if not sys.stdin.isatty():
        raise ConfigError(f"nobody is at the console to: {text}", "run this from a terminal, or configure a remote fixture")
    sys.stderr.write(f"\n>> {text}\n   press Enter when done: ")
    sys.stderr.flush()
    loop = asyncio.get_running_loop()
    entered: asyncio.Future[str] = loop.create_future()

    def ready() -> None:
        if not entered.done():
            entered.set_result(sys.stdin.readline())

    loop.add_reader(sys.stdin, ready)
    try:
        if await entered == "":
            raise ConfigError("standard input was closed", "start again from a terminal")
    finally:
        loop.remove_reader(sys.stdin)
