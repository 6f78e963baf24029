"""Clean-up that must reach the device although its caller was cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


async def run_to_end(work: Coroutine[Any, Any, T]) -> T:
    """Run a short piece of clean-up to its end, however often the caller is cancelled meanwhile.

    Parameters
    ----------
    work : coroutine
        Must carry its own timeout: nothing else can end it.

    Returns
    -------
    T
        What the work returned.

    Raises
    ------
    asyncio.CancelledError
        After the work has ended, when the caller was cancelled in between: a cancellation is delayed, never swallowed.
    """
    task = asyncio.ensure_future(work)
    interrupted: asyncio.CancelledError | None = None
    while not task.done():
        try:
            # wait() leaves the task alone when we are cancelled; awaiting the task itself would cancel it
            await asyncio.wait([task])
        except asyncio.CancelledError as error:
            interrupted = error
    if interrupted is not None:
        if not task.cancelled():
            task.exception()  # marks it as seen: the cancellation is what the caller has to hear about
        raise interrupted
    return task.result()
