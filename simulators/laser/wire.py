"""Register map of the laser (docs/protocols/laser.md), encoded by its own struct code: big-endian, high word first."""

import struct
from collections.abc import Callable

from abbe.simulators.arrays import F
from abbe.simulators.laser.device import LaserDevice, LaserResult

MAP_VERSION = 1
_IDENTITY = struct.Struct(">ifHIIH")  # 0..9
_SAMPLE = struct.Struct(">IQqHHhIHI")  # 10..27
_COMMAND_AT, _COMMAND_WORDS = 40, 3
_ACK_WORDS = 2


class LaserRegisters:
    """The laser seen through its registers.

    ``advance`` brings the world up to date before every request; ``tool_position`` gives the actual tool position (3,) mm now.
    The laser's clock runs ``clock_offset_us`` ahead of the world's, because it was switched on earlier.
    """

    size = _COMMAND_AT + _COMMAND_WORDS + _ACK_WORDS

    def __init__(
        self, laser: LaserDevice, boot_id: int, advance: Callable[[], None], tool_position: Callable[[], F], *, clock_offset_us: int = 0
    ) -> None:
        self._laser, self._boot_id, self._advance, self._tool_position = laser, boot_id, advance, tool_position
        self._offset_us = clock_offset_us
        self._serial = 88000417
        self._command = [0, 0, 0]
        self._ack, self._result = 0, LaserResult.OK

    def read(self, address: int, count: int) -> list[int] | None:
        """Return the words of one read request, None for an illegal address."""
        self._advance()
        end = address + count
        if end <= 28:
            data = self._identity() + (self._sample() if end > 10 else b"")
            return _words(data)[address:end]
        if address >= _COMMAND_AT and end <= self.size:
            return [*self._command, self._ack, int(self._result)][address - _COMMAND_AT : end - _COMMAND_AT]
        return None

    def write(self, address: int, values: list[int]) -> bool:
        """Take one write request; only the command block can be written."""
        self._advance()
        end = address + len(values)
        if address < _COMMAND_AT or end > _COMMAND_AT + _COMMAND_WORDS:
            return False
        self._command[address - _COMMAND_AT : end - _COMMAND_AT] = values
        number, command, argument = self._command
        if number == (self._ack + 1) & 0xFFFF:
            self._ack, self._result = number, self._execute(command, argument)
        return True

    def _execute(self, command: int, argument: int) -> LaserResult:
        if command == 1:
            return self._laser.zero(self._tool_position())
        if command == 2:
            return self._laser.clear()
        if command == 3:
            return self._laser.compensate(argument)
        return LaserResult.BAD_ARGUMENT

    def _identity(self) -> bytes:
        return _IDENTITY.pack(0x01020304, 1234.5, MAP_VERSION, self._boot_id, self._serial, 0)

    def _sample(self) -> bytes:
        sample = self._laser.output()
        air = sample.air
        return _SAMPLE.pack(
            sample.count & 0xFFFFFFFF,
            round(sample.time_s * 1e6) + self._offset_us,
            round(sample.displacement_mm * 1e7),
            sample.signal_permille,
            sample.status,
            round(air.temperature_c * 100.0),
            round(air.pressure_pa),
            round(air.humidity_percent * 10.0),
            round(air.refractivity * 1e10),
        )


def _words(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))
