"""Replies that come late, twice, spoilt or not at all, and a cut connection: every reading is right or refused, and they go on."""

from __future__ import annotations

import asyncio
import statistics
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from abbe.drivers.conformance.probe import DeviceUnderTest, Sample
from abbe.drivers.conformance.proxy import Fault, Proxy
from abbe.drivers.described.tested import CheckVerdict, DeviceCheck
from abbe.drivers.errors import DriverError

TRIES = 6
"""Readings around each fault."""
RECOVERS_S = 15.0
"""Longest time until a reading is right again."""
PAUSE_S = 0.2
AT_REST, NOISES = 10, 10.0
"""Readings before the first fault, and how many of their standard deviations a right reading may be off."""


@dataclass(frozen=True, slots=True)
class _Rest:
    """What a device reads at rest: number of the last reading, mean values, and how far from them a right reading may be."""

    number: int
    values: Mapping[str, float]
    close: Mapping[str, float]

    def off(self, sample: Sample) -> dict[str, float]:
        """Values of a sample that cannot be those at rest."""
        return {key: value for key, value in sample.values.items() if not abs(value - self.values[key]) <= self.close[key]}


async def faults(open_at: Callable[[], Awaitable[DeviceUnderTest]], proxy: Proxy, close_mm: float) -> list[DeviceCheck]:
    """Play every fault to a device at rest.

    Parameters
    ----------
    open_at : callable
        Opens the device behind the proxy.
    close_mm : float
        How far from the mean a right reading at rest may be at least, mm or degree C; noise widens it.
    """
    try:
        probe = await open_at()
    except DriverError as error:
        return [DeviceCheck("replies", CheckVerdict.FAILED, f"the device cannot be opened behind a proxy: {error}")]
    try:
        await probe.zero()
        base = await _rest(probe, close_mm)
        found = [await _played(probe, proxy, fault, base) for fault in Fault if fault is not Fault.CUT or proxy.cuts]
        return (
            found
            if proxy.cuts
            else [*found, DeviceCheck(Fault.CUT.value, CheckVerdict.NOT_PROVED, "a serial line has none: pull its plug")]
        )
    except DriverError as error:
        return [DeviceCheck("replies", CheckVerdict.FAILED, str(error))]
    finally:
        await probe.close()


async def _played(probe: DeviceUnderTest, proxy: Proxy, fault: Fault, base: _Rest) -> DeviceCheck:
    name, before, refused, number = f"reply {fault.value}" if fault is not Fault.CUT else fault.value, proxy.done, "", base.number
    clock = asyncio.get_running_loop().time
    begun_s, good = clock(), 0
    proxy.fault = fault
    while good < TRIES or proxy.done == before:
        if clock() - begun_s > RECOVERS_S:
            return DeviceCheck(name, CheckVerdict.FAILED, f"no right reading within {RECOVERS_S:g} s; the last error: {refused or 'none'}")
        try:
            sample = await probe.sample(number)
        except DriverError as error:
            refused, good = f"{type(error).__name__}: {error.detail}", 0
            await asyncio.sleep(PAUSE_S)
            await _zeroed(probe)
            continue
        if off := base.off(sample):
            return DeviceCheck(name, CheckVerdict.FAILED, f"a wrong reading passed as right: {off}, at rest it was {dict(base.values)}")
        number, good = sample.number, good + 1
    took = f"right again after {clock() - begun_s:.1f} s"
    return DeviceCheck(
        name, CheckVerdict.PASSED, f"refused ({refused}), {took}" if refused else "overcome by the link: every reading was right"
    )


async def _rest(probe: DeviceUnderTest, least: float) -> _Rest:
    taken: list[Sample] = []
    for _ in range(AT_REST):
        taken.append(await probe.sample(taken[-1].number if taken else None))
    columns = {key: [sample.values[key] for sample in taken] for key in taken[0].values}
    close = {key: max(least, NOISES * statistics.pstdev(values)) for key, values in columns.items()}
    return _Rest(taken[-1].number, {key: statistics.fmean(values) for key, values in columns.items()}, close)


async def _zeroed(probe: DeviceUnderTest) -> None:
    """After a new connection a zero may be lost; a device that is still silent is asked again by the next reading."""
    try:
        await probe.zero()
    except DriverError:
        return
