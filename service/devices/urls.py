"""Where the devices of a machine are: known also to those who have no way to them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DeviceUrls:
    """Where the devices of a machine are; None: not connected."""

    cnc: str | None = None
    ballbar: str | None = None
    laser: str | None = None
    fixture: str | None = None
