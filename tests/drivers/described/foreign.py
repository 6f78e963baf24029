"""A displacement meter with a map of its own: `foreign_meter.c`, compiled with libmodbus, and the world that it measures."""

from __future__ import annotations

import mmap
import select
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.patience import within

HERE = Path(__file__).parent
HEADER = Path("/usr/include/modbus/modbus.h")
FILE = HERE / "foreign-meter.toml"
FIELDS = ("pulses", "ms", "stuck", "state", "high_first", "n")
BYTES = 65536
PER_MM = -100_000
"""Pulses per mm: 10 nm each, and they grow when the target comes nearer."""


class World:
    """Memory shared with the meter: what it will read."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(bytes(BYTES))
        self.path = path
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), BYTES)

    def set(self, **fields: int) -> None:
        for name, value in fields.items():
            struct.pack_into("<i" if name == "pulses" else "<I", self._memory, 4 * FIELDS.index(name), value)

    def move_to(self, mm: float) -> None:
        self.set(pulses=round(PER_MM * mm))

    def run(self, track: Sequence[tuple[float, float]]) -> None:
        """From now on the target follows a track (s, mm), at 40 ms a reading."""
        now_ms = struct.unpack_from("<I", self._memory, 4 * FIELDS.index("ms"))[0]
        begin_ms = now_ms or round(1000 * time.monotonic()) + 100  # its own clock until now
        self.set(n=0)
        for k, (s, mm) in enumerate(track):
            struct.pack_into("<Ii", self._memory, 4 * len(FIELDS) + 8 * k, begin_ms + round(1000 * s), round(PER_MM * mm))
        self.set(ms=begin_ms, n=len(track))

    def close(self) -> None:
        self._memory.close()


def put(file: Path, text: str) -> None:
    """Put text into a file that others read: they find the old one or the new one."""
    file.with_name(f"{file.name}.new").write_text(text)
    file.with_name(f"{file.name}.new").replace(file)


class LineWorld:
    """What the scale of `foreign_scale.pl` will read, in a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.move_to(0.0)

    def move_to(self, mm: float) -> None:
        put(self.path, f"at {mm}\n")

    def run(self, track: Sequence[tuple[float, float]]) -> None:
        """From now on the target follows a track (s, mm), at 40 ms a reading."""
        put(self.path, "track\n" + "".join(f"{s:.4f} {mm:.7f}\n" for s, mm in track))

    async def person(self, text: str) -> None:
        """Somebody beside the scale, who does what he is asked."""
        if text.startswith("Block"):
            put(self.path, "lost\n")
        else:
            self.move_to(10.0 if "AWAY" in text else 0.0)


def compiled(folder: Path) -> Path | None:
    """The meter's program, if there is a compiler and libmodbus."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not HEADER.exists():
        return None
    program = folder / "foreign_meter"
    subprocess.run([compiler, "-O1", "-o", program, HERE / "foreign_meter.c", "-lmodbus"], check=True, capture_output=True, timeout=60)
    return program


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def program(*words: str, ready: str = "") -> Iterator[subprocess.Popen[str]]:
    """A program that runs in this block; with ``ready`` it has said so."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        if ready:
            assert process.stdout.readline().strip() == ready
        yield process
    finally:
        process.terminate()
        process.wait(timeout=within(10))
        assert process.stdout is not None
        process.stdout.close()


@contextmanager
def serial_pair(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Two joined ptys of socat."""
    ours, theirs = folder / "ours", folder / "theirs"
    with program("socat", f"pty,raw,echo=0,link={ours}", f"pty,raw,echo=0,link={theirs}"):
        wait_for(lambda: ours.exists() and theirs.exists(), "ptys of socat")
        yield ours, theirs


def listens(port: int) -> bool:
    """Whether somebody listens on a port of 127.0.0.1; connecting would use up a server for one client."""
    return f"0100007F:{port:04X} 00000000:0000 0A" in Path("/proc/net/tcp").read_text()


def wait_for(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + within(10)
    while not condition():
        assert time.monotonic() < end, f"not within 10 s: {what}"
        select.select([], [], [], 0.01)
