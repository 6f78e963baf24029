"""One stream through the whole path while everything around it misbehaves, judged by the box's own ledger."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from abbe.drivers.api import BarBatch, BarTap
from abbe.drivers.ballbar import driver
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import parse_url
from abbe.service.capture.recorder import recording
from abbe.service.capture.recovery import ledger_of
from abbe.service.capture.segment import RealFileIO
from abbe.service.capture.settings import CaptureSettings
from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store

BUSY = "while True: pass"
LOCK = """
import sqlite3, sys, time
other = sqlite3.connect(sys.argv[1], isolation_level=None, timeout=60)
sys.stdin.readline()
other.execute("BEGIN IMMEDIATE")
began_s = time.monotonic()
time.sleep(float(sys.argv[2]))
other.execute("ROLLBACK")
print(time.monotonic() - began_s, flush=True)
"""
RATE_HZ = 1000


@dataclass(frozen=True)
class Load:
    """``speed``: device seconds per second; ``device_s``: length of the stream; ``lock_s``: how long a stranger locks the database.

    ``busy``: processes that do nothing but compute; ``stall_s``: the consumer blocks the event loop so long after each 0.5 s.
    """

    speed: float = 20.0
    device_s: float = 600.0
    lock_s: float = 30.0
    busy: int = 2
    stall_s: float = 0.4
    spoil_every: int = 5000
    sync_s: float = 0.0
    """What a slow disk adds to every sync."""


class SlowDisk(RealFileIO):
    """A disk that takes its time."""

    def __init__(self, sync_s: float) -> None:
        self._sync_s = sync_s

    def sync(self, handle: int) -> None:
        threading.Event().wait(self._sync_s)
        super().sync(handle)


class LagTap:
    """Between driver and recorder: notes when samples arrived, and how long after that they were durable."""

    def __init__(self, tap: BarTap) -> None:
        self._tap = tap
        self._arrived: deque[tuple[int, float]] = deque()
        self.lags_s: list[float] = []

    def take(self, batch: BarBatch) -> None:
        self._arrived.append((batch.samples[-1].seq, batch.host_s))
        self._tap.take(batch)

    def warn(self, text: str) -> None:
        self._tap.warn(text)

    def durable(self, seq: int) -> None:
        now_s = time.monotonic()
        while self._arrived and self._arrived[0][0] <= seq:
            self.lags_s.append(now_s - self._arrived.popleft()[1])


def run_load(folder: Path, load: Load, progress: Callable[[str], None] = lambda text: None) -> dict[str, float]:
    """Stream, record, and compare with the box's ledger."""
    driver._BUFFER_S = 30.0 * max(1.0, load.speed)  # 30 s of wall time, at whatever speed
    return asyncio.run(_run(folder, load, progress))


async def _run(folder: Path, load: Load, progress: Callable[[str], None]) -> dict[str, float]:
    url = f"sqlite:///{folder / 'abbe.sqlite3'}"
    ledger = folder / "ledger.json"
    with Store.open(url) as store, ExitStack() as stack:
        campaign = store.campaigns.add(store.machines.add("M", {"name": "M"}), "load", {})
        run_id = store.runs.start(campaign, "r01", "ballbar_helix", "identify", {})
        box = _child(stack, "-m", "abbe.simulators.ballbar_box", "--link", str(folder / "box"), "--ledger", str(ledger), "--speed",
                     str(load.speed), "--spoil-every", str(load.spoil_every),
                     "--buffer-kib", str(int(64 * max(1.0, load.speed))))  # fmt: skip
        locker = _child(stack, "-c", LOCK, str(folder / "abbe.sqlite3"), str(load.lock_s))
        for _ in range(load.busy):
            _child(stack, "-c", BUSY)
        address = json.loads(await asyncio.to_thread(box.stdout.readline))["ballbar"]
        bar = SerialBallBar(ByteLink(parse_url(address)), ring_s=30.0 * max(1.0, load.speed))
        published: list[LagTap] = []
        began_s, cpu_s = time.monotonic(), time.process_time()
        settings = CaptureSettings(reserve_bytes=1 << 20)
        async with recording(
            store,
            run_id,
            settings,
            SystemClock(),
            io=SlowDisk(load.sync_s) if load.sync_s else None,
            published=lambda channel, stream, seq: [tap.durable(seq) for tap in published],
        ) as recorder:
            published.append(LagTap(recorder.tap()))
            seen = await _consume(bar, published[0], load, locker, progress)
            ended_s = time.monotonic()
            highest = bar._framing.ring.highest
            await bar.close()
            lock_held_s = float(await asyncio.to_thread(locker.stdout.readline) or 0.0) if locker.stdout is not None else 0.0
            if lock_held_s < load.lock_s:
                raise SystemExit(
                    f"the database was locked for {lock_held_s:g} s instead of {load.lock_s:g} s: the figures would mean nothing"
                )
        caught_up_s = time.monotonic() - ended_s
        found = _compare(json.loads(ledger.read_text()), store, run_id)
        lags = sorted(published[0].lags_s)
        return found | {
            "seen_by_consumer": seen,
            "wall_s": ended_s - began_s,
            "cpu_s": time.process_time() - cpu_s,
            "catch_up_s": caught_up_s,
            "lock_held_s": lock_held_s,
            "lag_p50_ms": 1e3 * lags[len(lags) // 2],
            "lag_p99_ms": 1e3 * lags[len(lags) * 99 // 100],
            "lag_max_ms": 1e3 * lags[-1],
            "ring_highest": highest,
        }


async def _consume(bar: SerialBallBar, tap: LagTap, load: Load, locker: subprocess.Popen[str], progress: Callable[[str], None]) -> int:
    """A consumer who blocks the whole event loop again and again."""
    seen, last = 0, -1
    total = int(load.device_s * RATE_HZ)
    stall_at = time.monotonic() + 0.5
    async with bar.stream(RATE_HZ, tap) as batches:
        async for batch in batches:
            seen, last = seen + len(batch.samples), batch.samples[-1].seq
            if locker.stdin is not None and not locker.stdin.closed and last > total / 4:
                locker.stdin.write("go\n")
                locker.stdin.close()
            if time.monotonic() >= stall_at:
                progress(f"{last + 1} of {total} samples, {len(tap.lags_s)} batches durable")
                time.sleep(load.stall_s)  # noqa: ASYNC251, TID251 - this is the slow consumer
                stall_at = time.monotonic() + 0.5
            if last >= total:
                return seen
    raise AssertionError


def _child(stack: ExitStack, *words: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ)

    def end() -> None:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()

    stack.callback(end)
    return process


def _compare(box: list[list[int | str]], store: Store, run_id: int) -> dict[str, float]:
    """Sets of sequence numbers: the box's against ours."""
    ours = ledger_of(store.chunks.of_run(run_id))
    sent, lost = bytearray(), set()
    fates = {"sent": 0, "suppressed": 0, "corrupted": 0}
    for _, first, last, fate in box:
        fates[fate] += last - first + 1
        sent += bytes([fate == "sent"]) * (last - first + 1)
        if fate != "sent":
            lost.update(range(first, last + 1))
    in_gaps = {seq for gap in ours.gaps for seq in range(gap.first, (gap.last or 0) + 1)}
    stored = {seq for first, last in ours.stored_spans() for seq in range(first, last + 1)}
    everything = set(range(len(sent)))
    return fates | {
        "stored": len(stored),
        "in_gaps": len(in_gaps),
        "unaccounted": len(everything - stored - in_gaps),
        "in_no_ledger": len((stored | in_gaps) - everything),
        "stored_though_not_sent": len(stored & lost),
        "twice": ours.duplicates() + len(stored & in_gaps),
        "sent_but_in_gap": len(in_gaps - lost),
    }
