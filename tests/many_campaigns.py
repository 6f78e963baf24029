"""Many campaigns in one database, and a Dask cluster of real processes that solves them: for tests and the bench."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from abbe.service.runs.exchange import import_folder
from abbe.service.storage.store import Store
from tests.scenarios.campaign_files import measured, thinned, write_folder


def fill(store: Store, place: Path, seeds: Iterable[int], every: int = 1) -> None:
    """Campaigns ``june-1``, ``june-2`` and so on, by their seeds; of a ball-bar's readings ``every`` so manieth."""
    for seed in seeds:
        site, runs = measured(seed, "one_tool")
        name = f"june-{seed}"
        folder = write_folder(place / name, site.doc, [one | {"campaign": name} for one in thinned(runs, every)])
        head = json.loads((folder / "campaign.json").read_text()) | {"campaign": name}
        (folder / "campaign.json").write_text(json.dumps(head))
        import_folder(store, folder)


@contextmanager
def dask_cluster(workers: int) -> Iterator[str]:
    """The address of a scheduler with workers, each a real process of one thread."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    quiet: dict[str, Any] = {"stderr": subprocess.PIPE, "text": True, "env": os.environ | {"PYTHONPATH": path}}
    words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--protocol", "tcp"]
    with ExitStack() as stack:
        scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *words], **quiet)
        stack.callback(_end, scheduler)
        assert scheduler.stderr is not None
        address = next(one for one in scheduler.stderr if "Scheduler at:" in one).split("Scheduler at:")[1].strip()
        each = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        for _ in range(workers):
            stack.callback(_end, subprocess.Popen([*each, "--host", "127.0.0.1"], **quiet))
        yield address


def _end(child: subprocess.Popen[str]) -> None:
    child.terminate()
    child.communicate()
