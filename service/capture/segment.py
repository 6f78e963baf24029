"""The append-only file of one run: records chained by their hashes, on the disk when `append` returns."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from abbe.service.capture.file_io import FileIO
from abbe.service.capture.records import NO_HASH, Record, digest, encode
from abbe.service.errors import CaptureFault, DiskFull

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


class Segment:
    """Writes one segment.

    After an error of the disk the file is left alone for good: what a failed sync has dropped, a second one would claim to have written.

    Parameters
    ----------
    io : FileIO
        Where files are.
    path : Path
        The file; it must not exist.

    Raises
    ------
    DiskFull, CaptureFault
        It cannot be made.
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
                self.close()  # else its lock would outlive it
            raise fault(path, "make", error) from error

    def append(self, records: Sequence[Record]) -> list[tuple[int, int]]:
        """Write records and wait until they are on the disk; returns offset and length of each.

        Raises
        ------
        DiskFull
            No room. The file is as it was before; the same records may be appended again once there is room.
        CaptureFault
            Anything else, also no room at the sync. Nothing can be appended any more.
        """
        if self.dead:
            raise CaptureFault(f"{self.path}: an earlier error of the disk ended this file")
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
        """Give the file back. Closing twice does nothing.

        Raises
        ------
        DiskFull, CaptureFault
            The disk reports an error only now.
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
            raise CaptureFault(f"{self.path}: sync: {error.strerror or error}", _DISK) from error

    def _cut_back(self) -> None:
        try:
            self._io.truncate(self._handle, self.size)
        except OSError:
            self.dead = True


_DISK = "look at the disk and at the system's log; what was acknowledged before is kept"


def fault(path: Path, what: str, error: OSError) -> CaptureFault | DiskFull:
    """An error of the disk in the words of the job."""
    if error.errno in NO_SPACE:
        return DiskFull(f"{path}: {what}: no space left on the disk", "free disk space, then measure this test again")
    return CaptureFault(f"{path}: {what}: {error.strerror or error}", _DISK)
