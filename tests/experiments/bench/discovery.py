"""The discovery's part of the bench: all contestants on one campaign after the other, so that a busy moment hits all of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.experiments.bench.discovery_case import FIRST_SEED, kinds_of, measured_bar_readings, read_case, truth, write_cases, write_long
from tests.experiments.bench.discovery_contestants import CONTESTANTS
from tests.experiments.bench.discovery_judge import costs, counted

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The goals are for one core; and threads only slow down matrices of some hundred unknowns."""


def compared(folder: Path, count: int, tell: Callable[[str], None]) -> dict:
    """Answers, marks, times and memory of everybody."""
    names = write_cases(folder, count)
    runs: dict[str, list[dict]] = {k: [] for k in CONTESTANTS}
    for i, name in enumerate(names):
        for k in CONTESTANTS:
            tell(f"campaign {i + 1} of {count}: {k}")
            runs[k].append(_run(folder, name, k))
    tell("a long campaign")
    long = write_long(folder)
    longest = _run(folder, long, "discover") | {"readings": measured_bar_readings(read_case(folder, long))}
    tell("")
    truths = [truth(folder, name) for name in names]
    return {
        "first_seed": FIRST_SEED,
        "kinds": kinds_of(count),
        "truths": [{"case": t["case"], "effects": [[e["label"], e["snr_total"]] for e in t["effects"]]} for t in truths],
        "long": longest,
        "contestants": {k: {"counts": counted(truths, [r["answer"] for r in v]), "costs": costs(v), "runs": v} for k, v in runs.items()},
    }


def _run(folder: Path, name: str, contestant: str) -> dict:
    command = [sys.executable, "-m", "tests.experiments.bench.discovery_worker", str(folder), name, contestant]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **ONE_THREAD})
    if done.returncode:
        raise SystemExit(f"{name} {contestant} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])
