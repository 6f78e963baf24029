"""Motion never outlives the block that commanded it; and when the stop does not get through, the person at the machine is told."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from abbe.drivers.api import Motion
from abbe.drivers.errors import DriverError
from abbe.drivers.links.shielded import run_to_end
from abbe.service.errors import AbbeError

STOP_S = 10.0
"""Outer bound only. The driver's own limits govern: seconds for each write, five until the axes stand still."""
Spare = Callable[[], Awaitable[bool]]
UNDELIVERED = "the stop could not be delivered: press e-stop"


@asynccontextmanager
async def motion_guard(controller: Motion, spare: Spare | None = None) -> AsyncIterator[None]:
    """Whatever ends this block early also stops the axes: abort is sent although the task is being cancelled.

    Parameters
    ----------
    spare : callable, optional
        Says that nothing of ours can move and somebody else works with the machine: then it is left alone.

    Raises
    ------
    BaseException
        What ended the block. When the stop did not get through, its text says so: the axes may still move.
    """
    try:
        yield
    except BaseException as error:
        stopped = asyncio.Event()
        try:
            await run_to_end(_stop(controller, stopped, spare))
        except asyncio.CancelledError as cancelled:
            if stopped.is_set():
                raise
            raise with_warning(cancelled) from error
        if stopped.is_set():
            raise
        told = with_warning(error)
        if told is error:
            raise
        raise told from error


async def _stop(controller: Motion, stopped: asyncio.Event, spare: Spare | None) -> None:
    try:
        async with asyncio.timeout(STOP_S):
            if spare is None or not await spare():
                await controller.abort()
    except Exception:  # noqa: BLE001 - why it failed is not what matters now: that the axes may run on is, and the caller says so
        return
    stopped.set()


def with_warning(error: BaseException) -> BaseException:
    """The same kind of error, saying as well that the axes may still move; errors without a text for people get a note."""
    if isinstance(error, AbbeError | DriverError):
        if UNDELIVERED in error.detail:
            return error
        detail = f"{error.detail}; {UNDELIVERED}"
        if isinstance(error, DriverError):
            return type(error)(error.device, error.operation, detail, error.remedy)
        return type(error)(detail, error.remedy)
    if UNDELIVERED not in warnings_of(error):
        error.add_note(UNDELIVERED)
    return error


def warnings_of(error: BaseException) -> list[str]:
    """What was added to an error on its way up."""
    return list(getattr(error, "__notes__", []))
