"""One interface for devices of all kinds: numbered samples of named values, in mm or degree C."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from typing import Protocol, TypeVar

from abbe.drivers.api import BallBar, BarBatch, Controller, DeviceInfo, DisplacementMeter, bar_is_valid, bar_reasons
from abbe.drivers.described.source import DeviceSource, physical
from abbe.drivers.device_file import DeviceFile
from abbe.drivers.errors import DeviceFault, DriverError

T = TypeVar("T")
MM_PER_COUNT = 1e-7
BAR_RATE_HZ = 100


@dataclass(frozen=True, slots=True)
class Sample:
    """Values at one moment. ``host_s``: arrival, ``device_s``: time by the device (NaN: it has no clock), ``number``: never wraps."""

    host_s: float
    device_s: float
    number: int
    values: Mapping[str, float]


class DeviceUnderTest(Protocol):
    """A device under test. ``moved``: names of its values that follow a motion; ``raw``: registers of its values, if it has any."""

    name: str
    moved: tuple[str, ...]

    async def identify(self) -> DeviceInfo: ...
    async def zero(self) -> None: ...
    async def sample(self, after: int | None) -> Sample: ...
    async def raw(self) -> Mapping[str, tuple[int, ...]]: ...
    async def close(self) -> None: ...


CALL_S = 10.0
"""Longest time that any call of a driver may take."""


class DriverDefect(Exception):  # noqa: N818 - what it says is not an error of the device
    """A driver broke a rule: a call never ended, or raised an error that is not in `abbe.drivers.errors`."""


async def watched(operation: str, call: Awaitable[T]) -> T:
    """Await a call of a driver.

    Raises
    ------
    DriverDefect
        The call had not ended after `CALL_S`, or raised an error that is not one of `abbe.drivers.errors`.
    """
    try:
        async with asyncio.timeout(CALL_S):
            return await call
    except DriverError:
        raise
    except TimeoutError:
        raise DriverDefect(f"{operation} had not ended after {CALL_S:g} s: the driver needs a time-out") from None
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise DriverDefect(f"{operation} raised {what}; only errors of abbe.drivers.errors are allowed") from error


class WatchedProbe:
    """Wraps another probe: each call of it is `watched`."""

    def __init__(self, probe: DeviceUnderTest) -> None:
        self._probe = probe
        self.name, self.moved = probe.name, probe.moved

    async def identify(self) -> DeviceInfo:
        return await watched("identify", self._probe.identify())

    async def zero(self) -> None:
        await watched("zero", self._probe.zero())

    async def sample(self, after: int | None) -> Sample:
        return await watched("read", self._probe.sample(after))

    async def raw(self) -> Mapping[str, tuple[int, ...]]:
        return await watched("read", self._probe.raw())

    async def close(self) -> None:
        await watched("close", self._probe.close())


class MeterProbe:
    """A displacement meter; its samples are those that a measurement would accept."""

    moved: tuple[str, ...] = ("displacement",)

    def __init__(self, meter: DisplacementMeter) -> None:
        self._meter = meter
        self.name: str = getattr(meter, "name", "meter")
        self.file: DeviceFile | None = getattr(meter, "file", None)

    async def identify(self) -> DeviceInfo:
        return await self._meter.identify()

    async def zero(self) -> None:
        await self._meter.clear_beam()
        await self._meter.set_environment_compensation(True)
        await self._meter.zero()

    async def sample(self, after: int | None) -> Sample:
        reading = await self._meter.read(after_count=after)
        timed = self.file is None or "time" in self.file.values
        device_s = reading.device_us * 1e-6 if timed else float("nan")
        return Sample(reading.host_s, device_s, reading.sample_count, {"displacement": reading.displacement_tenth_nm * MM_PER_COUNT})

    async def raw(self) -> Mapping[str, tuple[int, ...]]:
        return await raw_of(self._meter)

    async def close(self) -> None:
        await self._meter.close()


class ControlProbe:
    """A control; its samples are the positions that its status reports."""

    moved: tuple[str, ...] = ("x", "y", "z")

    def __init__(self, control: Controller) -> None:
        self._control = control
        self.name: str = getattr(control, "name", "control")
        self._number = 0

    async def identify(self) -> DeviceInfo:
        return await self._control.identify()

    async def zero(self) -> None:
        return

    async def sample(self, after: int | None) -> Sample:
        status = await self._control.status()
        self._number += 1
        return Sample(status.host_s, float("nan"), self._number, dict(zip("xyz", status.position_mm, strict=True)))

    async def raw(self) -> Mapping[str, tuple[int, ...]]:
        return await raw_of(self._control)

    async def close(self) -> None:
        await self._control.close()


class BarProbe:
    """A ball-bar's stream; a sample is the last one of the first batch that arrives after the request."""

    moved: tuple[str, ...] = ("radius",)

    def __init__(self, bar: BallBar) -> None:
        self._bar = bar
        self.name = bar.name
        self._open = AsyncExitStack()
        self._batches: AsyncIterator[BarBatch] | None = None

    async def identify(self) -> DeviceInfo:
        return await self._bar.identify()

    async def zero(self) -> None:
        return

    async def sample(self, after: int | None) -> Sample:
        try:
            if self._batches is None:
                self._batches = await self._open.enter_async_context(self._bar.stream(BAR_RATE_HZ))
            asked_s = time.monotonic()
            while (batch := await anext(self._batches)).host_s < asked_s:
                pass
        except DriverError:
            self._batches = None
            with suppress(DriverError):  # the first error says what happened
                await self._open.aclose()
            raise
        seq, device_us, reading_nm, status = batch.samples[-1]
        if not bar_is_valid(status):
            raise DeviceFault(self.name, "read", ", ".join(bar_reasons(status)), "mount the bar, then move into its range")
        return Sample(batch.host_s, device_us * 1e-6, seq, {"radius": reading_nm * 1e-6})

    async def raw(self) -> Mapping[str, tuple[int, ...]]:
        return {}

    async def close(self) -> None:
        self._batches = None
        with suppress(DriverError):
            await self._open.aclose()
        await self._bar.close()


class SourceProbe:
    """A described device of which only the values matter, such as a temperature logger."""

    moved: tuple[str, ...] = ()

    def __init__(self, file: DeviceFile, source: DeviceSource) -> None:
        self._file, self._source = file, source
        self.name = source.name

    async def identify(self) -> DeviceInfo:
        return await self._source.identify()

    async def zero(self) -> None:
        return

    async def sample(self, after: int | None) -> Sample:
        found = await self._source.snapshot()
        values = {name: physical(self._file, found.counts, name) for name in self._file.values}
        return Sample(found.host_s, float("nan"), found.number, values)

    async def raw(self) -> Mapping[str, tuple[int, ...]]:
        return (await self._source.snapshot()).words

    async def close(self) -> None:
        await self._source.close()


async def raw_of(device: object) -> Mapping[str, tuple[int, ...]]:
    """Return the registers of a described device's values, to try other byte orders; empty for other devices."""
    source: DeviceSource | None = getattr(device, "source", None)
    return {} if source is None else (await source.snapshot()).words
