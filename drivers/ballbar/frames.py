"""Ball-bar frames <-> bytes (docs/protocols/ballbar.md). Pure and total: any bytes give frames or counted bad bytes, never an exception."""

from __future__ import annotations

import struct
from binascii import crc_hqx
from dataclasses import dataclass

from abbe.drivers.api import BarSample

SYNC = b"\xa5\x5a"
MAX_PAYLOAD = 32
SAMPLE, INFO, ACK, SETTINGS = 0x01, 0x02, 0x03, 0x04
IDENTIFY, START, STOP, READ_SETTINGS, CONFIGURE = 0x81, 0x82, 0x83, 0x84, 0x85
NANOMETRE, TENTH_MICROINCH = 0, 1

ACK_TEXT = {0: "ok", 1: "bad argument", 2: "unknown command"}

# One known length per type the box sends: a sync pattern inside noise is mostly unmasked here, before waiting for its payload.
_LENGTH = {SAMPLE: 18, INFO: 28, ACK: 4, SETTINGS: 12}
_OVERHEAD = 6  # sync, type, length, check sum
_SAMPLE = struct.Struct("<IQiH")
_WHOLE_SAMPLE = struct.Struct("<IIQiHH")
_SAMPLE_HEAD = int.from_bytes(bytes((*SYNC, SAMPLE, 18)), "little")
_SAMPLE_BYTES = _WHOLE_SAMPLE.size
_INFO = struct.Struct("<HIIHHH12s")
_ACK = struct.Struct("<HBB")
_COMMAND = struct.Struct("<HH")
_SETTINGS = struct.Struct("<HBBIi")


@dataclass(frozen=True, slots=True)
class Info:
    """The box says who it is. ``firmware`` is BCD (0x0102 = 1.2), ``rate_hz`` 0 when it is not streaming."""

    tag: int
    boot_id: int
    serial_no: int
    firmware: int
    max_rate_hz: int
    rate_hz: int
    model: str


@dataclass(frozen=True, slots=True)
class Ack:
    """The box answers the command with this tag; ``result`` 0 is ok (see ``ACK_TEXT``)."""

    tag: int
    command: int
    result: int


@dataclass(frozen=True, slots=True)
class BoxSettings:
    """How the box reads: ``number`` counts the changes since it was switched on and stands in bits 8 to 15 of every sample's status.

    ``unit`` is ``NANOMETRE`` or ``TENTH_MICROINCH``; ``range_nm`` the stroke to either side; ``zero_nm`` what is taken off every reading.
    """

    tag: int
    number: int
    unit: int
    range_nm: int
    zero_nm: int


@dataclass(frozen=True, slots=True)
class Bad:
    """``n_bytes`` bytes that are no frame; ``reason`` is ``"check sum"`` when something in them looked like one, else ``"garbage"``."""

    reason: str
    n_bytes: int


Answer = Info | Ack | BoxSettings
Frame = BarSample | Answer | Bad


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: poly 0x1021, init 0xFFFF; ``crc16(b"123456789") == 0x29B1``."""
    return crc_hqx(data, 0xFFFF)


def encode(kind: int, payload: bytes) -> bytes:
    """Wrap a payload of at most 32 bytes into a frame.

    Raises
    ------
    ValueError
        Payload too long.
    """
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a payload has at most {MAX_PAYLOAD} bytes, not {len(payload)}")
    body = bytes((kind, len(payload))) + payload
    return SYNC + body + struct.pack("<H", crc16(body))


def identify_command(tag: int) -> bytes:
    """Ask the box who it is."""
    return encode(IDENTIFY, struct.pack("<H", tag))


def start_command(tag: int, rate_hz: int) -> bytes:
    """Ask the box for ``rate_hz`` samples per second."""
    return encode(START, _COMMAND.pack(tag, rate_hz))


def stop_command(tag: int) -> bytes:
    """Ask the box to stop streaming."""
    return encode(STOP, struct.pack("<H", tag))


def read_settings_command(tag: int) -> bytes:
    """Ask the box how it reads (firmware 1.1 and later)."""
    return encode(READ_SETTINGS, struct.pack("<H", tag))


def configure_command(tag: int, unit: int, range_nm: int, zero_nm: int) -> bytes:
    """Set how the box reads (firmware 1.1 and later)."""
    return encode(CONFIGURE, _SETTINGS.pack(tag, 0, unit, range_nm, zero_nm))


def reading_text(settings: BoxSettings) -> str:
    """Say how a box reads, for errors."""
    unit = "nm" if settings.unit == NANOMETRE else "0.1 microinch"
    return f"unit {unit}, range {settings.range_nm / 1e6:g} mm, zero {settings.zero_nm} nm"


class FrameDecoder:
    """Turns a byte stream into frames, whatever the pieces it arrives in.

    After noise no good frame is lost: bytes of a false frame are searched again for a true one.
    """

    def __init__(self) -> None:
        self._rest = b""

    @property
    def pending(self) -> int:
        """Bytes kept because they may be the start of a frame (always less than one frame)."""
        return len(self._rest)

    def feed(self, chunk: bytes) -> list[Frame]:
        """Take any number of bytes, return what they complete.

        Returns
        -------
        list of BarSample, Info, Ack, Settings or Bad
            In order of arrival. Every byte fed ends in exactly one of them or in ``pending``.
        """
        data = self._rest + chunk if self._rest else chunk
        out: list[Frame] = []
        size, at, bad_from, reason = len(data), 0, 0, "garbage"
        while True:
            if at == bad_from:
                at = bad_from = _samples(data, at, out)
            searched_from, at = at, data.find(SYNC, at)
            if at < 0:
                at = size - 1 if data.endswith(b"\xa5", searched_from) else size
                break
            if size - at < 4:
                break
            kind, length = data[at + 2], data[at + 3]
            if length > MAX_PAYLOAD or _LENGTH.get(kind, length) != length:
                at += 2
                continue
            end = at + length + _OVERHEAD
            if end > size:
                break
            if crc_hqx(data[at + 2 : end - 2], 0xFFFF) != data[end - 2] | data[end - 1] << 8:
                at, reason = at + 2, "check sum"
                continue
            if at > bad_from:
                out.append(Bad(reason, at - bad_from))
                reason = "garbage"
            out.append(_frame(kind, data, at + 4, end - at))
            at = bad_from = end
        if at > bad_from:
            out.append(Bad(reason, at - bad_from))
        self._rest = data[at:]
        return out


def _samples(data: bytes, at: int, out: list[Frame]) -> int:
    """Take the whole SAMPLE frames that follow one another from ``at`` on; gives where they end. A good line is nothing but these."""
    view = memoryview(data)
    whole = at + (len(data) - at) // _SAMPLE_BYTES * _SAMPLE_BYTES
    for head, seq, device_us, reading_nm, status, crc in _WHOLE_SAMPLE.iter_unpack(view[at:whole]):
        if head != _SAMPLE_HEAD or crc_hqx(data[at + 2 : at + _SAMPLE_BYTES - 2], 0xFFFF) != crc:
            break
        out.append(_new(BarSample, (seq, device_us, reading_nm, status)))
        at += _SAMPLE_BYTES
    return at


_new = tuple.__new__  # half the time of calling the class, which is most of what framing takes


def _frame(kind: int, data: bytes, payload_at: int, n_bytes: int) -> Frame:
    if kind == SAMPLE:
        return BarSample(*_SAMPLE.unpack_from(data, payload_at))
    if kind == ACK:
        return Ack(*_ACK.unpack_from(data, payload_at))
    if kind == SETTINGS:
        return BoxSettings(*_SETTINGS.unpack_from(data, payload_at))
    if kind == INFO:
        tag, boot_id, serial_no, firmware, max_rate_hz, rate_hz, model = _INFO.unpack_from(data, payload_at)
        return Info(tag, boot_id, serial_no, firmware, max_rate_hz, rate_hz, model.rstrip(b"\x00").decode("ascii", "replace"))
    return Bad("unknown type", n_bytes)
