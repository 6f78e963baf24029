"""The append-only file of one run: records chained by their hashes, on the disk when `append` returns.

The module also holds the file operations as a port (`FileIO`), which tests can make fail or stop; the encoding of records; the reserve
of disk space for closing a run on a full disk; and the scan that finds the valid part of a file.
"""

from __future__ import annotations

import errno
import hashlib
import os
import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from abbe.service.errors import CaptureFault, DiskFull
from abbe.service.files import lock_at_once

_PIECE = 1 << 20


class FileIO(Protocol):
    """File operations of the log. All raise OSError."""

    def create(self, path: Path) -> int:
        """Create a file, refusing an existing one; return a handle, and lock the file until it is closed."""
        ...

    def append(self, handle: int, data: bytes) -> None:
        """Write all bytes at the end."""
        ...

    def sync(self, handle: int) -> None:
        """Wait until everything written is on the disk."""
        ...

    def truncate(self, handle: int, size: int) -> None:
        """Cut the file back to a size."""
        ...

    def close(self, handle: int) -> None:
        """Close the handle."""
        ...

    def sync_folder(self, folder: Path) -> None:
        """Wait until the folder's entries are on the disk."""
        ...

    def reserve_space(self, path: Path, size: int) -> None:
        """Create a file that occupies this many bytes of the disk."""
        ...

    def remove(self, path: Path) -> None:
        """Delete a file if it exists."""
        ...


class RealFileIO:
    """The file system of this computer."""

    def create(self, path: Path) -> int:
        """Create a file, refusing an existing one; return a descriptor, whose lock shows other processes a running recording."""
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        try:
            lock_at_once(descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    def append(self, handle: int, data: bytes) -> None:
        """Write all bytes at the end."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(handle, rest) :]

    def sync(self, handle: int) -> None:
        """Wait until everything written is on the disk."""
        os.fdatasync(handle)

    def truncate(self, handle: int, size: int) -> None:
        """Cut the file back to a size."""
        os.ftruncate(handle, size)

    def close(self, handle: int) -> None:
        """Close the descriptor."""
        os.close(handle)

    def sync_folder(self, folder: Path) -> None:
        """Wait until the folder's entries are on the disk."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def reserve_space(self, path: Path, size: int) -> None:
        """Create a file that occupies this many bytes of the disk."""
        if path.exists() and path.stat().st_size == size:
            return
        part = path.with_suffix(f".{os.getpid()}")
        try:
            with part.open("wb") as file:
                for at in range(0, size, _PIECE):  # written, not only sized: a sparse file reserves nothing
                    file.write(bytes(min(_PIECE, size - at)))
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def remove(self, path: Path) -> None:
        """Delete a file if it exists."""
        path.unlink(missing_ok=True)


NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


class Segment:
    """Writes one segment to a new file.

    After a disk error the file is never written again: a second sync would report success for data that the failed one dropped.

    Raises
    ------
    DiskFull, CaptureFault
        The file exists or cannot be created.
    """

    def __init__(self, io: FileIO, path: Path) -> None:
        self.path = path
        self.size = 0
        self.records = 0
        self.head = NO_HASH
        self.dead = False
        self._io = io
        self._handle = -1
        try:
            self._handle = io.create(path)
            io.sync_folder(path.parent)
        except OSError as error:
            with suppress(CaptureFault, DiskFull):
                self.close()  # releases the lock
            raise fault(path, "create the segment", error) from error

    def append(self, records: Sequence[Record]) -> list[tuple[int, int]]:
        """Write records and wait until they are on the disk; return offset and length of each.

        Raises
        ------
        DiskFull
            No room. The file is unchanged, and the same records may be appended once there is room.
        CaptureFault
            Any other error, including no room at the sync. The segment accepts nothing more.
        """
        if self.dead:
            raise CaptureFault(f"{self.path}: a disk error ended this file earlier")
        head, at, pieces, places = self.head, self.size, [], []
        for record in records:
            encoded = encode(replace(record, previous=head))
            head = digest(encoded)
            places.append((at, len(encoded)))
            at += len(encoded)
            pieces.append(encoded)
        self._write(b"".join(pieces))
        self.head, self.size = head, at
        self.records += len(records)
        return places

    def close(self) -> None:
        """Close the file. Closing twice does nothing.

        Raises
        ------
        DiskFull, CaptureFault
            The disk reports a delayed error.
        """
        handle, self._handle = self._handle, -1
        if handle >= 0:
            self.dead = True
            try:
                self._io.close(handle)
            except OSError as error:
                raise fault(self.path, "close", error) from error

    def _write(self, data: bytes) -> None:
        try:
            self._io.append(self._handle, data)
        except OSError as error:
            if error.errno in NO_SPACE:
                self._cut_back()
            else:
                self.dead = True
            raise fault(self.path, "write", error) from error
        try:
            self._io.sync(self._handle)
        except OSError as error:
            self.dead = True
            raise CaptureFault(f"{self.path}: cannot sync to the disk: {error.strerror or error}", _DISK) from error

    def _cut_back(self) -> None:
        try:
            self._io.truncate(self._handle, self.size)
        except OSError:
            self.dead = True


_DISK = "look at the disk and at the system's log; everything acknowledged before is kept"


def fault(path: Path, what: str, error: OSError) -> CaptureFault | DiskFull:
    """Convert a disk error to DiskFull or CaptureFault; ``what``: the failed action, as a verb."""
    if error.errno in NO_SPACE:
        return DiskFull(f"{path}: cannot {what}: no space left on the disk", "free disk space, then measure this test again")
    return CaptureFault(f"{path}: cannot {what}: {error.strerror or error}", _DISK)


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
    chunk_no : int
        Number in its channel, from 0.
    stream : int
        Number of the stream in the run; sequence numbers begin anew in each stream.
    boot_id : int
        Boot id of the device, 0 if it has none.
    first_seq, count : int
        First sequence number and number of samples.
    flags : int
        Union of the samples' status bits.
    first_us, last_us : int
        Device clock of the first and the last sample.
    first_host_s, last_host_s : float
        Monotonic host time of the first and the last arrival.
    utc_offset_s : float
        UTC minus monotonic host time by this computer's clock; no sample time depends on it.
    payload : bytes
        Packed samples, or JSON.
    previous : bytes
        SHA-256 of the previous record in the file.
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
    """Encode a record."""
    r = record
    head = _HEAD.pack(
        MAGIC, VERSION, r.kind, r.stream, r.run, r.chunk_no, r.boot_id, r.channel.encode(), r.codec.encode(), r.first_seq, r.count, r.flags,
        r.first_us, r.last_us, r.first_host_s, r.last_host_s, r.utc_offset_s, r.previous, len(r.payload),
    )  # fmt: skip
    body = head + r.payload
    return body + _CRC.pack(zlib.crc32(body))


def digest(encoded: bytes | memoryview) -> bytes:
    """Return the SHA-256 of an encoded record, for the next record."""
    return hashlib.sha256(encoded).digest()


def decode_at(data: bytes | memoryview, at: int) -> tuple[Record, int] | None:
    """Return the record at an offset, and the offset of its end; None if no whole, undamaged record begins there.

    Raises
    ------
    CaptureFault
        The record is undamaged but of another version, so it must not count as a torn tail.
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
            f"a record has format {version}: this segment was made by a newer version of this program",
            "start the newer version once: it recovers the run; nothing was changed",
        )
    payload = bytes(data[at + HEAD_BYTES : body_end])
    names = (channel.rstrip(b"\0").decode(), codec.rstrip(b"\0").decode())
    numbers = (chunk_no, stream, boot_id, first_seq, count, flags, first_us, last_us)
    record = Record(kind, run, *names, *numbers, first_host_s, last_host_s, utc_offset_s, payload, previous)
    return record, body_end + _CRC.size


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes between good records that are not a record: flipped bits, or a lost sector."""

    offset: int
    length: int
    before: int
    """Number of good records before the damage."""


@dataclass(frozen=True, slots=True)
class Scan:
    """Content of a segment.

    Parameters
    ----------
    records : list of Record
        All undamaged records, in order.
    damaged : list of Damage
        Damage followed by good records.
    good_bytes : int
        End of the last good record; later bytes were never acknowledged and may be cut off.
    tail_bytes : int
        Number of these later bytes.
    broken_links : list of int
        Indices of records whose ``previous`` is not the hash of the record before: a record was removed, inserted or changed.
    head : bytes
        SHA-256 of the last good record.
    """

    records: list[Record] = field(default_factory=list)
    damaged: list[Damage] = field(default_factory=list)
    good_bytes: int = 0
    tail_bytes: int = 0
    broken_links: list[int] = field(default_factory=list)
    head: bytes = NO_HASH

    @property
    def closed(self) -> bool:
        """Whether the run ended in order."""
        return bool(self.records) and self.records[-1].kind == CLOSE

    @property
    def whole(self) -> bool:
        """Whether every byte is part of one unbroken chain."""
        return not (self.damaged or self.tail_bytes or self.broken_links)


def scan(data: bytes | memoryview) -> Scan:
    """Find every good record of a segment.

    A bad record ends the search only if no good one follows: this distinguishes a torn tail from damage in the middle, and keeps every good
    record in both cases.
    """
    records: list[Record] = []
    damaged: list[Damage] = []
    broken: list[int] = []
    at, expected = 0, NO_HASH
    while True:
        found = decode_at(data, at)
        start = at
        if found is None:
            start = _next_good(data, at + 1)
            if start < 0:
                return Scan(records, damaged, at, len(data) - at, broken, expected)
            damaged.append(Damage(at, start - at, len(records)))
            found = decode_at(data, start)
            assert found is not None
        record, end = found
        if start == at and record.previous != expected:
            broken.append(len(records))
        records.append(record)
        expected, at = digest(data[start:end]), end


def _next_good(data: bytes | memoryview, at: int) -> int:
    """Return the offset of the next undamaged record, or -1."""
    rest = bytes(data[at:])
    found = rest.find(MAGIC)
    while found >= 0:
        if decode_at(rest, found) is not None:
            return at + found
        found = rest.find(MAGIC, found + 1)
    return -1


class Reserve:
    """Disk space reserved by a file of ``size`` bytes in the folder of the segments."""

    def __init__(self, io: FileIO, folder: Path, size: int) -> None:
        self._io, self._folder, self._size = io, folder, size
        self._path = folder / "reserve"
        self._allocated = False

    def allocate(self) -> None:
        """Create the file unless its size is 0.

        Raises
        ------
        DiskFull, CaptureFault
            There is no room: no recording should begin.
        """
        if not self._size:
            return
        try:
            self._io.reserve_space(self._path, self._size)
            self._io.sync_folder(self._folder)
        except OSError as error:
            raise fault(self._path, "reserve disk space", error) from error
        self._allocated = True

    def release(self) -> bool:
        """Free the space; False if it is already free or cannot be freed."""
        if not self._allocated:
            return False
        self._allocated = False
        try:
            self._io.remove(self._path)
            self._io.sync_folder(self._folder)
        except OSError:
            return False
        return True
