"""Read files from outside Abbe: plain files only, up to a size limit."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

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


def read_plain(path: Path, most: int) -> bytes:
    """Read a whole file from outside Abbe. A link counts as its target.

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
        raise NotPlainError(errno.EAGAIN, "it has nothing to read yet: no plain file", str(path))
    if len(content) > most:
        size = f"{most >> 20} MiB" if most >> 20 else f"{most} bytes"
        raise NotPlainError(errno.EFBIG, f"it is larger than {size}", str(path))
    return bytes(content)


def is_plain(path: Path) -> bool:
    """Return whether a path is itself a plain file or folder, not a link to one."""
    return stat.S_IFMT(os.lstat(path).st_mode) in {stat.S_IFREG, stat.S_IFDIR}


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise NotPlainError(errno.EINVAL, f"it is {kind}, expected a plain file", str(path))
