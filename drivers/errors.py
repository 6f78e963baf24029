"""Errors of the wire. Each names the device, what was tried, what happened and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

NO_RUN = "no run"
_RUN: ContextVar[str] = ContextVar("run", default=NO_RUN)


@contextmanager
def on_behalf_of(run: str) -> Iterator[None]:
    """Name the run that everything in this block (and in tasks started in it) happens for: its errors and records say so."""
    token = _RUN.set(run)
    try:
        yield
    finally:
        _RUN.reset(token)


class DriverError(Exception):
    """A device could not do what was asked.

    Parameters
    ----------
    device : str
        Name or URL of the device as the user wrote it.
    operation : str
        What was being tried, e.g. ``"read status"``.
    detail : str
        What happened.
    remedy : str, optional
        What a person can do about it.

    Attributes
    ----------
    run : str
        The run that it happened to (``on_behalf_of``).
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
    """The device URL cannot be understood."""

    code = "DRV-001"


class LinkDown(DriverError):
    """The port cannot be opened, or the peer has gone."""

    code = "DRV-002"
    retryable = True


class ReplyTimeout(DriverError, TimeoutError):
    """The device did not answer in time."""

    code = "DRV-003"
    retryable = True


class BadFrame(DriverError):
    """Bytes arrived that are not a frame of the protocol, or a reply that does not answer the request."""

    code = "DRV-004"


class WrongDevice(DriverError):
    """Canary registers, map version or identity are not what the protocol demands."""

    code = "DRV-005"


class DeviceFault(DriverError):
    """The device reports a fault of its own: alarm, beam lost, bar out of range."""

    code = "DRV-006"


class Refused(DriverError):
    """The device understood and refused: interlock, stroke limit, lease, compare-and-swap."""

    code = "DRV-007"


class Rebooted(DriverError):
    """The device restarted (new boot id): nothing measured before may be joined to what comes after."""

    code = "DRV-008"


class Backpressure(DriverError):
    """This computer does not keep up with the device: the motion is stopped before a sample is lost."""

    code = "DRV-009"


class SettingsChanged(DriverError):
    """The device's own settings (unit, range, zero) are not those that were accepted: readings before and after must not be joined."""

    code = "DRV-010"


class LossyLine(DriverError):
    """More than 0.1 % of the samples of a run were lost on the line: what is left is too little to be trusted."""

    code = "DRV-011"
