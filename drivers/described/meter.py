"""A described displacement sensor as a `abbe.drivers.api.DisplacementMeter`: laser, scale, digital indicator."""

from __future__ import annotations

import asyncio
import math

from abbe.drivers.api import DeviceInfo, LaserFlag, LaserReading
from abbe.drivers.described.registers import TO_OURS
from abbe.drivers.described.source import CountSnapshot, DeviceSource, meanings, physical
from abbe.drivers.device_file import SIZE, Command, DeviceFile
from abbe.drivers.errors import DeviceFault, NotProved, Rebooted, Refused, ReplyTimeout

FLAGS = {
    "beam lost": LaserFlag.BEAM_LOST,
    "no reflector": LaserFlag.NO_REFLECTOR,
    "signal low": LaserFlag.SIGNAL_LOW,
    "out of range": LaserFlag.BEAM_LOST,
    "fault": LaserFlag.BEAM_LOST,
}
INVALID = FLAGS.keys() - {"signal low"}
LOSES_ZERO = {"beam lost", "no reflector", "fault"}
"""States after which an incremental instrument must be zeroed anew."""
TENTH_NM_PER_MM = 1e7
SOON_S = 10.0
"""Seconds in which a 16-bit counter of 1000 readings per second passes less than half of its range."""
NEW_S = 2.0
"""Longest wait for a new reading; a device that shows an old reading for longer is stuck."""
ZEROED_MM = 0.05


class DescribedMeter:
    """A displacement sensor. `zero` sends the device's own command; without such a command, later readings count from the present one.

    A reading is new if the device's counter or time stamp has changed. For a device with neither, a reading of registers is new if it comes
    ``update_s`` (device file) after the last new one, and a line of text is always new.
    """

    def __init__(self, file: DeviceFile, source: DeviceSource) -> None:
        self.file, self.source = file, source
        self.name, self.incidents = source.name, source.incidents
        self._zero_mm: float | None = None
        self._raw: dict[str, float] = {}
        self._total: dict[str, float] = {}
        self._epoch = -1
        self._seen_s = float("-inf")
        self._count = 0
        self._not_before: int | None = None

    @property
    def resolution_mm(self) -> float:
        """Smallest step of the readings, mm: from the device file or, if this states none, one count."""
        value = self.file.values["displacement"]
        return TO_OURS[value.unit][0] * (self.file.limits.resolution or value.scale)

    async def identify(self) -> DeviceInfo:
        """Identify the device again and discard its zero. Raises WrongDevice and the errors of communication."""
        info = await self.source.identify()
        self._zero_mm = None
        self._raw.clear()
        return info

    async def zero(self) -> None:
        """Take the present position as zero.

        Raises
        ------
        DeviceFault
            The reading is not valid now.
        Refused
            The device acknowledged its zero command but does not read zero.
        ReplyTimeout, LinkDown, BadFrame
            Communication failed.
        """
        snapshot = await self._new(self._not_before)
        if bad := meanings(self.file, snapshot.counts) & INVALID:
            raise DeviceFault(self.name, "zero", ", ".join(sorted(bad)), "clear the beam or free the plunger, then zero the instrument")
        if self.file.zero is not None:
            await self._command(self.file.zero, "zero")
            snapshot = await self._new(self._not_before)
            found_mm = physical(self.file, snapshot.counts, "displacement")
            if not abs(found_mm) < ZEROED_MM:
                raise Refused(self.name, "zero", f"it reads {found_mm:.4f} mm after its zero command", "correct [zero] in the device file")
            self._zero_mm = 0.0
        else:
            self._zero_mm = physical(self.file, snapshot.counts, "displacement")
        self._not_before = self._count

    async def clear_beam(self) -> None:
        """Clear a latched loss of the beam, if the device has a command for it; errors as for `zero`."""
        if self.file.clear is not None:
            await self._command(self.file.clear, "clear")

    async def set_environment_compensation(self, on: bool) -> None:
        """Send the command of the device file that switches the correction on; if there is none, do nothing.

        Raises
        ------
        NotProved
            The device measures with light and does not correct for the air, or cannot stop correcting.
        ReplyTimeout, LinkDown, BadFrame, Refused
            Communication failed, or the command is not acknowledged.
        """
        if on and self.file.air == "vacuum":
            detail = "the device does not correct its wavelength for the air: lengths would be some 270 ppm too large"
            raise NotProved(self.name, "switch environmental compensation", detail, "use an instrument that corrects for the air")
        if on and self.file.compensate is not None:
            await self._command(self.file.compensate, "switch environmental compensation")
        if not on and self.file.air == "compensated":
            raise NotProved(
                self.name,
                "switch environmental compensation",
                "the device cannot stop correcting for the air",
                "measure with this correction",
            )

    async def read(self, *, after_count: int | None = None) -> LaserReading:
        """Wait for a reading after the last zero and after sample number ``after_count`` (None: any), and return it.

        Raises
        ------
        DeviceFault
            The reading is not valid: beam lost, out of range, a fault, or not zeroed since.
        ReplyTimeout
            No new reading in time, or the counter is stuck.
        Rebooted, WrongDevice, LinkDown, BadFrame
            The device restarted or is another one, or communication failed.
        """
        floor = max((c for c in (after_count, self._not_before) if c is not None), default=None)
        snapshot = await self._new(floor)
        self._not_before = None
        bad = meanings(self.file, snapshot.counts) & INVALID
        reading = self._reading(snapshot)
        if bad:
            raise DeviceFault(
                self.name, "read", ", ".join(sorted(bad)), "clear the beam or free the plunger, zero the instrument, then repeat this test"
            )
        if self._zero_mm is None:
            raise DeviceFault(
                self.name, "read", "not zeroed since it was opened or lost its position", "zero the instrument, then repeat this test"
            )
        return reading

    async def peek(self) -> LaserReading:
        """Read once, valid or not, new or not; errors of communication as for `read`."""
        snapshot = await self.source.snapshot()
        self._counted(snapshot)
        return self._reading(snapshot)

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self.source.close()

    async def _command(self, command: Command, operation: str) -> None:
        """Send a command, and remember the present reading: the command acts on later readings only."""
        await self.source.command(command, operation)
        await asyncio.sleep(self.file.limits.update_s or 0.0)
        self._not_before = self._counted(await self.source.snapshot())

    async def _new(self, after: int | None) -> CountSnapshot:
        """Return a snapshot with a sample number above ``after``."""
        clock = asyncio.get_running_loop().time
        begun_s, update_s = clock(), self.file.limits.update_s
        while True:
            snapshot = await self.source.snapshot()
            count = self._counted(snapshot)
            stamped = "counter" in self.file.values or "time" in self.file.values
            if (after is None or count > after) and (stamped or update_s is None or after is None or clock() - begun_s >= update_s):
                return snapshot
            if clock() - begun_s > NEW_S + (update_s or 0.0):
                what = "counter" if "counter" in self.file.values else "time stamp"
                detail = f"its {what} is stuck at {snapshot.counts['counter' if what == 'counter' else 'time']:g} for {NEW_S:g} s"
                raise ReplyTimeout(
                    self.name, "read", f"{detail}: the device repeats an old reading", "restart the instrument's measurement"
                )

    def _counted(self, snapshot: CountSnapshot) -> int:
        """Return a snapshot's sample number, which never wraps: from the device's counter or time stamp or, without both, counted here."""
        if snapshot.epoch != self._epoch:
            self._epoch, self._zero_mm = snapshot.epoch, None
        soon, self._seen_s = snapshot.host_s - self._seen_s < SOON_S, snapshot.host_s
        steps = [self._step(name, snapshot.counts[name], soon=soon) for name in ("counter", "time") if name in self.file.values]
        self._count += bool(steps[0]) if steps else 1
        return self._count

    def _step(self, name: str, raw: float, *, soon: bool) -> float:
        """Add the change of a count, which may wrap, to its total, and return the change.

        Raises Rebooted if the count went back. ``soon``: the previous count is a moment old, so that a rise by more than half of the
        count's range means that the count went back.
        """
        value, before = self.file.values[name], self._raw.get(name)
        step = raw if before is None else raw - before
        size = float("inf")
        if self.file.modbus is not None and value.type[0] != "f":
            size = 1 << 16 * SIZE[value.type]
            step %= size
        self._raw[name] = raw
        if before is not None and (step < 0 or (soon and step > size / 2)):
            self._zero_mm = None
            detail = f"its {name} went back from {before:.10g} to {raw:.10g}: the device restarted, or an old reply came late"
            raise Rebooted(self.name, "read", detail, "zero the instrument, then measure this test again")
        self._total[name] = self._total.get(name, 0.0) + step
        return step

    def _reading(self, snapshot: CountSnapshot) -> LaserReading:
        found = meanings(self.file, snapshot.counts)
        mm = physical(self.file, snapshot.counts, "displacement")
        if not math.isfinite(mm):
            raise DeviceFault(self.name, "read", f"the displacement reads {mm}", "check that a sensor is connected to the instrument")
        limits = self.file.limits.range_mm
        if limits is not None and not limits[0] <= mm <= limits[1]:
            found |= {"out of range"}
        if found & LOSES_ZERO:
            self._zero_mm = None
        status = LaserFlag.COMPENSATED if self.file.air != "vacuum" else LaserFlag(0)
        status |= LaserFlag.ZEROED if self._zero_mm is not None else LaserFlag(0)
        for meaning in found & FLAGS.keys():
            status |= FLAGS[meaning]
        at_s = physical(self.file, self._total, "time") if "time" in self.file.values else snapshot.host_s
        signal = physical(self.file, snapshot.counts, "signal")
        permille = 1000 if math.isnan(signal) else round(signal * (10 if self.file.values["signal"].unit == "%" else 1))
        return LaserReading(
            host_s=snapshot.host_s,
            sample_count=self._count,
            device_us=round(at_s * 1e6),
            displacement_tenth_nm=round((mm - (self._zero_mm or 0.0)) * TENTH_NM_PER_MM),
            signal_permille=permille,
            status=int(status),
            air_temp_c=physical(self.file, snapshot.counts, "air_temperature"),
            air_pressure_pa=physical(self.file, snapshot.counts, "air_pressure"),
            humidity_percent=physical(self.file, snapshot.counts, "air_humidity"),
            refractivity=float("nan"),
        )
