"""What every test gets: the shared material, a way to demand a tool, and guards against what a test must not leave behind or reach.

``ABBE_TEST_REQUIRE`` is a comma list of things that have to be there (``chromium,mosquitto,socat,mbpoll,qpdf,libmodbus,postgresql,rs274,
linuxcnc,shared``).
A test that misses one of them fails; without the variable it is skipped and says why.
"""

from __future__ import annotations

import asyncio
import errno
import gc
import inspect
import ipaddress
import os
import shutil
import signal
import socket
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.built_once import _commands_built_once, _schema_built_once, solved_once  # noqa: F401 - fixtures of every test

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
settings.register_profile(  # how fast an example is drawn or passes says something of the computer, nothing of the product
    "fixed",
    derandomize=True,
    database=None,
    max_examples=100 if LONG else 40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("fixed")  # a test that fails must fail again: hypothesis draws the same examples in every run

ROOT = Path(__file__).resolve().parents[1]
RUN_MARK = f"ABBE_TEST_RUN={os.getpid()}"
MEMORY, ROOM_BYTES = Path("/dev/shm"), 4 * 2**30
FREE_BYTES = 6 * 2**30
"""Memory that must be available, too: the size of a file system in memory promises none, and the tests need some beside it."""
Require = Callable[[str, bool, str], None]
POSTGRES = "postgresql://postgres@127.0.0.1:5432/"


def _available_bytes() -> int:
    """Return the memory that programs can still get, 0 where the system does not say so."""
    try:
        told = Path("/proc/meminfo").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in told.splitlines() if line.startswith("MemAvailable:")), 0)


def _runs_from(folder: Path) -> bool:
    """Whether a file system in memory has room for what tests write, the computer has the memory for it, and programs start from it."""
    if not os.access(folder, os.W_OK | os.X_OK) or os.statvfs(folder).f_flag & os.ST_NOEXEC:
        return False
    return shutil.disk_usage(folder).free >= ROOM_BYTES and _available_bytes() >= FREE_BYTES


if "PYTEST_DEBUG_TEMPROOT" not in os.environ and _runs_from(MEMORY):
    # A commit waits 5 to 20 ms for a disk, in all half the time of a run. What a lost sync does is tested with a disk of its own.
    os.environ["PYTEST_DEBUG_TEMPROOT"] = str(MEMORY)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Iterator[None]:
    """What collecting makes stays to the end: without looking through it for garbage, it takes a quarter less time.

    Afterwards garbage is looked for as seldom as in the command (`abbe.service.cli.main`): a tenth of the processor time of all tests.
    """
    gc.disable()
    result = yield
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()
    return result


def _require(name: str, present: bool, reason: str) -> None:
    if present:
        return
    if name in {word.strip() for word in os.environ.get("ABBE_TEST_REQUIRE", "").split(",")}:
        pytest.fail(f"{name} is required here (ABBE_TEST_REQUIRE): {reason}", pytrace=False)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def require() -> Require:
    """``require("socat", shutil.which("socat") is not None, "socat is not installed")``: go on, skip, or fail where it is demanded."""
    return _require


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with specifications, vectors and data beside the repository."""
    path = ROOT.parent / "shared"
    _require("shared", path.is_dir(), "the folder ../shared (vectors, data, examples) is not beside the repository")
    return path


@pytest.fixture(scope="session")
def _postgres_server() -> Iterator[tuple[Any, list[str], list[str]]]:
    """A connection to a real PostgreSQL, the names of the databases made on it, and of those that are empty and free."""
    psycopg = pytest.importorskip("psycopg")
    try:
        server = psycopg.connect(POSTGRES, autocommit=True, connect_timeout=3)
    except psycopg.OperationalError:
        _require("postgresql", False, f"no PostgreSQL at {POSTGRES}")
        return
    made: list[str] = []
    yield server, made, []
    for name in made:
        server.execute(f"DROP DATABASE {name} WITH (FORCE)")
    server.close()


@pytest.fixture
def postgres(_postgres_server: tuple[Any, list[str], list[str]]) -> Iterator[Callable[[], str]]:
    """Give URLs of empty databases. A test's databases are emptied for the next test: before a drop the server writes all its pages."""
    server, made, free = _postgres_server
    taken: list[str] = []

    def make() -> str:
        name = free.pop() if free else f"abbe_test_{uuid.uuid4().hex}"
        taken.append(name)
        if name not in made:
            server.execute(f"CREATE DATABASE {name}")
            made.append(name)
        server.execute(f"ALTER DATABASE {name} SET synchronous_commit = off")  # as above: no test cuts this server's power
        return POSTGRES + name

    yield make
    for name in taken:
        server.execute(f"ALTER DATABASE {name} RESET ALL")
        server.execute("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", (name,))
        with type(server).connect(POSTGRES + name, autocommit=True) as inside:
            inside.execute("DROP SCHEMA public CASCADE")
            inside.execute("CREATE SCHEMA public")
        free.append(name)


# --- asyncio tasks -------------------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def no_task_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail an async test after which a task still runs. Looked at after all other fixtures are down, before the loop is closed."""
    function = inspect.unwrap(getattr(request.node, "obj", lambda: None))
    marker = request.node.get_closest_marker("asyncio")
    own_loop = (marker is None or marker.kwargs.get("loop_scope") in (None, "function")) and inspect.iscoroutinefunction(function)
    if not own_loop:
        yield
        return
    runner: asyncio.Runner = request.getfixturevalue("_function_scoped_runner")
    yield
    left = runner.run(_unfinished())
    if left:
        pytest.fail("tasks left running: " + "; ".join(left), pytrace=False)


async def _unfinished() -> list[str]:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    if not tasks:
        return []
    # Whoever was cancelled in the last line of a test, or serves a connection that was just closed, may still end by himself.
    _, tasks = await asyncio.wait(tasks, timeout=0.3)
    if not tasks:
        return []
    names = sorted(f"{t.get_name()} ({getattr(t.get_coro(), '__qualname__', t.get_coro())})" for t in tasks)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return names


# --- network -------------------------------------------------------------------------------------------------------------------------

_strays: list[str] = []
# Set aside for documentation (RFC 5737, RFC 3849): tests may name them to see an unreachable peer; no packet is sent.
_NOWHERE = [ipaddress.ip_network(n) for n in ("192.0.2.0/24", "198.51.100.0/24", "203.0.113.0/24", "2001:db8::/32")]


def _forbidden(host: object) -> OSError | None:
    """What a socket call to ``host`` ends with; None for this computer."""
    name = host.decode() if isinstance(host, bytes) else str(host or "localhost")
    try:
        address = ipaddress.ip_address(name.partition("%")[0])
    except ValueError:
        if name == "localhost" or name.endswith(".localhost") or name == socket.gethostname():
            return None
        if not name.endswith((".invalid", ".test", ".example")):
            _strays.append(name)
        return socket.gaierror(socket.EAI_NONAME, f"tests may not look up {name}")
    if address.is_loopback or address.is_unspecified:
        return None
    if not any(address in net for net in _NOWHERE):
        _strays.append(name)
    return OSError(errno.ENETUNREACH, f"tests may not reach {name}")


def _guarded(original: Callable[..., Any], address_at: int) -> Callable[..., Any]:
    def call(self: socket.socket, *args: Any) -> Any:
        if self.family in (socket.AF_INET, socket.AF_INET6) and (error := _forbidden(args[address_at][0])):
            raise error
        return original(self, *args)

    return call


def _guarded_lookup(original: Callable[..., Any]) -> Callable[..., Any]:
    def call(host: Any, *args: Any, **options: Any) -> Any:
        if error := _forbidden(host):
            raise error
        return original(host, *args, **options)

    return call


@pytest.fixture(scope="session", autouse=True)
def _only_this_computer() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, address_at in (("connect", 0), ("connect_ex", 0), ("sendto", -1)):
            patch.setattr(socket.socket, name, _guarded(getattr(socket.socket, name), address_at))
        patch.setattr(socket, "getaddrinfo", _guarded_lookup(socket.getaddrinfo))
        yield


@pytest.fixture(autouse=True)
def no_stray_connection() -> Iterator[None]:
    """Fail a test that tried to reach another computer, even when the code under test swallowed the refusal."""
    _strays.clear()
    yield
    if _strays:
        pytest.fail("tried to reach another computer: " + ", ".join(sorted(set(_strays))), pytrace=False)


# --- child processes -----------------------------------------------------------------------------------------------------------------


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def _descendants(pid: int) -> set[int]:
    found: set[int] = set()
    for listing in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = {int(word) for word in listing.read_text().split()}
        except OSError:
            continue
        found |= children.union(*(_descendants(child) for child in children))
    return found


def _simulators(pids: set[int]) -> dict[int, str]:
    # An ended child that nobody waited for has an empty command line: it is not running.
    return {pid: command for pid in sorted(pids) if "simulators" in (command := _command(pid))}


def _orphans() -> set[int]:
    """Processes of this test session that have lost their parent: they carry its mark in their environment."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*/environ"):
        try:
            if RUN_MARK.encode() in entry.read_bytes().split(b"\0"):
                found.add(int(entry.parent.name))
        except OSError:
            continue
    return found - {os.getpid()}


def _end(left: dict[int, str]) -> str:
    for pid in left:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    return "simulators left running: " + "; ".join(f"{pid} {command}" for pid, command in left.items())


@pytest.fixture(autouse=True)
def no_simulator_left() -> Iterator[None]:
    """Fail a test after which a simulator that it started still runs, and end that simulator."""
    before = _descendants(os.getpid())
    yield
    if left := _simulators(_descendants(os.getpid()) - before):
        pytest.fail(_end(left), pytrace=False)


@pytest.fixture(scope="session", autouse=True)
def _no_orphan_left() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(*RUN_MARK.split("="))
        yield
    if left := _simulators(_orphans()):
        pytest.fail("after all tests, " + _end(left), pytrace=False)
