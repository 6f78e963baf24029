"""Modbus frames on TCP (MBAP) and RTU: cut a stream into frames, take one apart, put it together, answer it from a register map."""

import struct
from dataclasses import dataclass

from abbe.simulators.modbus_wire import RegisterMap

MBAP, RTU = "mbap", "rtu"
READS, WRITES = (1, 2, 3, 4), (5, 6, 15, 16)
_HEADER = 7


def crc16(data: bytes) -> bytes:
    """Check sum of an RTU frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame in parts. ``tid``, ``pid``, ``length``: of MBAP; a ``length`` of None is the right one."""

    unit: int
    pdu: bytes
    tid: int = 0
    pid: int = 0
    length: int | None = None

    def bytes(self, framing: str) -> bytes:
        """The frame on the wire."""
        if framing == RTU:
            body = bytes([self.unit]) + self.pdu
            return body + crc16(body)
        length = len(self.pdu) + 1 if self.length is None else self.length
        return struct.pack(">HHHB", self.tid, self.pid, length, self.unit) + self.pdu


def parts(data: bytes, framing: str) -> Frame:
    """Take one whole frame apart."""
    if framing == RTU:
        return Frame(data[0], data[1:-2])
    tid, pid, length, unit = struct.unpack_from(">HHHB", data)
    return Frame(unit, data[_HEADER:], tid, pid, length)


class Cutter:
    """Cuts a stream of good frames. ``requests``: which of the two directions, because RTU frames do not say how long they are."""

    def __init__(self, framing: str, *, requests: bool) -> None:
        self._framing, self._requests = framing, requests
        self._held = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes; gives the frames that are whole now."""
        self._held += data
        frames = []
        while (size := self._size()) and len(self._held) >= size:
            frames.append(self._held[:size])
            self._held = self._held[size:]
        return frames

    def _size(self) -> int:
        """Length of the first frame, 0 while unknown."""
        held = self._held
        if self._framing == MBAP:
            return 6 + int.from_bytes(held[4:6], "big") if len(held) >= _HEADER else 0
        if len(held) < 3:
            return 0
        function = held[1]
        if self._requests:
            if function in (15, 16):
                return 9 + held[6] if len(held) >= 7 else 0
            return 8
        if function & 0x80:
            return 5
        return 5 + held[2] if function in READS else 8


def answer(registers: RegisterMap, pdu: bytes) -> bytes:
    """What a device with this register map answers to a request (functions 3, 4, 6, 16)."""
    function, address, count = struct.unpack_from(">BHH", pdu)
    if function in (3, 4):
        words = registers.read(address, count) if 1 <= count <= 125 else None
        return bytes([function | 0x80, 2]) if words is None else struct.pack(f">BB{count}H", function, 2 * count, *words)
    if function == 16:
        taken = registers.write(address, list(struct.unpack_from(f">{count}H", pdu, 6)))
    elif function == 6:
        taken = registers.write(address, [count])
    else:
        return bytes([function | 0x80, 1])
    return pdu[:5] if taken else bytes([function | 0x80, 2])
