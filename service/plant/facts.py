"""What OPC UA and MTConnect show of the machine at one moment."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.verification import Verification
from abbe.service.verification.verified_by import VerifiedBy


@dataclass(frozen=True, slots=True)
class PlantUnit:
    """A unit: how it is written, its UNECE code (OPC UA), and its name in MTConnect with the factor to it."""

    symbol: str
    unece: str
    mtconnect: str = ""
    factor: float = 1.0

    @property
    def number(self) -> int:
        """UNECE code as OPC UA numbers it (Part 8, 5.6.3.3): its characters, one a byte."""
        return int.from_bytes(self.unece.encode(), "big")


UNITS = {
    "um": PlantUnit("µm", "4H", "MILLIMETER", 1e-3),
    "mm": PlantUnit("mm", "MMT", "MILLIMETER"),
    "urad": PlantUnit("µrad", "B97"),
    "ppm": PlantUnit("ppm", "59"),
    "s": PlantUnit("s", "SEC", "SECOND"),
    "c": PlantUnit("°C", "CEL", "CELSIUS"),
    "percent": PlantUnit("%", "P1", "PERCENT"),
}


def unit_of(key: str) -> PlantUnit | None:
    """PlantUnit of a figure, which stands at the end of its name; None: it has none."""
    return UNITS.get(key.rpartition("_")[2]) if "_" in key else None


@dataclass(frozen=True, slots=True)
class PlantAlarm:
    """Something a person should look at."""

    code: str
    text: str
    at_utc: datetime
    device: str = ""


@dataclass(frozen=True, slots=True)
class ActiveTable:
    """Which compensation table the push journal knows to be active. It is what we last saw, not a question to the controller."""

    bank: int
    crc: int
    push: int
    since_utc: datetime


@dataclass(frozen=True, slots=True)
class PlantFacts:
    """Everything at one moment; checks and alarms newest first. ``table``: None when the journal does not know; ``verified``: which
    measurement stands behind it, None: not known here."""

    machine: str
    version: str
    now_utc: datetime
    running: RunningCheck | None
    next_utc: datetime | None
    checks: tuple[Verification, ...]
    alarms: tuple[PlantAlarm, ...]
    devices: tuple[DeviceStatus, ...]
    table: ActiveTable | None = None
    verified: VerifiedBy | None = None

    @property
    def verdict(self) -> str | None:
        """Of the last check, where it is of the table in force; else whether anything measured that table. None: no check yet."""
        if self.verified is not None and not self.verified.holds:
            return self.verified.state
        return self.checks[0].verdict if self.checks else None

    @property
    def state(self) -> str:
        """``measuring`` or ``idle``."""
        return "idle" if self.running is None else "measuring"


class FactsSource(Protocol):
    """Where the facts come from. Reads only."""

    async def facts(self) -> PlantFacts:
        """Return the facts of this moment.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        ...
