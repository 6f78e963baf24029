"""The checks of a device test. Each returns findings; faults of the device raise no errors."""

from __future__ import annotations

import asyncio
import math
import statistics
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from itertools import pairwise

from abbe.drivers.conformance.probe import DeviceUnderTest, Sample
from abbe.drivers.described.meter import INVALID
from abbe.drivers.described.registers import ORDERS, decode, ours
from abbe.drivers.described.tested import CheckVerdict, DeviceCheck
from abbe.drivers.device_file import SIZE, DeviceFile
from abbe.drivers.errors import DriverError

Ask = Callable[[str], Awaitable[object]]
PASSED, FAILED, NOT_PROVED = CheckVerdict.PASSED, CheckVerdict.FAILED, CheckVerdict.NOT_PROVED
SAMPLES = 10
"""Least number of readings at rest, and least time over which these readings are taken, s."""
AVERAGED, SETTLED_S = 3, 0.3
WATCHED_S = 1.0
BUFFERED_S = 5.0
"""A reading may have arrived at most this long before it was requested, s."""
CLOCK_FACTOR = 2.0
"""In a test of one second the device's clock may run faster or slower than this computer's by this factor; a wrong unit gives 1000."""
FACTORS = (
    (25.4, "it sends mm, the file says inches"),
    (1.0 / 25.4, "it sends inches, the file says mm"),
    (1e3, "the unit is 1000 times too large"),
    (1e-3, "the unit is 1000 times too small"),
    (2.0, "an interferometer that counts the path there and back?"),
    (0.5, "half of the path?"),
    (10.0, "the decimal point is one place off"),
    (0.1, "the decimal point is one place off"),
)


@dataclass(frozen=True, slots=True)
class Move:
    """A motion of known length, mm, and how exactly it is known (half-width, mm)."""

    mm: float
    tolerance_mm: float


async def identity(probe: DeviceUnderTest, file: DeviceFile | None) -> list[DeviceCheck]:
    """Identify twice: both answers must agree. Not proved if nothing in the device file identifies the device."""
    try:
        first, second = await probe.identify(), await probe.identify()
    except DriverError as error:
        return [DeviceCheck("identity", FAILED, str(error))]
    if first != second:
        return [DeviceCheck("identity", FAILED, f"it is {first}, then {second}")]
    named = f"{first.model} {first.serial_no}".strip()
    if file is not None and not (file.identity or file.serial_no or (file.line is not None and file.line.who)):
        return [DeviceCheck("identity", NOT_PROVED, f"{named}: nothing in the device file identifies it")]
    found = [DeviceCheck("identity", PASSED, named)]
    if file is not None and file.modbus is not None:
        whole = any(SIZE[known.type] > 1 for known in file.identity)
        text = (
            f"{file.modbus.order}, by the identity registers"
            if whole
            else "no known content of two registers; the known motion shows the byte order"
        )
        found.append(DeviceCheck("byte order", PASSED if whole else NOT_PROVED, text))
    return found


async def rate(probe: DeviceUnderTest, file: DeviceFile | None) -> list[DeviceCheck]:
    """Take samples as fast as allowed: rate, jitter, freshness, the device's clock, noise."""
    taken: list[Sample] = []
    try:
        await probe.zero()
        while len(taken) < SAMPLES or taken[-1].host_s - taken[0].host_s < WATCHED_S:
            asked_s = time.monotonic()
            sample = await probe.sample(taken[-1].number if taken else None)
            if wrong := _wrong_by_driver(sample, taken, asked_s) if file is None else None:
                return [wrong]
            taken.append(sample)
    except DriverError as error:
        return [DeviceCheck("readings", FAILED, f"after {len(taken)} readings: {error}")]
    apart = [b.host_s - a.host_s for a, b in pairwise(taken)]
    mean_s = max(statistics.fmean(apart), 1e-9)
    jitter = f"{statistics.pstdev(apart) * 1e3:.1f} ms standard deviation, {max(apart) * 1e3:.0f} ms longest"
    found = [DeviceCheck("rate", PASSED, f"{1.0 / mean_s:.1f} readings a second; interval {mean_s * 1e3:.1f} ms, {jitter}")]
    return [*found, _fresh(file), *_clock(taken, file), *_noise(taken, file)]


def _wrong_by_driver(sample: Sample, taken: list[Sample], asked_s: float) -> DeviceCheck | None:
    """Check for faults that only a driver can cause: a sample returned twice, or a time that is not this computer's."""
    if taken and sample.number == taken[-1].number:
        return DeviceCheck("freshness", FAILED, f"read(after_count={sample.number}) returned sample {sample.number} again")
    if not asked_s - BUFFERED_S <= sample.host_s <= time.monotonic():
        return DeviceCheck("clock", FAILED, f"host_s is {sample.host_s:.3f}, the reading came at {asked_s:.3f}: is it time.monotonic()?")
    return None


def _fresh(file: DeviceFile | None) -> DeviceCheck:
    if file is None:
        return DeviceCheck("freshness", PASSED, "no sample came twice; only the driver knows whether the numbers come from the device")
    stamp = next((name for name in ("counter", "time") if name in file.values), None)
    if stamp is not None:
        return DeviceCheck("freshness", PASSED, f"its {stamp} is checked with every reading")
    if file.line is not None:
        return DeviceCheck(
            "freshness", PASSED, "every reading answered a request" if file.line.mode == "poll" else "every reading was a new line"
        )
    if file.limits.update_s is not None:
        return DeviceCheck(
            "freshness",
            PASSED,
            f"no counter and no time stamp; by its manual the device renews its reading every {file.limits.update_s:g} s",
        )
    return DeviceCheck("freshness", NOT_PROVED, "no counter, no time stamp and no update_s: an old value cannot be told from a new one")


def _clock(taken: list[Sample], file: DeviceFile | None) -> list[DeviceCheck]:
    host_s, device_s = taken[-1].host_s - taken[0].host_s, taken[-1].device_s - taken[0].device_s
    if math.isnan(device_s):
        return []
    ratio = device_s / host_s
    good = 1.0 / CLOCK_FACTOR < ratio < CLOCK_FACTOR
    text = f"its time stamps advance {device_s:.2f} s in {host_s:.2f} s"
    doubt = "is device_us in us" if file is None else "is the unit of values.time right"
    return [DeviceCheck("clock", PASSED if good else FAILED, text if good else f"{text}: {doubt}?")]


def _noise(taken: list[Sample], file: DeviceFile | None) -> list[DeviceCheck]:
    found = []
    for name in taken[0].values:
        values = [sample.values[name] for sample in taken]
        unit, scale = ("um", 1e3) if name in ("displacement", "radius", "x", "y", "z") else ("", 1.0)
        if not all(map(math.isfinite, values)):
            found.append(DeviceCheck(f"noise {name}", FAILED, "a reading is not a number"))
            continue
        steps = sorted({abs(b - a) for a, b in pairwise(values)} - {0.0})
        step = f", smallest step {steps[0] * scale:.4g} {unit}" if steps else ""
        found.append(
            DeviceCheck(f"noise {name}", PASSED, f"standard deviation {statistics.pstdev(values) * scale:.3g} {unit} at rest{step}")
        )
    return found


async def motion(probe: DeviceUnderTest, file: DeviceFile | None, move: Move, ask: Ask) -> list[DeviceCheck]:
    """Have the target (or each axis) moved by a known distance and back; check sign, scale, unit, byte order."""
    found = []
    for name in probe.moved:
        try:
            found.append(await _moved(probe, file, name, move, ask))
        except DriverError as error:
            found.append(DeviceCheck(f"motion {name}", FAILED, str(error)))
    return found


async def _moved(probe: DeviceUnderTest, file: DeviceFile | None, name: str, move: Move, ask: Ask) -> DeviceCheck:
    about, what = f"{move.mm:g} +- {move.tolerance_mm:g} mm", f"motion {name}"
    before, before_words = await _mean(probe, name), await _words(probe, name)
    done = {"displacement": f"Move the target {about} AWAY FROM the instrument.", "radius": f"Pull the bar {about} OUT."}
    await ask(done.get(name, f"Move axis {name.upper()} by +{about}."))
    after, after_words = await _mean(probe, name), await _words(probe, name)
    got = after - before
    wrong = wrong_motion(got, move, "driver" if file is None else "device file")
    if wrong:
        order = _other_order(file, name, (before_words, after_words), move)
        return DeviceCheck(what, FAILED, order or wrong)
    await ask("Move it back to where it was.")
    back = await _mean(probe, name) - before
    if abs(back) > move.tolerance_mm:
        return DeviceCheck(what, FAILED, f"back at the start the instrument reads {back:+.4f} mm: it lost counts, or something slipped")
    share = 100.0 * move.tolerance_mm / abs(move.mm)
    return DeviceCheck(
        what, PASSED, f"{move.mm:g} mm read as {got:.4f} mm and {back:+.4f} mm back: sign right, scale right to {share:.2g} %"
    )


async def _mean(probe: DeviceUnderTest, name: str) -> float:
    """Return the mean of some readings, taken after a short time to settle."""
    await asyncio.sleep(SETTLED_S)
    number, values = (await probe.sample(None)).number, []
    for _ in range(AVERAGED):
        sample = await probe.sample(number)
        number = sample.number
        values.append(sample.values[name])
    return statistics.fmean(values)


async def _words(probe: DeviceUnderTest, name: str) -> tuple[int, ...]:
    return (await probe.raw()).get(name, ())


def wrong_motion(got_mm: float, move: Move, where: str = "device file") -> str:
    """Describe how a motion was misread, and what to correct in the ``where`` (device file or driver); empty if it was read right."""
    if abs(got_mm - move.mm) <= move.tolerance_mm:
        return ""
    read = f"{move.mm:g} mm is read as {got_mm:.4f} mm"
    if abs(got_mm) <= move.tolerance_mm:
        return f"stuck: {read}: the reading does not follow the target"
    ratio = got_mm / move.mm
    sign = f"sign: the reading grows the wrong way, change sign in the {where}" if ratio < 0 else ""
    if abs(abs(got_mm) - abs(move.mm)) <= move.tolerance_mm:
        return f"{sign} ({read})"
    share = move.tolerance_mm / abs(move.mm)
    known = next((f" ({why})" for factor, why in FACTORS if abs(abs(ratio) / factor - 1.0) <= share), "")
    scale = f"scale: {read}, {abs(ratio):.4g} times{known}; divide scale in the {where} by {abs(ratio):.6g}"
    return "; ".join(filter(None, (sign, scale)))


def _other_order(file: DeviceFile | None, name: str, words: tuple[tuple[int, ...], ...], move: Move) -> str:
    """Name the byte order in which the registers would show the known motion; empty if there is none."""
    if file is None or file.modbus is None or not all(words):
        return ""
    value = file.values[name]
    used = value.order or file.modbus.order
    for order in ORDERS:
        before, after = (ours(value, decode(one, value.type, order)) for one in words)
        if order != used and abs(after - before - move.mm) <= move.tolerance_mm:
            return f"byte order: in order {order} the registers read {after - before:.4f} mm, in {used} they do not; change order"
    return ""


def _bad(file: DeviceFile | None) -> list[str]:
    """Test that an invalid reading is recognised."""
    if file is None:
        return ["an error"]
    found: list[str] = sorted({flag.means for flag in file.flags} & INVALID)
    found += ["an error line"] if file.line is not None and file.line.error else []
    return [*found, "a reading out of range_mm"] if file.limits.range_mm is not None else found


async def quality(probe: DeviceUnderTest, file: DeviceFile | None, ask: Ask) -> DeviceCheck:
    """Have the beam blocked or the plunger lifted: the reading must become invalid."""
    bad = _bad(file)
    if not bad:
        return DeviceCheck("quality", NOT_PROVED, "the device file has no mark of an invalid reading")
    try:
        await ask("Block the beam, or lift the plunger out of its range.")
        try:
            await _mean(probe, probe.moved[0])
        except DriverError as error:
            await ask("Clear the beam again, or let the plunger back into its range.")
            await probe.zero()
            return DeviceCheck("quality", PASSED, f"an invalid reading is refused: {error.detail}")
        await ask("Clear the beam again, or let the plunger back into its range.")
    except DriverError as error:
        return DeviceCheck("quality", FAILED, f"after the beam was free again: {error}")
    where = "driver" if file is None else "device file"
    return DeviceCheck("quality", FAILED, f"a blocked or lifted sensor still reads as valid; the {where} expects {', '.join(bad)}")
