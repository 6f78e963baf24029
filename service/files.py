"""Files that others made: read only if they are plain files, and never more than was agreed."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

PIECE = 1 << 20
"""So much is asked for at once: a buffer of the longest file that is allowed would be made for the shortest."""
_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


class NotPlainError(OSError):
    """It is no plain file, or a longer one than is read: ``strerror`` says which."""


def read_plain(path: Path, most: int) -> bytes:
    """Read a whole file that somebody else may have put there. A link counts as what it leads to.

    A pipe is not waited for, a device not even opened: opening a serial port moves its lines.

    Parameters
    ----------
    path : Path
        The file.
    most : int
        Longest file that is read, bytes: those that come are counted, whatever the system says of its size.

    Raises
    ------
    NotPlainError
        It is a device, a pipe, a folder ..., or longer than that.
    OSError
        It cannot be read.
    """
    _check(path, os.stat(path).st_mode)
    with open(path, "rb", opener=_without_waiting) as file:
        _check(path, os.fstat(file.fileno()).st_mode)  # another one may lie there by now
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
    """Tell whether a path is a plain file or a plain folder itself, no link to one."""
    return stat.S_IFMT(os.lstat(path).st_mode) in {stat.S_IFREG, stat.S_IFDIR}


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = next((word for is_kind, word in _KINDS if is_kind(mode)), "something else")
        raise NotPlainError(errno.EINVAL, f"it is {kind}, expected a plain file", str(path))
