"""Frames of the ball-bar's box (docs/protocols/ballbar.md), little-endian, and its replies to commands."""

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from abbe.simulators.ballbar.device import MAX_RATE_HZ, OVERRUN, BallbarDevice, Samples, Settings
from abbe.simulators.ballbar.port import BytePort

SENT, SUPPRESSED, CORRUPTED = "sent", "suppressed", "corrupted"


class BoxLedger:
    """Fate of each sample: successive sample numbers of equal fate form a run (stream, first, last, fate); streams count from 0."""

    def __init__(self) -> None:
        self.runs: list[list[int | str]] = []
        self.stream = -1

    def start(self) -> None:
        """Begin a new stream, whose samples are numbered from 0."""
        self.stream += 1

    def note(self, seqs: Sequence[int], fate: str) -> None:
        """Note the fate of successive sample numbers of the current stream."""
        if not len(seqs):
            return
        first, last = int(seqs[0]), int(seqs[-1])
        if self.runs and self.runs[-1][0] == self.stream and self.runs[-1][3] == fate and self.runs[-1][2] == first - 1:
            self.runs[-1][2] = last
        else:
            self.runs.append([self.stream, first, last, fate])

    def write(self, path: Path) -> None:
        """Write all runs so far as JSON, in one step, so that a reader never sees half a file."""
        part = path.with_name(path.name + ".part")
        part.write_text(json.dumps(self.runs), encoding="ascii")
        part.replace(path)


SYNC_BYTES = b"\xa5\x5a"
SAMPLE, INFO, ACK, SETTINGS = 0x01, 0x02, 0x03, 0x04
IDENTIFY, START, STOP, READ_SETTINGS, CONFIGURE = 0x81, 0x82, 0x83, 0x84, 0x85
MAX_PAYLOAD = 32
OK, BAD_ARGUMENT, UNKNOWN_COMMAND = 0, 1, 2
FIRMWARE_BCD = 0x0100
WITH_SETTINGS_BCD = 0x0101
SERIAL_NO = 4711
MODEL = b"ABB-1"
SAMPLE_BYTES = 24
MAX_RANGE_NM = 10_000_000

_SAMPLE_DTYPE = np.dtype(
    [
        ("sync", "u1", (2,)),
        ("type", "u1"),
        ("length", "u1"),
        ("seq", "<u4"),
        ("time_us", "<u8"),
        ("reading_nm", "<i4"),
        ("status", "<u2"),
        ("crc", "<u2"),
    ]
)


def _crc_table() -> NDArray[np.uint16]:
    """Return the CRC-16/CCITT-FALSE of each single byte value."""
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return np.array(table, dtype=np.uint16)


_TABLE = _crc_table()
_TABLE_LIST = [int(v) for v in _TABLE]


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of some bytes."""
    crc = 0xFFFF
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE_LIST[(crc >> 8) ^ byte]
    return crc


def encode(kind: int, payload: bytes) -> bytes:
    """Return a frame of this type and payload."""
    body = bytes([kind, len(payload)]) + payload
    return SYNC_BYTES + body + struct.pack("<H", crc16(body))


def encode_samples(samples: Samples) -> bytes:
    """Return the SAMPLE frames of n samples."""
    frames = np.zeros(len(samples.seq), dtype=_SAMPLE_DTYPE)
    frames["sync"] = (0xA5, 0x5A)
    frames["type"], frames["length"] = SAMPLE, 18
    frames["seq"] = samples.seq & 0xFFFFFFFF
    frames["time_us"], frames["reading_nm"], frames["status"] = samples.time_us, samples.reading_nm, samples.status
    columns = frames.view(np.uint8).reshape(-1, SAMPLE_BYTES)
    crc = np.full(len(frames), 0xFFFF, dtype=np.uint16)
    for i in range(2, SAMPLE_BYTES - 2):  # byte by byte, but all frames together
        crc = (crc << 8) ^ _TABLE[(crc >> 8) ^ columns[:, i]]
    frames["crc"] = crc
    return frames.tobytes()


def encode_info(tag: int, boot_id: int, rate_hz: int, serial_no: int = SERIAL_NO, firmware: int = FIRMWARE_BCD) -> bytes:
    """Return an INFO frame."""
    return encode(INFO, struct.pack("<HIIHHH12s", tag, boot_id, serial_no, firmware, MAX_RATE_HZ, rate_hz, MODEL))


def encode_settings(tag: int, settings: Settings) -> bytes:
    """Return a SETTINGS frame."""
    nm = (round(settings.range_mm * 1e6), round(settings.zero_mm * 1e6))
    return encode(SETTINGS, struct.pack("<HBBIi", tag, settings.number, settings.inch, *nm))


def encode_ack(tag: int, command: int, result: int) -> bytes:
    """Return an ACK frame."""
    return encode(ACK, struct.pack("<HBB", tag, command, result))


class Parser:
    """Finds the host's frames in a stream of bytes; garbage and frames with a wrong CRC are skipped silently."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield (type, payload) of each whole frame."""
        self._buffer += data
        while True:
            begin = self._buffer.find(SYNC_BYTES)
            if begin < 0:
                del self._buffer[: max(0, len(self._buffer) - 1)]  # the last byte may be half a sync
                return
            del self._buffer[:begin]
            if len(self._buffer) < 4:
                return
            length = self._buffer[3]
            end = 6 + length
            if length <= MAX_PAYLOAD and len(self._buffer) < end:
                return
            body = bytes(self._buffer[2 : end - 2])
            if length > MAX_PAYLOAD or crc16(body) != struct.unpack_from("<H", self._buffer, end - 2)[0]:
                del self._buffer[:2]  # not a frame: look for the next sync behind this one
                continue
            del self._buffer[:end]
            yield body[0], body[2:]


class BallbarWire:
    """The box on its line: answers commands, sends the samples taken, and drops whole samples when the host does not read."""

    def __init__(
        self,
        device: BallbarDevice,
        port: BytePort,
        boot_id: int,
        now_s: Callable[[], float],
        *,
        serial_no: int = SERIAL_NO,
        firmware: int = FIRMWARE_BCD,
    ) -> None:
        self._serial_no, self._firmware = serial_no, firmware
        device.tells_settings = firmware >= WITH_SETTINGS_BCD
        self._device, self._port, self._boot_id, self._now_s = device, port, boot_id, now_s
        self._parser = Parser()
        self._overrun = False
        self.samples_sent = 0
        self.samples_dropped = 0
        self.ledger = BoxLedger()
        self.spoil_every = 0
        """One bit of every n-th sample is flipped on the line; 0: none."""

    def received(self, data: bytes) -> None:
        """Take bytes from the host. The caller must have advanced the world to now."""
        for kind, payload in self._parser.feed(data):
            self.flush()  # samples older than the command leave before its answer
            self._port.send(self._answer(kind, payload))

    def flush(self) -> None:
        """Send all samples taken so far."""
        samples = self._device.take()
        count = len(samples.seq)
        kept = min(count, self._port.room() // SAMPLE_BYTES)
        if kept:
            status = samples.status[:kept].copy()
            if self._overrun:
                status[0] |= OVERRUN
                self._overrun = False
            frames = encode_samples(Samples(samples.seq[:kept], samples.time_us[:kept], samples.reading_nm[:kept], status))
            self._port.send(self._spoilt(frames, samples.seq[:kept].tolist()))
            self.samples_sent += kept
        if kept < count:
            self._overrun = True
            self.samples_dropped += count - kept
            self.ledger.note(samples.seq[kept:].tolist(), SUPPRESSED)

    def _spoilt(self, frames: bytes, seqs: list[int]) -> bytes:
        """Return the frames as the line delivers them, and note the fate of each in the ledger."""
        if not self.spoil_every:
            self.ledger.note(seqs, SENT)
            return frames
        spoilt = bytearray(frames)
        begin = 0
        for k, seq in enumerate(seqs):
            if seq % self.spoil_every == self.spoil_every // 2:
                spoilt[SAMPLE_BYTES * k + 5 + seq % (SAMPLE_BYTES - 6)] ^= 1 << seq % 8
                self.ledger.note(seqs[begin:k], SENT)
                self.ledger.note([seq], CORRUPTED)
                begin = k + 1
        self.ledger.note(seqs[begin:], SENT)
        return bytes(spoilt)

    def restart(self, boot_id: int) -> None:
        """Restart the box as after a power cycle: new boot id, no stream, factory settings."""
        self._device.stop()
        self._device.forget_settings()
        self._device.take()
        self._boot_id, self._parser, self._overrun = boot_id, Parser(), False

    def _answer(self, kind: int, payload: bytes) -> bytes:
        tag = struct.unpack_from("<H", payload)[0] if len(payload) >= 2 else 0
        if kind == IDENTIFY and len(payload) == 2:
            return encode_info(tag, self._boot_id, self._device.rate_hz, self._serial_no, self._firmware)
        if kind == START and len(payload) == 4:
            return encode_ack(tag, START, self._start(struct.unpack_from("<H", payload, 2)[0]))
        if kind == STOP and len(payload) == 2:
            self._device.stop()
            return encode_ack(tag, STOP, OK)
        if self._firmware >= WITH_SETTINGS_BCD and (answer := self._answer_settings(kind, tag, payload)):
            return answer
        return encode_ack(tag, kind, BAD_ARGUMENT if kind in (IDENTIFY, START, STOP) else UNKNOWN_COMMAND)

    def _answer_settings(self, kind: int, tag: int, payload: bytes) -> bytes:
        if kind == READ_SETTINGS and len(payload) == 2:
            return encode_settings(tag, self._device.settings)
        if kind != CONFIGURE or len(payload) != 12:
            return encode_ack(tag, kind, BAD_ARGUMENT) if kind in (READ_SETTINGS, CONFIGURE) else b""
        _, _, unit, range_nm, zero_nm = struct.unpack("<HBBIi", payload)
        if unit > 1 or not 0 < range_nm <= MAX_RANGE_NM or abs(zero_nm) > MAX_RANGE_NM:
            return encode_ack(tag, kind, BAD_ARGUMENT)
        self._device.switch(inch=bool(unit), range_mm=range_nm * 1e-6, zero_mm=zero_nm * 1e-6)
        return encode_ack(tag, kind, OK)

    def _start(self, rate_hz: int) -> int:
        if not self._device.start(rate_hz, self._now_s()):
            return BAD_ARGUMENT
        self.samples_sent = self.samples_dropped = 0
        self._overrun = False
        self.ledger.start()
        return OK
