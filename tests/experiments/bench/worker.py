"""One contestant in one process, so that memory is its own.

``python -m tests.experiments.bench.worker CASE NAME RESULT.npy`` prints one line of JSON.
"""

from __future__ import annotations

import ctypes
import gc
import json
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.experiments.bench.case import make
from tests.experiments.bench.contestants import contestants, look_up
from tests.experiments.bench.trials_contestants import TRIAL_CASES

NO_RESULT = "-"
LEAST_REPEATS = 5
LEAST_TRIAL_REPEATS = 2
LEAST_SECONDS = 0.6
MOST_SECONDS = 1.0
"""A call that takes longer is made once to warm up and once more; several end at this sum."""
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def main(case_name: str, name: str, result_file: str) -> None:
    """Warm up, measure memory of one call, then times."""
    if case_name in TRIAL_CASES:
        _trials(case_name, name, result_file)
        return
    case = make(case_name)
    run = contestants(case_name)[name](case)
    small = run()  # loads, compiles and lets libraries start their threads
    del small
    _give_back()
    before = _resident_mb()
    reset = _reset_peak()
    start = time.perf_counter()
    result = run()
    once = time.perf_counter() - start
    peak = _peak_mb()
    output = result.nbytes / 1e6
    np.save(result_file, result)
    del result
    times, tables = [once] if once > MOST_SECONDS else _times(run), look_up(name, case)
    memory = {"output_mb": output, "beyond_output_mb": max(0.0, peak - before - output) if reset else None, "process_peak_mb": peak}
    print(json.dumps({"times_s": times, "look_up_s": None if tables is None else min(_times(tables)), **memory}))  # noqa: T201


def _trials(case_name: str, name: str, result_file: str) -> None:
    """The uncertainty part: what is compared (or one call, to warm up), then times and memory of one call."""
    contestant = TRIAL_CASES[case_name][name]()
    if result_file == NO_RESULT:
        contestant.run()
    else:
        np.savez(result_file, **contestant.result())
    _give_back()
    before, reset = _resident_mb(), _reset_peak()
    times = _times(contestant.run, LEAST_TRIAL_REPEATS)
    peak = _peak_mb()
    figures = {"times_s": times, "items": contestant.items, "beyond_mb": max(0.0, peak - before) if reset else None}
    print(json.dumps(figures))  # noqa: T201


def _times(run: Callable[[], object], least: int = LEAST_REPEATS) -> list[float]:
    times: list[float] = []
    while len(times) < least or sum(times) < LEAST_SECONDS:
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
        if len(times) >= LEAST_TRIAL_REPEATS and sum(times) > MOST_SECONDS:
            break
    return times


def _give_back() -> None:
    """Freed memory that the C library keeps would hide what the next call needs (glibc)."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def _resident_mb() -> float | None:
    return _status("VmRSS")


def _peak_mb() -> float | None:
    return _status("VmHWM")


def _status(key: str) -> float | None:
    """A figure of the kernel's own account of this process (Linux)."""
    if not _STATUS.exists():
        return None
    found = re.search(rf"^{key}:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    return int(found[1]) * 1024 / 1e6 if found else None


def _reset_peak() -> bool:
    """Make the kernel's high-water mark start anew; False where that cannot be done."""
    try:
        _RESET.write_text("5")
    except OSError:
        return False
    return _peak_mb() is not None


if __name__ == "__main__":
    main(*sys.argv[1:])
