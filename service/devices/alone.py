"""One process a machine: two that command the same axes would each drive a bar that the other believes elsewhere."""

from __future__ import annotations

import fcntl
import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import UnsafeToMove


@contextmanager
def alone(url: str | None) -> Iterator[None]:
    """Hold the machine behind a controller's URL for this process. It is given back when the process ends, however it ends.

    Processes of one user on one computer are kept apart; nobody else is.

    Raises
    ------
    UnsafeToMove
        Another process, or another job of this one, has it.
    """
    if url is None:
        yield
        return
    path = _folder() / f"{hashlib.sha256(url.partition('?')[0].encode()).hexdigest()[:16]}.lock"
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            raise UnsafeToMove(f"the machine at {url} is in use by {who}", "wait until it has ended") from None
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} ({' '.join([Path(sys.argv[0]).name, *sys.argv[1:2]])})\n".encode()[:200], 0)
        yield
    finally:
        os.close(handle)


def _folder() -> Path:
    """The user's runtime folder, which does not outlive a restart; where there is none, one of his own among the temporary files.

    Raises
    ------
    UnsafeToMove
        It belongs to somebody else.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) / "abbe" if runtime and os.access(runtime, os.W_OK) else Path(tempfile.gettempdir()) / f"abbe-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise UnsafeToMove(f"{folder} is not yours, so nobody can say whether the machine is in use", "remove it, or set XDG_RUNTIME_DIR")
    return folder
