"""Numbered commands: written exactly once, then decided by the device's acknowledge register, never by guessing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from abbe.drivers.errors import BadFrame, DriverError, LinkDown, ReplyTimeout

_POLL_S = 0.005


def next_number(acknowledged: int) -> int:
    """Return the only number the device will execute next (mod 65536)."""
    return (acknowledged + 1) & 0xFFFF


async def run_numbered(
    device: str,
    operation: str,
    number: int,
    write: Callable[[], Awaitable[None]],
    read_ack: Callable[[], Awaitable[tuple[int, int]]],
    *,
    settle_s: float = 1.0,
) -> int:
    """Write a numbered command once and find out what became of it.

    Parameters
    ----------
    device, operation : str
        For the error text.
    number : int
        The number inside the command, ``next_number(last acknowledged)``.
    write, read_ack : callable
        Sends the command (called exactly once); reads (acknowledged number, result code).
    settle_s : float
        How long an acknowledge may take.

    Returns
    -------
    int
        The device's result code.

    Raises
    ------
    ReplyTimeout, LinkDown, BadFrame
        The write got no valid reply and the device's acknowledge says that it was not executed, or nothing could be read at all.
    """
    doubt: DriverError | None = None
    try:
        await write()
    except (ReplyTimeout, LinkDown, BadFrame) as error:
        doubt = error
    acknowledged, result = await _last_ack(number, read_ack, settle_s)
    if acknowledged == number:
        return result
    if doubt is not None:
        doubt.add_note(f"asked afterwards, the device says that command {number} was not executed (last executed: {acknowledged})")
        raise doubt
    detail = f"command {number} is not acknowledged (last executed: {acknowledged})"
    raise ReplyTimeout(device, operation, detail, "is another program sending commands to this device?")


async def _last_ack(number: int, read_ack: Callable[[], Awaitable[tuple[int, int]]], settle_s: float) -> tuple[int, int]:
    clock = asyncio.get_running_loop().time
    until = clock() + settle_s
    while True:
        acknowledged, result = await read_ack()
        if acknowledged == number or clock() >= until:
            return acknowledged, result
        await asyncio.sleep(_POLL_S)
