"""The whole test of a device (`abbe device test`), and the abilities that follow from what it proved.

Among other faults, replies come late, twice, spoilt or not at all, and the connection is cut. Every reading must be right or refused, and
the readings must continue.
"""

from __future__ import annotations

import asyncio
import statistics
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from urllib.parse import urlsplit

from abbe.drivers.api import DeviceInfo
from abbe.drivers.conformance.checks import Ask, Move, identity, motion, quality, rate
from abbe.drivers.conformance.probe import (
    BarProbe,
    ControlProbe,
    DeviceUnderTest,
    DriverDefect,
    MeterProbe,
    Sample,
    SourceProbe,
    WatchedProbe,
    watched,
)
from abbe.drivers.conformance.proxy import Fault, Proxy
from abbe.drivers.described.control import ListenedControl
from abbe.drivers.described.meter import DescribedMeter
from abbe.drivers.described.opening import Described, described, open_source
from abbe.drivers.described.tested import Ability, CheckVerdict, DeviceCheck, TestReport
from abbe.drivers.device_file import DeviceFile
from abbe.drivers.errors import BadUrl, DriverError
from abbe.drivers.links.urls import (
    DeviceUrl,
    FixtureConsoleUrl,
    FixtureTcpUrl,
    ModbusRtuUrl,
    SocketUrl,
    described_by,
    installed,
    parse_url,
    split_report,
)
from abbe.drivers.registry import open_ballbar, open_controller, open_laser

TRIES = 6
"""Number of readings requested around each fault."""
RECOVERS_S = 15.0
"""Longest time until a reading is right again."""
PAUSE_S = 0.2
AT_REST, NOISES = 10, 10.0
"""Readings before the first fault; largest difference of a right reading from their mean, in their standard deviations."""


@dataclass(frozen=True, slots=True)
class _Rest:
    """Readings of a device at rest: number of the last one, mean values, and the tolerance of a right reading."""

    number: int
    values: Mapping[str, float]
    close: Mapping[str, float]

    def off(self, sample: Sample) -> dict[str, float]:
        """Return the values of a sample that differ too much from the values at rest."""
        return {key: value for key, value in sample.values.items() if not abs(value - self.values[key]) <= self.close[key]}


async def faults(open_at: Callable[[], Awaitable[DeviceUnderTest]], proxy: Proxy, close_mm: float) -> list[DeviceCheck]:
    """Play every fault to a device at rest.

    Parameters
    ----------
    open_at : callable
        Opens the device behind the proxy.
    close_mm : float
        Smallest tolerance of a reading at rest about the mean, mm or degree C; noise widens the tolerance.
    """
    try:
        probe = await open_at()
    except (DriverError, DriverDefect) as error:
        return [DeviceCheck("replies", CheckVerdict.FAILED, f"the device cannot be opened behind a proxy: {error}")]
    try:
        await probe.zero()
        base = await _rest(probe, close_mm)
        found = [await _played(probe, proxy, fault, base) for fault in Fault if fault is not Fault.CUT or proxy.cuts]
        return (
            found
            if proxy.cuts
            else [*found, DeviceCheck(Fault.CUT.value, CheckVerdict.NOT_PROVED, "a serial line has no connection to cut: pull its plug")]
        )
    except (DriverError, DriverDefect) as error:
        return [DeviceCheck("replies", CheckVerdict.FAILED, str(error))]
    finally:
        await _closed(probe)


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
        except DriverDefect as defect:
            return DeviceCheck(name, CheckVerdict.FAILED, str(defect))
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
        name, CheckVerdict.PASSED, f"refused ({refused}), {took}" if refused else "the link overcame the fault: every reading was right"
    )


async def _closed(probe: DeviceUnderTest) -> None:
    """Close a device. Ignore defects of its driver: they were found before, or affect no reading."""
    with suppress(DriverDefect):
        await probe.close()


async def _rest(probe: DeviceUnderTest, least: float) -> _Rest:
    taken: list[Sample] = []
    for _ in range(AT_REST):
        taken.append(await probe.sample(taken[-1].number if taken else None))
    columns = {key: [sample.values[key] for sample in taken] for key in taken[0].values}
    close = {key: max(least, NOISES * statistics.pstdev(values)) for key, values in columns.items()}
    return _Rest(taken[-1].number, {key: statistics.fmean(values) for key, values in columns.items()}, close)


async def _zeroed(probe: DeviceUnderTest) -> None:
    """Zero the device again: a new connection may lose the zero. A device that does not answer is asked again by the next reading."""
    try:
        await probe.zero()
    except DriverError:
        return


LATE_SHARE = 1.5
"""A late reply comes after this many reply timeouts."""
OWN_TIMEOUT_S = 1.0
AT_REST_MM = 0.002
_METER, _CONTROL = ("motion displacement",), ("motion x", "motion y", "motion z")
MOTIONS = {"displacement": _METER, "laser": _METER, "ballbar": ("motion radius",), "position": _CONTROL, "cnc": _CONTROL}
"""By kind or role of a device: the checks of a known motion that must pass before a measurement may use its readings."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a device test. ``role``: laser, ballbar or cnc, for a device with a driver; ``move``, ``ask``: None if no person helps."""

    role: str = "laser"
    move: Move | None = None
    ask: Ask | None = None
    faults: bool = True


async def device_test(text: str, options: Options, utc: str) -> TestReport:
    """Test the device behind a URL.

    Parameters
    ----------
    text : str
        The URL; a report named in it is ignored.
    utc : str
        Present time, ISO 8601, for the report.

    Raises
    ------
    BadUrl, BadDeviceFile
        The device cannot even be tried.
    WrongDevice, LinkDown, ReplyTimeout, BadFrame, DeviceFault
        Another device answers, or none: there is nothing to test.
    """
    text, _ = split_report(text)
    about = None if installed(text) is not None or not described_by(parse_url(text)) else described(parse_url(text))
    file = None if about is None else about.file
    open_direct = _opener(text, about, options.role)
    info, found = DeviceInfo(options.role, "", "", 0, ""), list[DeviceCheck]()
    probe: DeviceUnderTest | None = None
    try:
        probe = await open_direct()
        info = await probe.identify()
        found += [*await identity(probe, file), *await rate(probe, file)]
        if any(one.verdict is CheckVerdict.FAILED for one in found):
            return _report(text, about, options.role, info, found, utc)
        if options.ask is not None and options.move is not None:
            found += await motion(probe, file, options.move, options.ask)
            found += [await quality(probe, file, options.ask)] if "displacement" in probe.moved else []
        else:
            found += [DeviceCheck(f"motion {name}", CheckVerdict.NOT_PROVED, "no known motion was made (--move)") for name in probe.moved]
    except DriverDefect as defect:
        return _report(text, about, options.role, info, [*found, DeviceCheck("driver", CheckVerdict.FAILED, str(defect))], utc)
    finally:
        if probe is not None:
            await _closed(probe)
    if about is not None and not isinstance(about.url, ModbusRtuUrl):
        found.append(
            DeviceCheck("check sum", CheckVerdict.NOT_PROVED, "its replies carry no check sum: a corrupted digit cannot be detected")
        )
    if options.faults:
        found += await _faults(text, about, options.role)
    return _report(text, about, options.role, info, found, utc)


def _report(text: str, about: Described | None, role: str, info: DeviceInfo, found: list[DeviceCheck], utc: str) -> TestReport:
    kind = role if about is None else about.file.kind
    return TestReport(
        text, kind, info.model, info.serial_no, "" if about is None else about.sha256, utc,
        abilities(kind, tuple(found)), tuple(found),
    )  # fmt: skip


def abilities(kind: str, found: tuple[DeviceCheck, ...]) -> tuple[Ability, ...]:
    """Return the abilities that the findings of a device's test prove: none after a failed check.

    `DWELL` needs proof of freshness and of a known motion (of every axis for a control). The test of a device file never proves motion or
    tables: only a driver and `abbe comp commission` do.
    """
    if any(one.verdict is CheckVerdict.FAILED for one in found):
        return ()
    passed = {one.check for one in found if one.verdict is CheckVerdict.PASSED}
    needed = MOTIONS.get(kind, ())
    counts = bool(needed) and {"freshness", *needed} <= passed
    return (Ability.WATCH, Ability.DWELL) if counts else (Ability.WATCH,)


def summary(report: TestReport) -> str:
    """Return the abilities of the device in one line."""
    if report.failed:
        return "the device cannot be used; failed: " + "; ".join(one.check for one in report.failed)
    if Ability.DWELL in report.abilities:
        return "the device can measure while the axes stand still, in an operator's NC program or in a motion that Abbe commands"
    return "the device can be watched, but not used to measure; not proved: " + "; ".join(
        one.check for one in report.findings if one.verdict is CheckVerdict.NOT_PROVED
    )


def _opener(text: str, about: Described | None, role: str) -> Callable[[], Awaitable[DeviceUnderTest]]:
    if about is not None:
        return lambda: _probe_of(about.url, about.file)

    async def by_driver() -> DeviceUnderTest:
        if role == "laser":
            return WatchedProbe(MeterProbe(await watched("open", open_laser(text))))
        if role == "cnc":
            return WatchedProbe(ControlProbe(await watched("open", open_controller(text))))
        if role == "ballbar":
            return WatchedProbe(BarProbe(await watched("open", open_ballbar(text))))
        raise BadUrl(ascii(text), "test device", f"there is no test for the role {role!r}", "use laser, ballbar or cnc")

    return by_driver


async def _probe_of(url: DeviceUrl, file: DeviceFile) -> DeviceUnderTest:
    source = await open_source(url, file)
    if file.kind == "displacement":
        return MeterProbe(DescribedMeter(file, source))
    return ControlProbe(ListenedControl(file, source)) if file.kind == "position" else SourceProbe(file, source)


async def _faults(text: str, about: Described | None, role: str) -> list[DeviceCheck]:
    """Test the device behind a proxy. The proxy needs the device's serial line, or its host and port."""
    table = None if about is None else about.file.modbus or about.file.line
    proxy = Proxy(LATE_SHARE * (OWN_TIMEOUT_S if table is None else table.timeout_s))
    limits = None if about is None else about.file.limits
    close_mm = max(AT_REST_MM, 6e-3 * (limits.u or 0.0) if limits is not None else 0.0)
    try:
        if installed(text) is not None:
            parts = urlsplit(text)
            if not parts.hostname or not parts.port:
                return [DeviceCheck("replies", CheckVerdict.NOT_PROVED, "its URL has no host and port, so no proxy can stand before it")]
            front = await proxy.front(SocketUrl(parts.hostname, parts.port))
            opener = _opener(parts._replace(netloc=f"{front.host}:{front.port}").geturl(), None, role)
        else:
            url = parse_url(text) if about is None else about.url
            if isinstance(url, FixtureTcpUrl | FixtureConsoleUrl):
                raise BadUrl(ascii(text), "test device", "a fixture has no test", "test laser, ballbar and cnc")
            there = await proxy.front(url)
            opener = _opener(str(there), None if about is None else Described(there, about.file, about.sha256), role)
        return await faults(opener, proxy, close_mm)
    except DriverError as error:
        return [DeviceCheck("replies", CheckVerdict.FAILED, str(error))]
    finally:
        await proxy.close()
