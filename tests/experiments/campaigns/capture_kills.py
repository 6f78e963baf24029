"""SIGKILL at random instants of a process that records, again and again; a second process recovers and judges.

The parent imports everything once and only forks, so that a kill costs a fraction of a second. The child tells ``durable_seq`` through a
pipe as soon as it is published: what stands there must be in the database after the recovery, whatever else was lost.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import random
import select
import signal
import struct
import time
from collections.abc import Callable
from pathlib import Path

from abbe.drivers.api import BarBatch, BarSample
from abbe.service.capture.recorder import recording
from abbe.service.capture.recovery import ledger_of, read_segment, recover_segments
from abbe.service.capture.settings import CaptureSettings, segment_folder, segment_path
from abbe.service.clock import SystemClock
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.store import Store

SETTINGS = CaptureSettings(reserve_bytes=65536, keep=True)
BATCH = 20
LOSE_EVERY = 37
"""Every so manieth batch lacks three samples: kills have to find gaps as well."""
LONGEST_S = 0.15
_WORD = struct.Struct("<q")


def reading(seq: int) -> int:
    return (seq * 7919) % 2_000_001 - 1_000_000


def run_kills(folder: Path, kills: int, seed: int, progress: Callable[[str], None] = lambda text: None) -> dict[str, object]:
    """Kill so many recordings; gives the sums over all of them, and ``violations`` in words."""
    rng = random.Random(seed)
    url = f"sqlite:///{folder / 'abbe.sqlite3'}"
    _forked(lambda write: _prepare(url))
    names = ("kills", "while_starting", "near_a_sync", "with_durable", "durable", "stored", "beyond_durable", "new_chunks", "torn_tails")
    sums: dict[str, int] = dict.fromkeys(names, 0)
    violations: list[str] = []
    began_s = time.monotonic()
    for k in range(kills):
        early, near_sync = rng.random() < 0.1, rng.random() < 0.5
        durable = _kill_early(url, k, rng) if early else _kill_one(url, k, rng, near_sync=near_sync)
        judged = json.loads(_forked(lambda write, k=k, durable=durable: os.write(write, json.dumps(_judge(url, k, durable)).encode())))
        violations += [f"kill {k}: {text}" for text in judged.pop("violations")]
        for name, value in judged.items():
            sums[name] += value
        sums["kills"] += 1
        sums["while_starting"] += early
        sums["near_a_sync"] += near_sync and not early
        progress(f"{k + 1} of {kills} kills, {len(violations)} violations, {(time.monotonic() - began_s) / (k + 1):.2f} s each")
    return sums | {"violations": violations, "wall_s": time.monotonic() - began_s}


def _prepare(url: str) -> None:
    with Store.open(url) as store:
        store.campaigns.add(store.machines.add("M", {"name": "M"}), "kills", {})


def _kill_early(url: str, number: int, rng: random.Random) -> int:
    """Kill while the process opens the database, makes the run, the reserve, the segment, or writes the first samples."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(read)
        _in_child(lambda: asyncio.run(_record(url, number, write)))
    os.close(write)
    select.select([], [], [], rng.random() * LONGEST_S)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    durable = -1
    while word := os.read(read, _WORD.size):
        durable = _WORD.unpack(word)[0]
    os.close(read)
    return durable


def _kill_one(url: str, number: int, rng: random.Random, *, near_sync: bool) -> int:
    """Start a recording, kill it; gives the highest number that it said was durable."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(read)
        _in_child(lambda: asyncio.run(_record(url, number, write)))
    os.close(write)
    _wait(read)  # the first publication: it is on its way
    durable = _WORD.unpack(os.read(read, _WORD.size))[0]
    deadline = time.monotonic() + rng.random() * LONGEST_S
    while (rest := deadline - time.monotonic()) > 0 and select.select([read], [], [], rest)[0]:
        durable = _WORD.unpack(os.read(read, _WORD.size))[0]
    if near_sync:  # within two milliseconds of a sync's end
        _wait(read)
        durable = _WORD.unpack(os.read(read, _WORD.size))[0]
        select.select([], [], [], rng.random() * 0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while word := os.read(read, _WORD.size):
        durable = _WORD.unpack(word)[0]
    os.close(read)
    return int(durable)


def _wait(read: int) -> None:
    if not select.select([read], [], [], 30.0)[0]:
        raise SystemExit("the recording process says nothing")


async def _record(url: str, number: int, write: int) -> None:
    """One run that never ends: 5 kHz in batches, with gaps."""
    with Store.open(url) as store:
        run_id = store.runs.start(store.campaigns.find("kills").id, f"r{number}", "ballbar_helix", "identify", {})

        def published(channel: str, stream: int, seq: int) -> None:
            os.write(write, _WORD.pack(seq))

        async with recording(store, run_id, SETTINGS, SystemClock(), {"label": f"r{number}"}, published=published) as recorder:
            tap, at = recorder.tap(), 0
            while True:
                missing = 3 if at // BATCH % LOSE_EVERY == LOSE_EVERY - 1 else 0
                seqs = range(at + missing, at + BATCH)
                samples = tuple(BarSample(seq, 1000 * (seq + 1), reading(seq), 8) for seq in seqs)
                tap.take(BarBatch(time.monotonic(), samples, missing, boot_id=7))
                at += BATCH
                await asyncio.sleep(0.004)


def _judge(url: str, number: int, durable: int) -> dict[str, object]:
    """Recover in a process of its own, and look."""
    wrong: list[str] = []
    nothing = {"violations": wrong, "with_durable": 0, "durable": 0, "stored": 0, "beyond_durable": 0, "new_chunks": 0, "torn_tails": 0}
    with Store.open(url) as store:
        runs = [one for one in store.runs.all() if one.label == f"r{number}"]
        path = segment_path(segment_folder(url, SETTINGS), runs[0].id) if runs else Path("none")
        if not path.exists():  # killed before there was anything to lose
            if durable >= 0 or (runs and runs[0].visible_status != "incomplete"):
                wrong.append("no segment")
            return nothing
        run = runs[0]
        before = read_segment(path)
        in_database = len(store.chunks.of_run(run.id, "bar"))
        if run.visible_status != "incomplete":
            wrong.append(f"before the recovery the run looked {run.visible_status}")
        done = [one for one in recover_segments(store, SETTINGS) if one.run == run.id]
        held = read_segment(path)
        run, chunks = store.runs.find(str(run.id)), store.chunks.of_run(run.id)
        samples = [sample for chunk in chunks if chunk.channel == "bar" for sample in decode_bar(chunk.payload)]
        ledger, last = ledger_of(chunks), samples[-1].seq if samples else -1
        wrong += [text for bad, text in (
            (len(done) != 1, f"{len(done)} recoveries"),
            (run.status != "interrupted" or "process ended" not in run.reason, f"marked as {run.status}: {run.reason}"),
            (not held.whole, "the chain is broken"),
            (bool(before.damaged) or bool(before.broken_links), "damage in the middle"),
            (bool(ledger.unaccounted()), f"unaccounted {ledger.unaccounted()}"),
            (bool(ledger.duplicates()), "a number twice"),
            (any((one.device_us, one.reading_nm) != (1000 * (one.seq + 1), reading(one.seq)) for one in samples), "a changed sample"),
            (any(b.seq <= a.seq for a, b in itertools.pairwise(samples)), "out of order"),
            (last < durable, f"durable {durable}, but the last stored is {last}"),
            (any(gap.missing != 3 for gap in ledger.gaps if gap.last is not None), "a gap that was none"),
        ) if bad]  # fmt: skip
        path.unlink()
    return {
        "violations": wrong,
        "with_durable": int(durable >= 0),
        "durable": durable + 1,
        "stored": len(samples),
        "beyond_durable": last - durable,
        "new_chunks": len([one for one in chunks if one.channel == "bar"]) - in_database,
        "torn_tails": int(bool(before.tail_bytes)),
    }


def _forked(work: Callable[[int], object]) -> bytes:
    """Do something in a child of its own and give what it wrote."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(read)
        _in_child(lambda: work(write))
    os.close(write)
    said = b""
    while piece := os.read(read, 65536):
        said += piece
    os.close(read)
    if os.waitpid(pid, 0)[1]:
        raise SystemExit("a child failed")
    return said


def _in_child(work: Callable[[], object]) -> None:
    code = 1
    try:
        work()
        code = 0
    except BaseException:  # noqa: BLE001 - the parent must not run on in here
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)
