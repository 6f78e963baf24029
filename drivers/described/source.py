"""Parts common to all described devices: a coherent set of counts, its interpretation by the device file, and the request for it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from abbe.drivers.api import DeviceInfo
from abbe.drivers.described.registers import ours, scaled
from abbe.drivers.device_file import Command, DeviceFile, Flag
from abbe.drivers.links.incidents import Incidents


@dataclass(frozen=True, slots=True)
class CountSnapshot:
    """Counts of one reply or line, by name of the value.

    ``number``: counts the replies or lines since the device was opened. ``words``: Modbus registers of each value, to test the byte order.
    ``host_s``: arrival, monotonic host seconds. ``epoch``: changes with each new connection after which the device may have restarted.
    """

    host_s: float
    number: int
    counts: Mapping[str, float]
    words: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    epoch: int = 0


class DeviceSource(Protocol):
    """The wire of a described device. Its methods raise the same errors as `abbe.drivers.described.modbus_source.ModbusSource`."""

    name: str
    incidents: Incidents

    async def identify(self) -> DeviceInfo: ...
    async def snapshot(self) -> CountSnapshot: ...
    async def command(self, command: Command, operation: str) -> None: ...
    async def close(self) -> None: ...


def physical(file: DeviceFile, counts: Mapping[str, float], name: str) -> float:
    """Return a value in our unit (mm, degree C, Pa, s, %, permille); NaN if the file does not describe it."""
    return ours(file.values[name], counts[name]) if name in file.values else float("nan")


def meanings(file: DeviceFile, counts: Mapping[str, float]) -> frozenset[str]:
    """Return the meanings of all flags that hold."""
    return frozenset(flag.means for flag in file.flags if _holds(file, flag, counts[flag.value]))


def _holds(file: DeviceFile, flag: Flag, count: float) -> bool:
    if flag.bit is not None:
        return bool(int(count) >> flag.bit & 1) is flag.set
    value = scaled(file.values[flag.value], count)
    return (flag.below is not None and value < flag.below) or (flag.above is not None and value > flag.above)


class RequestPacer:
    """Limits requests to ``rate_hz`` per second: a device that is asked faster may answer wrongly, or not at all."""

    def __init__(self, rate_hz: float) -> None:
        self._apart_s = 1.0 / rate_hz
        self._next_s = float("-inf")

    async def turn(self) -> None:
        """Wait until the next request is allowed."""
        clock = asyncio.get_running_loop().time
        await asyncio.sleep(max(0.0, self._next_s - clock()))
        self._next_s = clock() + self._apart_s
