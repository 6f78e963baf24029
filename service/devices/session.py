"""Locks a machine, and opens and closes all its devices together: nothing stays open when one of them fails.

Only one process at a time may use a machine: a second one would move a mounted bar without knowledge of the first. The process that uses
the machine locks a file in a folder shared by all accounts of this computer, including a systemd service with private processes and a
private ``/tmp``.

Every controller status is noted with its arrival time (`notes_since`): many such pairs relate the controller's clock to this computer's.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import sys
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import Any, TypeVar, cast

from abbe.drivers import registry
from abbe.drivers.api import BallBar, Controller, ControllerStatus, DisplacementMeter, Fixture, LaserReading
from abbe.drivers.errors import DriverError
from abbe.service.domain.machine import DeviceUrls as DeviceUrls
from abbe.service.domain.machine import address_of
from abbe.service.errors import AbbeError, ConfigError, DevicesNotReady, MachineInUse, UnsafeToMove
from abbe.service.files import lock_at_once

ENVIRONMENT = "ABBE_LOCK_FOLDER"
"""Environment variable that names another folder for the locks, where the default ones do not work (containers)."""
INSTALLED = Path("/run/abbe")
"""Lock folder for one group, made at boot by deploy/abbe-tmpfiles.conf. Where it exists, an account without access gets an error."""
WITHOUT_INSTALLATION = Path("/tmp/abbe-machines")  # noqa: S108 - the same for all accounts, whatever TMPDIR says
"""Lock folder for every account, used if `INSTALLED` does not exist. A service with a private ``/tmp`` needs `INSTALLED`."""
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
        raise MachineInUse(f"the machine at {url} is in use by {holder}", "wait until the other process has ended") from None
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
        raise UnsafeToMove(f"{folder} is not a folder, so it is unknown whether the machine is in use", "remove this file")
    if found.st_mode & SHARED != SHARED:
        if found.st_uid != os.geteuid():
            raise UnsafeToMove(
                f"{folder} has the mode {stat.S_IMODE(found.st_mode):o}: with it, other accounts cannot make a lock, or can remove one",
                f"as its owner or root, run: chmod {SHARED:o} {folder}",
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
            lock_at_once(handle)
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


MOST = 50_000
KEPT = 500


class _Noted:
    """A controller that also notes the stamp and the arrival of every status."""

    def __init__(self, controller: Controller) -> None:
        self.noted_controller = controller
        self.clock_notes: deque[tuple[int, float]] = deque(maxlen=MOST)
        self.latest_status: ControllerStatus | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.noted_controller, name)

    async def status(self) -> ControllerStatus:
        """Read the status and note its stamp."""
        status = await self.noted_controller.status()
        self.clock_notes.append((status.ctrl_us, status.host_s))
        self.latest_status = status
        return status


def noted(controller: Controller) -> Controller:
    """Wrap a controller to note stamp and arrival of every status."""
    return cast(Controller, _Noted(controller))


def latest_status(controller: Controller) -> ControllerStatus | None:
    """Return the last status read from a controller of `noted`; None before the first, or for other controllers."""
    return controller.latest_status if isinstance(controller, _Noted) else None


class _NotedMeter:
    """A displacement meter that also notes its latest reading."""

    def __init__(self, meter: DisplacementMeter) -> None:
        self.noted_meter = meter
        self.latest_reading: LaserReading | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.noted_meter, name)

    async def read(self, *, after_count: int | None = None) -> LaserReading:
        """Wait for a sample, and note it."""
        self.latest_reading = reading = await self.noted_meter.read(after_count=after_count)
        return reading

    async def peek(self) -> LaserReading:
        """Return the present sample, and note it."""
        self.latest_reading = reading = await self.noted_meter.peek()
        return reading


def noted_meter(meter: DisplacementMeter) -> DisplacementMeter:
    """Wrap a displacement meter to note its latest reading."""
    return cast(DisplacementMeter, _NotedMeter(meter))


def latest_reading(meter: DisplacementMeter) -> LaserReading | None:
    """Return the last reading of a meter of `noted_meter`; None before the first, or for other meters."""
    return meter.latest_reading if isinstance(meter, _NotedMeter) else None


def notes_since(controller: Controller, ctrl_us: int) -> list[list[float]]:
    """Return pairs [controller us, host s] since a controller time. More than 500 are thinned to 500: the least delayed of each group."""
    if not isinstance(controller, _Noted):
        return []
    pairs = [(float(c), h) for c, h in controller.clock_notes if c >= ctrl_us]
    if len(pairs) <= KEPT:
        return [[c, h] for c, h in pairs]
    (c0, h0), (c1, h1) = pairs[0], pairs[-1]
    rate = (h1 - h0) / (c1 - c0) if c1 > c0 else 0.0
    edges = [k * len(pairs) // KEPT for k in range(KEPT + 1)]
    prompt = [min(pairs[a:b], key=lambda p: p[1] - rate * p[0]) for a, b in zip(edges[:-1], edges[1:], strict=True)]  # noqa: RUF007
    return [[c, h] for c, h in prompt]


Ask = Callable[[str], Awaitable[None]]
First = Callable[[Controller], Awaitable[None]]
D = TypeVar("D", Controller, BallBar, DisplacementMeter, Fixture)


@dataclass(frozen=True, slots=True)
class Session:
    """Open devices; the `need` methods refuse a test whose device is missing.

    ``attended``: a person can answer questions at the console. ``recovered``: an interrupted push was finished while opening.
    """

    controller: Controller
    ballbar: BallBar | None
    laser: DisplacementMeter | None
    fixture: Fixture | None
    attended: bool = True
    recovered: bool = False

    def need_ballbar(self) -> BallBar:
        """Return the ball-bar, or raise ConfigError if the machine file names none."""
        if self.ballbar is None:
            raise ConfigError("this test needs a ball-bar, but the machine file names none", "add ballbar = ... under [devices]")
        return self.ballbar

    def need_laser(self) -> DisplacementMeter:
        """Return the laser, or raise ConfigError if the machine file names none."""
        if self.laser is None:
            raise ConfigError("this test needs a laser, but the machine file names none", "add laser = ... under [devices]")
        return self.laser

    def need_fixture(self) -> Fixture:
        """Return the fixture, or raise ConfigError if the machine file names none."""
        if self.fixture is None:
            raise ConfigError("no fixture is configured to mount the instrument", 'add fixture = "fixture+console:" under [devices]')
        return self.fixture


async def no_console(text: str) -> None:
    """Raise ConfigError with the question, because nobody is at the console to answer it."""
    raise ConfigError(f"no one is at the console, but a person has to act: {text}", "run this test attended, or configure a remote fixture")


@asynccontextmanager
async def open_session(
    urls: DeviceUrls, ask: Ask = no_console, *, first: First | None = None, listening: bool = False
) -> AsyncIterator[Session]:
    """Open and identify every configured device; always close all of them at the end.

    ``ask`` asks the person at the console. ``first`` runs on the open controller before any other device is opened
    (`abbe.service.compensation.recover`); its errors end the session. ``listening``: an operator moves the machine, so the control need not
    be connected (`registry.no_controller`).

    Raises
    ------
    ConfigError
        No controller configured.
    DriverError
        A device cannot be opened or does not follow its protocol.
    DevicesNotReady
        Several devices failed; all are tried, and named in one line.
    """
    if urls.cnc is None and not listening:
        raise ConfigError("no controller configured", "add cnc = ... under [devices] of the machine file")
    async with AsyncExitStack() as stack:
        troubles: list[DriverError] = []

        async def opened(device: Awaitable[D]) -> D | None:
            try:
                found = await device
            except DriverError as error:
                troubles.append(error)
                return None
            stack.push_async_callback(found.close)
            return found

        found = registry.no_controller() if urls.cnc is None else await opened(registry.open_controller(urls.cnc))
        controller = None if found is None else noted(found)
        if controller is not None and first is not None:
            await first(controller)
        ballbar = None if urls.ballbar is None else await opened(registry.open_ballbar(urls.ballbar))
        laser = None if urls.laser is None else await opened(registry.open_laser(urls.laser))
        fixture = None if urls.fixture is None else await opened(registry.open_fixture(urls.fixture, ask))
        raise_all(troubles)
        assert controller is not None
        yield Session(controller, ballbar, None if laser is None else noted_meter(laser), fixture, ask is not no_console)


def raise_all(troubles: Sequence[AbbeError | DriverError]) -> None:
    """Raise a single device error as it is, several as one DevicesNotReady."""
    if len(troubles) == 1:
        raise troubles[0]
    if troubles:
        raise DevicesNotReady("; ".join(str(error) for error in troubles), "nothing has moved")
