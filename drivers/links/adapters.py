"""Serial adapters by what they are, not by the number the system gave them: ``ttyUSB0`` may be another one after the next plugging."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from abbe.drivers.errors import LinkDown, WrongDevice


@dataclass(frozen=True, slots=True)
class Adapter:
    """A serial adapter as the system lists it. ``node`` is where it is now; kind and serial number are what it is."""

    node: str
    kind: str
    serial_number: str

    def __str__(self) -> str:
        return f"{self.kind} {self.serial_number}"


def adapter_at(path: str, listed: Sequence[Adapter]) -> Adapter | None:
    """The adapter behind a path (links are followed); None when it has no serial number, so that nobody could know it again."""
    real = os.path.realpath(path)
    found = [adapter for adapter in listed if os.path.realpath(adapter.node) == real]
    return found[0] if found and found[0].serial_number else None


def path_to_open(device: str, path: str, known: Adapter | None, listed: Sequence[Adapter]) -> str:
    """Say which path leads to the adapter that was there before.

    Parameters
    ----------
    device : str
        For the error text.
    path : str
        What the configuration says; a link by id stays right by itself.
    known : Adapter or None
        The adapter that was opened last; None when nothing was, or it cannot be known again.
    listed : sequence of Adapter
        What is plugged in now.

    Raises
    ------
    LinkDown
        The adapter is not plugged in.
    WrongDevice
        It is not, and another one is where it was.
    """
    if known is None:
        return path
    for adapter in listed:
        if (adapter.kind, adapter.serial_number) == (known.kind, known.serial_number):
            return adapter.node
    other = adapter_at(path, listed)
    if other is not None:
        raise WrongDevice(device, "open", f"adapter {other} is there instead of {known}", "plug the right adapter in")
    raise LinkDown(device, "open", f"adapter {known} is not plugged in", "plug it in, at any socket of this computer")
