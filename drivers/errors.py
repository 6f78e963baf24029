"""Errors of devices and links: each names device, operation, event and remedy. This module also runs clean-up despite cancellation."""

from __future__ import annotations

from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import asyncio

NO_RUN = "no run"
_RUN: ContextVar[str] = ContextVar("run", default=NO_RUN)


@contextmanager
def on_behalf_of(run: str) -> Iterator[None]:
    """Attach a run's name to all driver errors created in this block, including those of tasks started in it."""
    token = _RUN.set(run)
    try:
        yield
    finally:
        _RUN.reset(token)


class DriverError(Exception):
    """A device operation failed.

    ``device``: its name or URL; ``operation``: e.g. ``"read status"``; ``detail``: what happened; ``remedy``: what a person should do;
    ``run``: the affected run (`on_behalf_of`).
    """

    code = "DRV-000"
    retryable = False

    def __init__(self, device: str, operation: str, detail: str, remedy: str = "") -> None:
        self.device = device
        self.operation = operation
        self.detail = detail
        self.remedy = remedy
        self.run = _RUN.get()
        super().__init__(f"{device}: {operation}: {detail}" + (f" ({remedy})" if remedy else ""))


class BadUrl(DriverError):
    """The device URL is not valid."""

    code = "DRV-001"


class LinkDown(DriverError):
    """The port cannot be opened, or the connection was lost."""

    code = "DRV-002"
    retryable = True


class ReplyTimeout(DriverError, TimeoutError):
    """The device did not answer in time."""

    code = "DRV-003"
    retryable = True


class BadFrame(DriverError):
    """Bytes arrived that are not a frame of the protocol, or a reply that does not match the request."""

    code = "DRV-004"


class WrongDevice(DriverError):
    """Canary registers, map version or identity do not match the protocol."""

    code = "DRV-005"


class DeviceFault(DriverError):
    """The device reports a fault of its own: alarm, beam lost, bar out of range."""

    code = "DRV-006"


class Refused(DriverError):
    """The device refused a valid request: interlock, stroke limit, lease, compare-and-swap."""

    code = "DRV-007"


class Rebooted(DriverError):
    """The device restarted (new boot id): data before and after must not be joined."""

    code = "DRV-008"


class Backpressure(DriverError):
    """This computer does not keep up with the device: the motion stops before a sample is lost."""

    code = "DRV-009"


class SettingsChanged(DriverError):
    """The device's settings (unit, range, zero) changed: readings before and after must not be joined."""

    code = "DRV-010"


class LossyLine(DriverError):
    """The line lost more than 0.1 % of the samples of a run: the rest is not reliable."""

    code = "DRV-011"


class BadDeviceFile(DriverError):
    """A device file is missing, unreadable, or contradicts itself."""

    code = "DRV-012"


class NotProved(DriverError):
    """Neither the device file nor the report of its test proves an ability that the job needs."""

    code = "DRV-013"


T = TypeVar("T")


async def run_to_end(work: Coroutine[Any, Any, T]) -> T:
    """Run a short clean-up to its end, regardless of cancellations, and return its result.

    ``work`` must have its own timeout: nothing else can end it.

    Raises
    ------
    asyncio.CancelledError
        Raised after the end of the work if the caller was cancelled meanwhile: a cancellation is delayed, never swallowed.
    """
    import asyncio  # with sockets and TLS; a command that only reads knows these errors, too

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
