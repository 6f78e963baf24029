"""Samples per second of one core through the whole path, pty to database, against a plain loop that does the same in fair weather."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tests.experiments.bench.capture_case import NEED_HZ, SAMPLES

WORDS = {
    "ours": "ours: thread, frame, segment, database",
    "plain-batch": "pyserial, SQLAlchemy, commit every 50 ms",
    "plain": "pyserial, SQLAlchemy, commit every row",
}


def compared(rounds: int, progress: Callable[[str], None]) -> dict:
    """Run every contestant so many times; the best of each counts."""
    runs: dict[str, list[dict]] = {name: [] for name in SAMPLES}
    for n in range(rounds):
        for name, found in runs.items():
            progress(f"capture, round {n + 1} of {rounds}: {name}")
            found.append(_run(name))
    progress("")
    return {name: _summary(found) for name, found in runs.items()}


def _run(name: str) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "tests.experiments.bench.capture_worker", name, str(Path(folder))]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"capture {name} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def _summary(runs: list[dict]) -> dict:
    count = runs[0]["samples"]
    cpu_s, wall_s = min(r["cpu_s"] for r in runs), min(r["wall_s"] for r in runs)
    return {
        "samples": count,
        "per_core_hz": count / cpu_s,
        "wall_hz": count / wall_s,
        "us_per_sample": 1e6 * cpu_s / count,
        "right": all(r["right"] for r in runs),
    }


def lines(found: dict) -> list[str]:
    """The printed table."""
    head = (
        f"{'Ball-bar samples from a pty into SQLite':<44}{'samples':>9}{'us of core':>12}{'1/s per core':>14}{'x 1 kHz':>9}{'1/s wall':>11}"
    )
    out = ["", head]
    for name, one in found.items():
        wrong = "" if one["right"] else "   DIFFERS"
        figures = f"{one['samples']:9d}{one['us_per_sample']:12.1f}{one['per_core_hz']:14.0f}{one['per_core_hz'] / NEED_HZ:9.1f}"
        out.append(f"  {WORDS[name]:<42}{figures}{one['wall_hz']:11.0f}{wrong}")
    for name in ("plain-batch", "plain"):
        out.append(f"  times faster per core than {WORDS[name]:<42}{found['ours']['per_core_hz'] / found[name]['per_core_hz']:10.0f}")
    return [
        *out,
        "",
        "us of core: CPU time of all threads of the process from START until the last sample is in the database; best of all rounds.",
        "Ours gives every batch to a consumer in the event loop as well, as a measurement does.",
        "Only ours syncs a log before, accounts for every number, and goes on reading while the database is locked.",
    ]
