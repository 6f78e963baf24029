"""Do the stated intervals hold the truth, and are the claims true? Random machines under random campaigns, counted.

``python -m tests.experiments.campaigns.coverage --machines 500 [--first 1] [--jobs 2] [--kinds one_tool,joint] [--json FILE]``

Every case (machine, kind of campaign) that is done goes into FILE as one line; cases already there are not done again, so an interrupted
run goes on where it stopped. Ctrl-C prints the table of what is there. What is counted: `tests.experiments.campaigns.scoring`,
`.statistics`.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tests.experiments.campaigns.population import CAMPAIGNS, Kind
from tests.experiments.campaigns.scoring import judge
from tests.experiments.campaigns.statistics import table

Task = tuple[int, Kind]


def main() -> None:
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the workers when they start
    args = _arguments()
    kinds: list[Kind] = [k for k in CAMPAIGNS if k in args.kinds.split(",")]
    cases = _read(args.json)
    done = {(c["seed"], c["kind"]) for c in cases}
    wanted = [(seed, kind) for seed in range(args.first, args.first + args.machines) for kind in kinds]
    open_tasks = [t for t in wanted if t not in done]
    cases = [c for c in cases if (c["seed"], c["kind"]) in set(wanted)]
    start = time.monotonic()
    try:
        for k, case in enumerate(_solved(open_tasks, args.jobs), 1):
            cases.append(case)
            if args.json:
                with args.json.open("a") as f:
                    f.write(json.dumps(case) + "\n")
            left = (time.monotonic() - start) / k * (len(open_tasks) - k)
            _tell(f"\r{k} of {len(open_tasks)} cases, {left / 60:.1f} min left  ")
    except KeyboardInterrupt:
        _tell("\ninterrupted: the table of what is done")
    _tell("\n")
    sys.stdout.write(table(sorted(cases, key=lambda c: (CAMPAIGNS.index(c["kind"]), c["seed"]))) + "\n")


def _tell(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kinds", default=",".join(CAMPAIGNS))
    parser.add_argument("--json", type=Path, default=None)
    return parser.parse_args()


def _read(path: Path | None) -> list[dict[str, Any]]:
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


def _solved(tasks: list[Task], jobs: int) -> Iterator[dict[str, Any]]:
    """Cases as they are finished; never more than a few waiting, so that Ctrl-C ends it soon."""
    waiting = iter(tasks)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(judge, *t) for _, t in zip(range(2 * jobs), waiting, strict=False)}
        try:
            while running:
                finished, running = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
                    running |= {pool.submit(judge, *t) for _, t in zip(range(1), waiting, strict=False)}
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


if __name__ == "__main__":
    main()
