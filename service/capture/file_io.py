"""File operations of the segment log, as a port, so that tests can make each of them fail or stop."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Protocol

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
        """Return when everything written is on the disk."""
        ...

    def truncate(self, handle: int, size: int) -> None:
        """Cut the file back to a size."""
        ...

    def close(self, handle: int) -> None:
        """Close the handle."""
        ...

    def sync_folder(self, folder: Path) -> None:
        """Return when the folder's entries are on the disk."""
        ...

    def hold_space(self, path: Path, size: int) -> None:
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
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    def append(self, handle: int, data: bytes) -> None:
        """Write all bytes at the end."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(handle, rest) :]

    def sync(self, handle: int) -> None:
        """Return when everything written is on the disk."""
        os.fdatasync(handle)

    def truncate(self, handle: int, size: int) -> None:
        """Cut the file back to a size."""
        os.ftruncate(handle, size)

    def close(self, handle: int) -> None:
        """Close the descriptor."""
        os.close(handle)

    def sync_folder(self, folder: Path) -> None:
        """Return when the folder's entries are on the disk."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def hold_space(self, path: Path, size: int) -> None:
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
