"""A plant in PostgreSQL: a hundred machines for a year, as their services would have left it; pages, queries, size, and Dask on it.

python -m tests.experiments.bench.plant postgresql://postgres@127.0.0.1:5432/plant

The database must exist and be empty. ``--kept``: it was filled by an earlier call.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from sqlalchemy import text

from abbe.service.identification.reanalysis import DaskExecutor, SerialExecutor, tasks_of
from abbe.service.storage.store import Store
from tests.experiments.bench.history import WORDS, asked_of
from tests.experiments.bench.history_case import History, build
from tests.experiments.bench.reanalysis import MODEL, timed
from tests.many_campaigns import dask_cluster, fill

RUNS_A_CHECK = 5
WORKERS = 2


def main() -> int:
    """Fill, ask, solve, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url", help="an empty database on a server")
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--campaigns", type=int, default=16, help="how many to solve (default 16)")
    parser.add_argument("--kept", action="store_true", help="the database is full already")
    given = parser.parse_args()
    history = History(given.machines, given.days, 1, given.machines * given.days * RUNS_A_CHECK)
    if not given.kept:
        began_s = time.perf_counter()
        build(given.url, history)
        _count_on(given.url)
        _say(f"filled in {time.perf_counter() - began_s:.0f} s")
    with tempfile.TemporaryDirectory() as folder:
        asked = asked_of(given.url, Path(folder), history)
        _print(given.url, history, asked["ms"])
        equal = _solved(given.url, Path(folder), given.campaigns)
    return 0 if asked["right"] and equal else 1


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _count_on(url: str) -> None:
    """Let the server number new rows after those that were written with numbers."""
    with Store.open(url) as store:
        for table in ("campaigns", "runs", "verifications"):
            store.commit(
                lambda c, t=table: c.execute(text(f"select setval(pg_get_serial_sequence('{t}', 'id'), (select max(id) from {t}))"))
            )


def _print(url: str, history: History, ms: dict[str, float]) -> None:
    with Store.open(url) as store:
        size = store.read(lambda c: c.execute(text("select pg_database_size(current_database())")).scalar_one())
    load = os.getloadavg()[0]
    _say(f"{history.machines} machines, {history.days} days, {history.runs:,} runs; load {load:.1f} on {os.cpu_count()} cores")
    for key, value in ms.items():
        _say(f"  {WORDS[key]:<42}{value:9.1f} ms")
    _say(f"  database {size / 1e9:.1f} GB, {size / history.runs / 1e3:.1f} kB a run")


def _solved(url: str, folder: Path, campaigns: int) -> bool:
    """Solve campaigns of this database in this process and on Dask; whether the numbers are equal."""
    with Store.open(url) as store:
        if not any(one.name.startswith("june-") for one in store.campaigns.all()):
            fill(store, folder, range(1, campaigns + 1))
        tasks = tasks_of(store, url, "june-*", MODEL)
    wanted, alone_s = timed(SerialExecutor(), tasks)
    with dask_cluster(WORKERS) as address:
        timed(DaskExecutor(address), tasks[:WORKERS])  # the workers have started and imported
        told, shared_s = timed(DaskExecutor(address), tasks)
    word = "the same numbers" if told == wanted else "NUMBERS DIFFER"
    _say(f"  {len(tasks)} campaigns solved: {alone_s:.1f} s, Dask with {WORKERS} workers {shared_s:.1f} s, {word}")
    return told == wanted


if __name__ == "__main__":
    sys.exit(main())
