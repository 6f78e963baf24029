"""Driver of a laser displacement meter, and its register map (docs/protocols/laser.md) as data."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from abbe.drivers.api import DeviceInfo, LaserFlag, LaserReading, beam_is_gone, is_zeroed
from abbe.drivers.errors import DeviceFault, Rebooted, Refused, ReplyTimeout, WrongDevice
from abbe.drivers.links.modbus_link import ModbusLink, ModbusOperation
from abbe.drivers.links.words import Register, RegisterBlock, check_clock, check_identity, next_number, run_numbered

MAP_VERSION = 1

IDENTITY = RegisterBlock(
    0,
    9,
    (
        Register(0, "i32", "CANARY_I32"),
        Register(2, "u32", "CANARY_F32"),
        Register(4, "u16", "MAP_VER"),
        Register(5, "u32", "BOOT_ID"),
        Register(7, "u32", "SERIAL_NO"),
    ),
)

READING = RegisterBlock(
    10,
    18,
    (
        Register(10, "u32", "SAMPLE_COUNT"),
        Register(12, "u64", "DEVICE_TIME_US", 1e6, "s"),
        Register(16, "i64", "DISPLACEMENT", 1e7, "mm"),
        Register(20, "u16", "SIGNAL", 1000.0),
        Register(21, "u16", "STATUS"),
        Register(22, "i16", "AIR_TEMPERATURE", 100.0, "degree C"),
        Register(23, "u32", "AIR_PRESSURE", 1.0, "Pa"),
        Register(25, "u16", "HUMIDITY", 10.0, "%"),
        Register(26, "u32", "REFRACTIVITY", 1e10),
    ),
    lead=10,
)

ACKNOWLEDGE = RegisterBlock(43, 2, (Register(43, "u16", "CMD_ACK_SEQ"), Register(44, "u16", "CMD_RESULT")), lead=3)

COMMAND_ADDRESS = 40
ZERO, CLEAR_BEAM, ENVIRONMENT = 1, 2, 3
RESULT_TEXT = {1: "bad argument", 2: "refused: beam blocked"}


def decode_reading(words: Sequence[int], host_s: float) -> LaserReading:
    """Decode registers 10..27, read in one request; ``host_s``: monotonic time at which the reply was complete."""
    counts = READING.counts(words)
    return LaserReading(
        host_s=host_s,
        sample_count=counts["SAMPLE_COUNT"],
        device_us=counts["DEVICE_TIME_US"],
        displacement_tenth_nm=counts["DISPLACEMENT"],
        signal_permille=counts["SIGNAL"],
        status=counts["STATUS"],
        air_temp_c=READING.physical("AIR_TEMPERATURE", counts["AIR_TEMPERATURE"]),
        air_pressure_pa=READING.physical("AIR_PRESSURE", counts["AIR_PRESSURE"]),
        humidity_percent=READING.physical("HUMIDITY", counts["HUMIDITY"]),
        refractivity=READING.physical("REFRACTIVITY", counts["REFRACTIVITY"]),
    )


_POLL_S = 0.005
_READ_S = 5.0


class ModbusLaser:
    """A laser displacement meter on Modbus TCP or RTU (docs/protocols/laser.md). ``read_timeout_s``: longest wait for a new sample."""

    def __init__(self, link: ModbusLink, *, read_timeout_s: float = _READ_S) -> None:
        self._link = link
        self.name = link.name
        self.incidents = link.incidents
        """Incidents of the link: one entry for the detection, one for the outcome."""
        self._read_timeout_s = read_timeout_s
        self._boot_id: int | None = None
        self._connection = link.connections
        self._last_us = -1
        self._shown_at_command: int | None = None  # a command acts on later samples: this one may still have the old state
        self._command_lock = asyncio.Lock()

    async def identify(self) -> DeviceInfo:
        """Read the identity of the meter, and accept its boot id as the current one.

        Raises
        ------
        WrongDevice
            Canary registers or map version are not those of docs/protocols/laser.md.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed.
        """
        counts = await self._identity()
        try:
            await check_clock(self.name, self._clock_us)
        except WrongDevice as error:
            self._link.incidents.note(error, latched=True)
            raise
        self._boot_id = counts["BOOT_ID"]
        self._connection = self._link.connections
        self._last_us = -1
        self._shown_at_command = None
        self._link.incidents.accepted()
        return DeviceInfo("laser", "LDDM", str(counts["SERIAL_NO"]), counts["BOOT_ID"], f"map {counts['MAP_VER']}")

    async def zero(self) -> None:
        """Set the displacement at the present position of the reflector to zero.

        Raises
        ------
        Refused
            The beam is blocked, or its loss was not cleared.
        Rebooted, LinkDown, ReplyTimeout, BadFrame
            The meter restarted, or communication failed.
        """
        await self._command(ZERO, 0, "zero")

    async def clear_beam(self) -> None:
        """Clear the latch of a lost beam; a new ``zero`` is needed afterwards.

        Raises
        ------
        Refused
            The beam is still blocked.
        Rebooted, LinkDown, ReplyTimeout, BadFrame
            The meter restarted, or communication failed.
        """
        await self._command(CLEAR_BEAM, 0, "clear beam-lost latch")

    async def set_environment_compensation(self, on: bool) -> None:
        """Switch the compensation for the refractive index of air on or off (without it the meter reads about 270 ppm more).

        Raises
        ------
        Refused, Rebooted, LinkDown, ReplyTimeout, BadFrame
            As for ``zero``.
        """
        await self._command(ENVIRONMENT, int(on), "switch environmental compensation")

    async def read(self, *, after_count: int | None = None) -> LaserReading:
        """Wait for an output sample after the last command and after sample number ``after_count`` (None: any), and return it.

        Raises
        ------
        DeviceFault
            The beam is or was lost, or the meter was not zeroed since: the displacement is not valid.
        ReplyTimeout
            No new sample in time.
        Rebooted, LinkDown, BadFrame
            The meter restarted, or communication failed.
        """
        try:
            async with asyncio.timeout(self._read_timeout_s):
                while True:
                    reading = await self._read_once()
                    if _newer(reading, after_count) and _newer(reading, self._shown_at_command):
                        break
                    await asyncio.sleep(_POLL_S)
        except TimeoutError as error:
            if isinstance(error, ReplyTimeout):
                raise
            floor = self._shown_at_command if after_count is None else after_count
            detail = f"no sample after number {floor} within {self._read_timeout_s:g} s"
            raise ReplyTimeout(self.name, "read", detail, "start the meter's measurement") from None
        self._shown_at_command = None
        self._check_beam(reading.status)
        return reading

    async def peek(self) -> LaserReading:
        """Read the current output sample without waiting for a newer one and without checking the beam, for monitoring.

        Raises
        ------
        Rebooted, LinkDown, ReplyTimeout, BadFrame
            The meter restarted, or communication failed.
        """
        return await self._read_once()

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self._link.close()

    async def _read_once(self) -> LaserReading:
        words = await self._link.read_block(READING)
        reading = decode_reading(words, time.monotonic())
        if reading.device_us < self._last_us or self._connection != self._link.connections:
            await self._check_boot()
        self._last_us = reading.device_us
        return reading

    async def _check_boot(self) -> None:
        counts = await self._identity()
        if self._boot_id is None:
            self._boot_id = counts["BOOT_ID"]
        if counts["BOOT_ID"] != self._boot_id:
            detail = f"boot id {counts['BOOT_ID']:#x} instead of {self._boot_id:#x}"
            error = Rebooted(self.name, "read", detail, "the meter restarted: connect again, zero the meter, then measure this test again")
            self._link.incidents.note(error, latched=True)
            raise error
        self._connection = self._link.connections

    async def _identity(self) -> dict[str, int]:
        """Read and verify the identity block. This is repeated at every new connection, because the device may be another one."""
        counts = IDENTITY.counts(await self._link.read_block(IDENTITY))
        try:
            check_identity(self.name, counts, MAP_VERSION)
        except WrongDevice as error:
            self._link.incidents.note(error, latched=True)
            raise
        return counts

    async def _clock_us(self) -> int:
        return decode_reading(await self._link.read_block(READING), time.monotonic()).device_us

    def _check_beam(self, status: int) -> None:
        if beam_is_gone(status):
            what = "no reflector in the beam" if status & LaserFlag.NO_REFLECTOR else "counts are lost"
            raise DeviceFault(
                self.name, "read", f"beam lost ({what})", "free the beam, clear the loss, zero the meter, then repeat this test"
            )
        if not is_zeroed(status):
            raise DeviceFault(
                self.name, "read", "not zeroed since it was switched on or lost the beam", "zero the meter, then repeat this test"
            )

    async def _command(self, command: int, argument: int, operation: str) -> None:
        async with self._command_lock:
            await self._check_boot()
            acknowledged, _ = await self._read_ack()
            number = next_number(acknowledged)

            async def write() -> None:
                await self._link.write(COMMAND_ADDRESS, (number, command, argument), ModbusOperation.NUMBERED)

            result = await run_numbered(self.name, operation, number, write, self._read_ack)
        if result:
            raise Refused(
                self.name, operation, RESULT_TEXT.get(result, f"result {result}"), "free the beam and clear its loss, then try again"
            )
        self._shown_at_command = (await self._read_once()).sample_count

    async def _read_ack(self) -> tuple[int, int]:
        counts = ACKNOWLEDGE.counts(await self._link.read_block(ACKNOWLEDGE))
        return counts["CMD_ACK_SEQ"], counts["CMD_RESULT"]


def _newer(reading: LaserReading, count: int | None) -> bool:
    return count is None or 0 < (reading.sample_count - count) % (1 << 32) < 1 << 31
