"""A Modbus reply as bytes, and whether the link takes it: compared with its request first, then the library's framer, as on the wire."""

from __future__ import annotations

import logging
import struct

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU

from abbe.drivers.links.modbus import rtu_mismatch, tcp_mismatch

logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL + 1)  # a line per refused reply would be most of the time
UNIT, TID, ADDRESS, COUNT = 1, 0x1234, 10, 9
_RTU, _TCP = FramerRTU(DecodePDU(False)), FramerSocket(DecodePDU(False))


def request(*, rtu: bool) -> bytes:
    """Read nine registers."""
    pdu = struct.pack(">BHH", 3, ADDRESS, COUNT)
    return _RTU.encode(pdu, UNIT, 0) if rtu else _TCP.encode(pdu, UNIT, TID)


def reply(registers: tuple[int, ...], *, rtu: bool) -> bytes:
    """The honest answer."""
    pdu = struct.pack(f">BB{COUNT}H", 3, 2 * COUNT, *registers)
    return _RTU.encode(pdu, UNIT, 0) if rtu else _TCP.encode(pdu, UNIT, TID)


def taken(sent: bytes, heard: bytes, *, rtu: bool) -> tuple[int, ...] | None:
    """The registers, None as long as (or because) it is not an answer."""
    if rtu_mismatch(sent, heard) if rtu else tcp_mismatch(sent, heard):
        return None
    try:
        _, pdu = (_RTU if rtu else _TCP).handleFrame(heard, UNIT, 0 if rtu else TID)
    except ModbusException:
        return None
    return None if pdu is None or pdu.isError() else tuple(pdu.registers)
