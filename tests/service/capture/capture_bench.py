"""Samples that say who they are, a run to record them into, and a file system that can run full, break or lose its power."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy import update

from abbe.drivers.api import BarBatch, BarSample
from abbe.service.capture.ledger import Drafter
from abbe.service.capture.segment import RealFileIO, Segment
from abbe.service.storage.store import Store
from abbe.service.storage.tables import runs

SYNC = 8


def reading(seq: int) -> int:
    return (seq * 7919) % 2_000_001 - 1_000_000


def samples(first: int, count: int, status: int = SYNC) -> tuple[BarSample, ...]:
    return tuple(BarSample(k, 1000 * (k + 1), reading(k), status) for k in range(first, first + count))


def batch(first: int, count: int, missing: int = 0, host_s: float = 0.0, status: int = SYNC) -> BarBatch:
    return BarBatch(host_s or first * 1e-3, samples(first, count, status), missing, boot_id=0xCAFE)


def assert_true(found: Iterable[BarSample]) -> None:
    """Every sample is what was sent under its number."""
    for one in found:
        assert (one.device_us, one.reading_nm) == (1000 * (one.seq + 1), reading(one.seq))


def new_run(store: Store, label: str = "r01") -> int:
    machine = store.machines.add("VMC-1", {"name": "VMC-1"})
    names = {one.name: one.id for one in store.campaigns.all()}
    campaign = names.get("c1") or store.campaigns.add(machine, "c1", {})
    return store.runs.start(campaign, label, "ballbar_helix", "identify", {})


class JumpingClock:
    """A wall clock that somebody sets back and forth by a year."""

    def __init__(self, jumps: bool) -> None:
        self._jumps, self._calls = jumps, 0

    def monotonic_s(self) -> float:
        return 1000.0

    def utc(self) -> datetime:
        self._calls += 1
        jump = timedelta(days=365 * (self._calls % 3 - 1)) if self._jumps else timedelta()
        return datetime(2026, 11, 21, tzinfo=UTC) + jump

    async def sleep(self, s: float) -> None:
        raise AssertionError(s)


class SmallDisk(RealFileIO):
    """A disk with so many bytes; a write beyond them leaves a part behind. The reserve counts."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._held = 0

    def append(self, handle: int, data: bytes) -> None:
        if len(data) > self.room:
            os.write(handle, data[: self.room])
            self.room = 0
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.room -= len(data)
        super().append(handle, data)

    def truncate(self, handle: int, size: int) -> None:
        self.room += os.fstat(handle).st_size - size
        super().truncate(handle, size)

    def reserve_space(self, path: Path, size: int) -> None:
        if size > self.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.room, self._held = self.room - size, size

    def remove(self, path: Path) -> None:
        if path.name == "reserve":
            self.room, self._held = self.room + self._held, 0
        super().remove(path)


class BrokenDisk(RealFileIO):
    """Does one thing wrong, once, at the n-th time it is asked to."""

    def __init__(self, operation: str, number: int, at: int) -> None:
        self._operation, self._number, self._left = operation, number, at
        self.calls: list[str] = []

    def _step(self, operation: str) -> None:
        self.calls.append(operation)
        if operation == self._operation:
            self._left -= 1
            if self._left == 0:
                raise OSError(self._number, os.strerror(self._number))

    def create(self, path: Path) -> int:
        self._step("create")
        return super().create(path)

    def append(self, handle: int, data: bytes) -> None:
        self._step("append")
        super().append(handle, data)

    def sync(self, handle: int) -> None:
        self._step("sync")
        super().sync(handle)

    def sync_folder(self, folder: Path) -> None:
        self._step("sync_folder")
        super().sync_folder(folder)


def abandon(store: Store, run_id: int) -> None:
    """As if the process that writes this run had been killed."""
    store.commit(lambda connection: connection.execute(update(runs).where(runs.c.id == run_id).values(owner_start="killed")))


class Tape(RealFileIO):
    """A file system in memory that remembers every operation, in order, to be replayed up to any of them."""

    def __init__(self) -> None:
        self.operations: list[tuple[str, bytes]] = []

    def create(self, path: Path) -> int:
        self.operations.append(("create", b""))
        return 1

    def append(self, handle: int, data: bytes) -> None:
        self.operations.append(("append", data))

    def sync(self, handle: int) -> None:
        self.operations.append(("sync", b""))

    def sync_folder(self, folder: Path) -> None:
        self.operations.append(("sync_folder", b""))

    def close(self, handle: int) -> None:
        self.operations.append(("close", b""))

    def reserve_space(self, path: Path, size: int) -> None:
        pass


def segment_bytes(run_id: int, groups: Iterable[Iterable[BarBatch]], *, closed: bool = False, label: str = "r01") -> bytes:
    """What a capture of these batches writes, a group a sync."""
    tape = Tape()
    segment, drafter = Segment(tape, Path("x")), Drafter(run_id, lambda: 0.0)
    segment.append([drafter.opening({"label": label})])
    for group in groups:
        segment.append(drafter.drafts([(0, one) for one in group]))
    if closed:
        segment.append([drafter.closing({"status": "complete"})])
    return b"".join(data for operation, data in tape.operations if operation == "append")
