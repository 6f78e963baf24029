"""Clean-up that must reach the device even if its caller is cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


async def run_to_end(work: Coroutine[Any, Any, T]) -> T:
    """Run a short clean-up to its end, regardless of cancellations, and return its result.

    ``work`` must have its own timeout: nothing else can end it.

    Raises
    ------
    asyncio.CancelledError
        After the end of the work, if the caller was cancelled during it: a cancellation is delayed, never swallowed.
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
            task.exception()  # marks it as retrieved: the caller gets the cancellation instead
        raise interrupted
    return task.result()
