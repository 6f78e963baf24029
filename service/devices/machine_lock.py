"""One process per machine: of two that command the same axes, each would drive a bar that the other believes elsewhere.

The process that uses the machine locks a file in a folder shared by all accounts of this computer, including a systemd service with private
processes and a private ``/tmp``.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex

from abbe.service.devices.urls import address_of
from abbe.service.errors import MachineInUse, UnsafeToMove

ENVIRONMENT = "ABBE_LOCK_FOLDER"
"""Environment variable with another folder, for computers or containers where the default ones do not work."""
INSTALLED = Path("/run/abbe")
"""Made at boot by deploy/abbe-tmpfiles.conf, for a group. If it exists, it is the only choice; an account without access gets an error."""
WITHOUT_INSTALLATION = Path("/tmp/abbe-machines")  # noqa: S108 - the same for all accounts, whatever TMPDIR says
"""Open to every account. A service with a private ``/tmp`` needs the other one."""
SHARED = 0o1777
"""Mode of a folder in which every account may create files and remove only its own."""
TRIES = 100


@contextmanager
def lock_machine(url: str | None) -> Iterator[None]:
    """Lock the machine behind a controller's URL for this process. The end of the process, of any kind, releases the lock.

    The lock separates processes of all accounts on one computer that use the same URL. It does not cover other computers.

    Raises
    ------
    MachineInUse
        Another process, or another job of this one, has the lock.
    UnsafeToMove
        The lock cannot be opened, so it is unknown whether the machine is in use.
    """
    if url is None:
        yield
        return
    path = lock_folder() / f"{hashlib.sha256(address_of(url).encode()).hexdigest()[:16]}.lock"
    try:
        handle = _locked(path)
    except OSError as error:
        raise UnsafeToMove(
            f"it is unknown whether the machine at {url} is in use: {path} cannot be used ({error.strerror})", _remedy(path.parent)
        ) from None
    except _AlreadyLocked as holder:
        raise MachineInUse(f"the machine at {url} is in use by {holder}", "wait until it has ended") from None
    try:
        with suppress(OSError):  # the lock is held; on a full disk only the holder's name is missing
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"process {os.getpid()} ({' '.join([Path(sys.argv[0]).name, *sys.argv[1:2]])})\n".encode()[:200], 0)
        yield
    finally:
        os.close(handle)


def lock_folder() -> Path:
    """Return the folder of the machine locks: ``ABBE_LOCK_FOLDER``, else ``/run/abbe`` if it exists, else a temporary folder.

    Raises
    ------
    UnsafeToMove
        The accounts of this computer cannot share the temporary folder.
    """
    given = os.environ.get(ENVIRONMENT)
    if given:
        return Path(given)
    if INSTALLED.is_dir():
        return INSTALLED
    try:
        return _shared(WITHOUT_INSTALLATION)
    except OSError as error:
        raise UnsafeToMove(
            f"it is unknown whether the machine is in use: {WITHOUT_INSTALLATION} cannot be used ({error.strerror})",
            _remedy(WITHOUT_INSTALLATION),
        ) from None


def _shared(folder: Path) -> Path:
    """Make a folder for all accounts, or check that the existing one protects their files from each other."""
    with suppress(FileExistsError):
        folder.mkdir()
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise UnsafeToMove(f"{folder} is not a folder, so it is unknown whether the machine is in use", "remove it")
    if found.st_mode & SHARED != SHARED:
        if found.st_uid != os.geteuid():
            raise UnsafeToMove(
                f"{folder} has the mode {stat.S_IMODE(found.st_mode):o}: the lock of a machine could not be made there, or be taken away",
                f"let its owner or root do: chmod {SHARED:o} {folder}",
            )
        folder.chmod(SHARED)
    return folder


class _AlreadyLocked(Exception):  # noqa: N818 - a state, not an error
    """Another process holds the lock; the text names it."""


def _locked(path: Path) -> int:
    """Open and lock a file; retry if it was removed from its path in between, because such a lock protects nothing."""
    for _ in range(TRIES):
        handle = _opened(path)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except BlockingIOError:
            who = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise _AlreadyLocked(who) from None
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)
    raise OSError(0, "it is removed again and again")


def _opened(path: Path) -> int:
    """Open the lock file of a machine; create it atomically with the rights of its folder if it is missing."""
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    with suppress(FileNotFoundError):
        return _plain(os.open(path, flags))
    new = path.with_name(f".{path.name}.{token_hex(6)}")
    handle = os.open(new, flags | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.fchmod(handle, 0o600 | path.parent.stat().st_mode & 0o066)
        with suppress(FileExistsError):  # another process was faster: the lock is its file
            os.link(new, path)
    finally:
        os.close(handle)
        new.unlink()
    return _plain(os.open(path, flags))


def _plain(handle: int) -> int:
    """Return the handle of a regular file; refuse anything else (a FIFO)."""
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return handle
    os.close(handle)
    raise OSError(errno.EINVAL, "it is not a plain file")


def _remedy(folder: Path) -> str:
    with suppress(OSError):
        if folder.stat().st_mode & 0o020 and not folder.stat().st_mode & 0o002:
            return f"{folder} is for a group: become a member of it, see docs/how-to/serve.md"
    return f"make {folder} writable for all users of the machine, or name another folder by {ENVIRONMENT}; see docs/how-to/serve.md"
