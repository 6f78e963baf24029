"""One contestant's answer to one campaign, in a process of its own: ``python -m tests.experiments.bench.discovery_worker FOLDER CASE
NAME``.

Prints one line of JSON: the answer, seconds of processor time and of the clock, memory.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path

from tests.experiments.bench.discovery_case import read_case
from tests.experiments.bench.discovery_contestants import PEERS, candidates_of, ours
from tests.experiments.bench.worker import _give_back, _peak_mb, _reset_peak, _resident_mb


def main(folder: str, name: str, contestant: str) -> None:
    """Everything is loaded and read before the clock starts."""
    if contestant.startswith("bic-forward"):
        import statsmodels.regression.linear_model  # noqa: F401
    if contestant.startswith("lasso"):
        import sklearn.linear_model  # noqa: F401
    warnings.simplefilter("ignore")  # candidates that are alike: both libraries say so each time (statsmodels' import sets its own filter)
    case = read_case(Path(folder), name)
    _give_back()
    before, reset = _resident_mb(), _reset_peak()
    clock, start, columns_s = time.perf_counter(), time.process_time(), None
    if contestant in PEERS:
        choose, unnamed = PEERS[contestant]
        candidates = candidates_of(case, unnamed=unnamed)
        columns_s = time.process_time() - start
        found = choose(candidates)
    else:
        found = ours(case)
    clock, processor = time.perf_counter() - clock, time.process_time() - start
    peak = _peak_mb()
    kept = {k: found.get(k) for k in ("verdict", "effects", "where", "confounded_with", "next_test")}
    memory = {"process_peak_mb": peak, "beyond_mb": max(0.0, peak - before) if reset else None}
    print(json.dumps({"answer": kept, "cpu_s": processor, "columns_s": columns_s, "clock_s": clock, **memory}))  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
