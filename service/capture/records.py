"""One record of a segment <-> bytes. Pure: a header, the payload, a CRC-32 over both, and in the header the SHA-256 of the record before.

``open``: who measures what. ``chunk``: samples as they go into the database. ``gap``: numbers that are missing, and why. ``close``: how it
ended; a segment without it belongs to a run that was interrupted.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from dataclasses import dataclass, field

from abbe.service.errors import CaptureFault

MAGIC = b"AbbC"
VERSION = 1
OPEN, CHUNK, GAP, CLOSE = 1, 2, 3, 4
MAX_PAYLOAD = 1 << 24
NO_HASH = bytes(32)

# magic, version, kind, stream, run, chunk_no, boot_id, channel, codec, first_seq, count, flags, first_us, last_us, first_host_s,
# last_host_s, utc_offset_s, SHA-256 of the record before, payload length
_HEAD = struct.Struct("<4sBBHIII12s8sQIIqqddd32sI")
_CRC = struct.Struct("<I")
HEAD_BYTES = _HEAD.size


@dataclass(frozen=True, slots=True)
class Record:
    """One record.

    Parameters
    ----------
    kind : int
        ``OPEN``, ``CHUNK``, ``GAP`` or ``CLOSE``.
    run : int
        Run in the database.
    channel, codec : str
        As in the database.
    chunk_no : int
        Number in its channel, from 0.
    stream : int
        Which stream of the run: sequence numbers begin anew in each.
    boot_id : int
        Of the device, 0 where it has none.
    first_seq, count : int
        First sequence number and how many samples.
    flags : int
        All status bits that any of the samples has.
    first_us, last_us : int
        Device clock of the first and the last sample.
    first_host_s, last_host_s : float
        Monotonic host time of the first and the last arrival.
    utc_offset_s : float
        What to add to the monotonic host time to get UTC, as this computer believed then; no sample time depends on it.
    payload : bytes
        Packed samples, or JSON.
    previous : bytes
        SHA-256 of the record before in the same file.
    """

    kind: int
    run: int
    channel: str
    codec: str
    chunk_no: int = 0
    stream: int = 0
    boot_id: int = 0
    first_seq: int = 0
    count: int = 0
    flags: int = 0
    first_us: int = 0
    last_us: int = 0
    first_host_s: float = 0.0
    last_host_s: float = 0.0
    utc_offset_s: float = 0.0
    payload: bytes = field(default=b"", repr=False)
    previous: bytes = field(default=NO_HASH, repr=False)


def encode(record: Record) -> bytes:
    """Bytes of a record."""
    r = record
    head = _HEAD.pack(
        MAGIC, VERSION, r.kind, r.stream, r.run, r.chunk_no, r.boot_id, r.channel.encode(), r.codec.encode(), r.first_seq, r.count, r.flags,
        r.first_us, r.last_us, r.first_host_s, r.last_host_s, r.utc_offset_s, r.previous, len(r.payload),
    )  # fmt: skip
    body = head + r.payload
    return body + _CRC.pack(zlib.crc32(body))


def digest(encoded: bytes | memoryview) -> bytes:
    """What the next record holds of this one."""
    return hashlib.sha256(encoded).digest()


def decode_at(data: bytes | memoryview, at: int) -> tuple[Record, int] | None:
    """The record that begins at a place, and where it ends; None when there is no whole and undamaged one.

    Raises
    ------
    CaptureFault
        There is one, undamaged, of another version: nothing may be taken for a torn tail.
    """
    if at + HEAD_BYTES > len(data) or bytes(data[at : at + 4]) != MAGIC:
        return None
    fields = _HEAD.unpack_from(data, at)
    length = fields[-1]
    body_end = at + HEAD_BYTES + length
    if length > MAX_PAYLOAD or body_end + _CRC.size > len(data) or zlib.crc32(data[at:body_end]) != _CRC.unpack_from(data, body_end)[0]:
        return None
    (_, version, kind, stream, run, chunk_no, boot_id, channel, codec, first_seq, count, flags,
     first_us, last_us, first_host_s, last_host_s, utc_offset_s, previous, _) = fields  # fmt: skip
    if version != VERSION:
        raise CaptureFault(
            f"a record of format {version}: this segment was made by a newer version of this program",
            "start the newer version once, it takes the run over; nothing was changed",
        )
    payload = bytes(data[at + HEAD_BYTES : body_end])
    names = (channel.rstrip(b"\0").decode(), codec.rstrip(b"\0").decode())
    numbers = (chunk_no, stream, boot_id, first_seq, count, flags, first_us, last_us)
    record = Record(kind, run, *names, *numbers, first_host_s, last_host_s, utc_offset_s, payload, previous)
    return record, body_end + _CRC.size
