"""Many campaigns solved anew: in one process, in several, and on Dask where it is installed. How much faster, and are numbers equal."""

from __future__ import annotations

import importlib.util
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from abbe.service.identification.reanalysis import (
    DaskExecutor,
    Executor,
    ProcessExecutor,
    ReanalysisTask,
    solve_all,
    tasks_of,
)
from abbe.service.storage.store import Store
from tests.experiments.bench.discovery import ONE_THREAD
from tests.many_campaigns import dask_cluster, fill

CAMPAIGNS = 16
WORKERS = (2, 8)
DASK_WORKERS = 2
GOAL = 1.8
"""Times faster with two workers on two cores."""
MODEL = "rigid21"


def compared(progress: Callable[[str], None]) -> dict:
    """The same campaigns by each executor, every process with one thread of BLAS, as `abbe solve-all` has it.

    ``right``: every document is the same to the last digit as that of one process. ``start_s``: of that, until processes and libraries ran.
    """
    os.environ |= ONE_THREAD  # read by the processes when they start
    with tempfile.TemporaryDirectory() as folder:
        progress(f"reanalysis: {CAMPAIGNS} campaigns into a database")
        url = f"sqlite:///{Path(folder) / 'abbe.sqlite3'}"
        with Store.open(url) as store:
            fill(store, Path(folder), range(1, CAMPAIGNS + 1))
            tasks = tasks_of(store, url, "june-*", MODEL)
        progress("reanalysis: one process")
        wanted, first_s = timed(ProcessExecutor(1), tasks)
        found = {"one process": _facts(first_s, 1) | {"right": all(json.loads(wanted)), "cores": len(os.sched_getaffinity(0))}}
        for workers in WORKERS:
            progress(f"reanalysis: {workers} processes")
            told, wall_s = timed(ProcessExecutor(workers), tasks)
            found[f"{workers} processes"] = _facts(wall_s, workers) | {"right": told == wanted}
        if importlib.util.find_spec("distributed") is not None:
            progress(f"reanalysis: Dask, {DASK_WORKERS} workers")
            with dask_cluster(DASK_WORKERS) as address:
                told, wall_s = timed(DaskExecutor(address), tasks)
            found[f"Dask, {DASK_WORKERS} workers"] = {"wall_s": wall_s, "right": told == wanted}
    progress("")
    return found


def _facts(wall_s: float, workers: int) -> dict:
    began_s = time.perf_counter()
    list(ProcessExecutor(workers).map(_nothing, range(workers)))
    return {"wall_s": wall_s, "start_s": time.perf_counter() - began_s}


def _nothing(_: int) -> None:
    """A job that takes no time: this module has imported what a solution needs."""


def timed(executor: Executor, tasks: list[ReanalysisTask]) -> tuple[str, float]:
    """The answers of an executor as text, and the seconds that they took."""
    start = time.perf_counter()
    docs = [one.doc for one in solve_all(tasks, executor)]
    return json.dumps(docs), time.perf_counter() - start


def lines(found: dict) -> list[str]:
    """For the report."""
    first = found["one process"]
    head = f"{CAMPAIGNS} campaigns solved anew ({MODEL}); {first['cores']} cores, load {os.getloadavg()[0]:.1f}; goal {GOAL} with two"
    out = ["", head, f"{'':<24}{'s':>9}{'start s':>9}{'faster':>9}"]
    for name, one in found.items():
        word = "" if one["right"] else "   NUMBERS DIFFER"
        start = f"{one['start_s']:9.1f}" if "start_s" in one else f"{'-':>9}"
        out.append(f"  {name:<22}{one['wall_s']:9.1f}{start}{first['wall_s'] / one['wall_s']:9.2f}{word}")
    if not any(name.startswith("Dask") for name in found):
        out.append("  Dask is not in this environment: .venv/bin/python -m tests.experiments.bench --only reanalysis")
    return [*out, "Start: of processes and libraries, counted in the seconds before it. More workers than cores gain nothing."]
