"""Read files from outside Abbe (plain files only, up to a size limit), write or replace a file at once, and lock Abbe's own files."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType

from abbe.service.errors import ConfigError, FileFormatError

PIECE = 1 << 20
"""Bytes per read: a single read of the whole limit would allocate that much memory even for the smallest file."""
_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


class NotPlainError(OSError):
    """The path is not a plain file, or the file is larger than the limit: ``strerror`` says which."""


def file_locks() -> ModuleType:
    """Return the module of file locks.

    Raises
    ------
    ConfigError
        The system has no file locks (Windows); functions that need them cannot work.
    """
    try:
        return import_module("fcntl")  # here: a system without it still plans, reads and solves
    except ImportError:
        raise ConfigError("this system has no file locks: Abbe measures and serves on Linux only", "docs/how-to/windows.md") from None


def lock_at_once(descriptor: int) -> None:
    """Lock an open file for this process.

    Raises
    ------
    BlockingIOError
        Another process holds the lock.
    ConfigError
        The system has no such locks.
    """
    locks = file_locks()
    locks.flock(descriptor, locks.LOCK_EX | locks.LOCK_NB)


def read_plain(path: Path, most: int) -> bytes:
    """Read a whole file from outside Abbe. A link is followed to its target.

    A pipe is not waited for, and a device is not even opened: opening a serial port switches its control lines.

    Parameters
    ----------
    most : int
        Size limit, bytes. The bytes read are counted, whatever size the system reports.

    Raises
    ------
    NotPlainError
        The path is a device, a pipe, a folder ..., or the file is larger than ``most``.
    OSError
        The file cannot be read.
    """
    _check(path, os.stat(path).st_mode)
    with open(path, "rb", opener=_without_waiting) as file:
        _check(path, os.fstat(file.fileno()).st_mode)  # the path may lead to another file by now
        content = bytearray()
        while piece := file.read(min(PIECE, most + 1 - len(content))):
            content += piece
    if piece is None:
        raise NotPlainError(errno.EAGAIN, "it waits for data, expected a plain file", str(path))
    if len(content) > most:
        size = f"{most >> 20} MiB" if most >> 20 else f"{most} bytes"
        raise NotPlainError(errno.EFBIG, f"it is larger than {size}", str(path))
    return bytes(content)


def is_plain(path: Path) -> bool:
    """Return whether a path is itself a plain file or folder, not a link to one."""
    return stat.S_IFMT(os.lstat(path).st_mode) in {stat.S_IFREG, stat.S_IFDIR}


def replace_file(path: Path, body: bytes) -> None:
    """Replace a file: after a power cut it is the old or the new one, never a part. Its rights, and where possible its owner, stay.

    A link stays a link: the file that it leads to is replaced. Raises OSError: the old file is untouched. A folder that cannot be
    flushed is no error: the new file is in place, and a power cut in the next seconds may bring the old one back.
    """
    target = path.resolve()
    known = target.stat()

    def rights_of_old(new: int, _: Path) -> None:
        os.fchmod(new, known.st_mode & 0o7777)
        with suppress(OSError):  # only root gives a file to another owner
            os.fchown(new, -1, known.st_gid)
            os.fchown(new, known.st_uid, -1)

    _swap_in(body, target, rights_of_old)
    with suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_page(text: str | bytes, target: Path) -> None:
    """Write a page (or the bytes of a PDF) to a temporary file and rename it: a reader sees the old file or the whole new one.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    try:
        if target.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        body = text.encode() if isinstance(text, str) else text
        _swap_in(body, target, lambda _, new: new.chmod(0o644))  # mkstemp creates private files
    except OSError as error:
        raise FileFormatError(f"{target}: cannot be written: {error.strerror}", "give a file in a writable folder") from None


def _swap_in(body: bytes, target: Path, give_rights: Callable[[int, Path], None]) -> None:
    """Write a file beside the target, flush it and rename it. Raises OSError: the target is untouched.

    ``give_rights``: sets rights and owner of the new file, given as open descriptor and path.
    """
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".new", dir=target.parent)  # a new file, never one behind a link
    beside = Path(name)
    try:
        with open(handle, "wb") as file:
            give_rights(file.fileno(), beside)
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(target)
    except OSError:
        with suppress(OSError):
            beside.unlink()
        raise


def may_replace(path: Path) -> bool:
    """Return whether this process could replace a file now."""
    return os.access(path.resolve().parent, os.W_OK)


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise NotPlainError(errno.EINVAL, f"it is {kind}, expected a plain file", str(path))
