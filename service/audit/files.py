"""The two files of the audit: made for their owner only, appended to, and refused with words that say whose they are."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from abbe.service.errors import AuditBroken
from abbe.service.storage.private import private_file


def create(path: Path, content: bytes) -> None:
    """Write a new file aside and link it: whoever is second finds the first one's, whole."""
    aside = Path(f"{path}.{secrets.token_hex(4)}")
    file = private_file(aside)
    try:
        os.write(file, content)
        os.fsync(file)
    finally:
        os.close(file)
    try:
        os.link(aside, path)
    except FileExistsError:
        pass
    finally:
        aside.unlink()


def can_create(path: Path) -> None:
    """Raise the error of the system that making this file would end in; leave nothing behind."""
    aside = Path(f"{path}.{secrets.token_hex(4)}")
    os.close(private_file(aside))
    aside.unlink()


def can_append(path: Path) -> None:
    """Raise the error of the system that appending to this file, or making it, would end in; leave nothing behind."""
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_APPEND))
    except FileNotFoundError:
        can_create(path)


def append_line(path: Path, text: str) -> None:
    """Append a line; on return it is on disk. A line before it that a power cut has torn stays by itself."""
    with suppress(FileExistsError):
        os.close(private_file(path))
    file = os.open(path, os.O_RDWR | os.O_APPEND)
    try:
        size = os.fstat(file).st_size
        torn = size > 0 and os.lseek(file, -1, os.SEEK_END) >= 0 and os.read(file, 1) != b"\n"
        line = (b"\n" if torn else b"") + f"{text}\n".encode()
        # One short write at the end of the file: lines of two processes do not mix.
        if os.write(file, line) != len(line):
            raise OSError(errno.ENOSPC, "only a part of the line could be written")
        os.fsync(file)
    finally:
        os.close(file)


def refusal(path: Path, error: OSError) -> AuditBroken:
    """Why a file of the audit cannot be used: what the system says, whose the file is, who asks, and what to do."""
    owner, words = "", ""
    with suppress(OSError, KeyError, NotImplementedError):
        there = path if path.exists() else path.parent
        owner = there.owner()
        words = f" ({'it' if there == path else there} belongs to {owner}, rights {stat.S_IMODE(there.stat().st_mode):04o}{_me()})"
    who = f"run this as {owner}, or give the file" if owner not in {"", "root"} else "give the file"
    return AuditBroken(
        f"the audit cannot be used: {path}: {error.strerror or error}{words}",
        f"{who} to the account of the service (chown) with rights 0600; see docs/how-to/users.md",
    )


def _me() -> str:
    if not hasattr(os, "geteuid"):
        return ""
    import pwd

    number = os.geteuid()
    try:
        return f"; this is {pwd.getpwuid(number).pw_name}"
    except KeyError:
        return f"; this is account {number}"
