"""Facts of the machine that OPC UA and MTConnect show."""

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
    """A unit: its symbol, its UNECE code (OPC UA), and its name in MTConnect with the conversion factor."""

    symbol: str
    unece: str
    mtconnect: str = ""
    factor: float = 1.0

    @property
    def number(self) -> int:
        """UNECE code as a number of OPC UA (Part 8, 5.6.3.3): its characters, one a byte."""
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
    """Return the unit at the end of a figure's name; None: it has none."""
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
    """The active compensation table by the push journal: the last known one, the controller is not asked."""

    bank: int
    crc: int
    push: int
    since_utc: datetime


@dataclass(frozen=True, slots=True)
class PlantFacts:
    """Facts of one instant; checks and alarms newest first. ``table``: None when the journal does not know; ``verified``: which
    measurement verified it, None: unknown."""

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
        """Verdict of the last check, if that is about the table in force; else the state of that table. None: no check yet."""
        if self.verified is not None and not self.verified.holds:
            return self.verified.state
        return self.checks[0].verdict if self.checks else None

    @property
    def state(self) -> str:
        """``measuring`` or ``idle``."""
        return "idle" if self.running is None else "measuring"


class FactsSource(Protocol):
    """Source of the facts. Reads only."""

    async def facts(self) -> PlantFacts:
        """Return the current facts.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        ...
