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
    SerialExecutor,
    solve_all,
    tasks_of,
)
from abbe.service.storage.store import Store
from tests.many_campaigns import dask_cluster, fill

CAMPAIGNS = 16
WORKERS = (2, 8)
MODEL = "rigid21"


def compared(progress: Callable[[str], None]) -> dict:
    """The same campaigns by each executor. ``right``: every document is the same to the last digit as that of one process."""
    with tempfile.TemporaryDirectory() as folder:
        progress(f"reanalysis: {CAMPAIGNS} campaigns into a database")
        url = f"sqlite:///{Path(folder) / 'abbe.sqlite3'}"
        with Store.open(url) as store:
            fill(store, Path(folder), range(1, CAMPAIGNS + 1))
            tasks = tasks_of(store, url, "june-*", MODEL)
        progress("reanalysis: one process")
        wanted, first_s = timed(SerialExecutor(), tasks)
        found = {"one process": {"wall_s": first_s, "right": all(json.loads(wanted)), "cores": len(os.sched_getaffinity(0))}}
        for workers in WORKERS:
            progress(f"reanalysis: {workers} processes")
            told, wall_s = timed(ProcessExecutor(workers), tasks)
            found[f"{workers} processes"] = {"wall_s": wall_s, "right": told == wanted}
        if importlib.util.find_spec("distributed") is not None:
            progress(f"reanalysis: Dask, {WORKERS[-1]} workers")
            with dask_cluster(WORKERS[-1]) as address:
                told, wall_s = timed(DaskExecutor(address), tasks)
            found[f"Dask, {WORKERS[-1]} workers"] = {"wall_s": wall_s, "right": told == wanted}
    progress("")
    return found


def timed(executor: Executor, tasks: list[ReanalysisTask]) -> tuple[str, float]:
    """The answers of an executor as text, and the seconds that they took."""
    start = time.perf_counter()
    docs = [one.doc for one in solve_all(tasks, executor)]
    return json.dumps(docs), time.perf_counter() - start


def lines(found: dict) -> list[str]:
    """For the report."""
    first = found["one process"]
    out = ["", f"{CAMPAIGNS} campaigns solved anew ({MODEL}); this computer has {first['cores']} cores", f"{'':<24}{'s':>9}{'faster':>9}"]
    for name, one in found.items():
        word = "" if one["right"] else "   NUMBERS DIFFER"
        out.append(f"  {name:<22}{one['wall_s']:9.1f}{first['wall_s'] / one['wall_s']:9.2f}{word}")
    return [*out, "Starting processes and libraries is counted. More workers than cores gain nothing."]
