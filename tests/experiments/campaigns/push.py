"""All faults of the push protocol: ``python -m tests.experiments.campaigns.push sweep [--every K] [--jobs N]``; ``mutants``; and with real
processes on real sockets and databases: ``kills [--count N] [--seed N]``, ``races [--count N] [--seed N]``.

Prints what was counted and ends with 1 if anything was violated.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tests.push.bench import Bench
from tests.push.loading import edited, real
from tests.push.mutants import MUTANTS
from tests.push.one_bank import CASES as ONE_BANK
from tests.push.races import DATABASES
from tests.push.races import races as random_races
from tests.push.random_kills import LIMIT_S
from tests.push.random_kills import kills as random_kills
from tests.push.sweep import PAIRED, Count, doubles, first_violation, singles
from tests.push.variants import VARIANTS
from tests.scenarios.conftest import simulated

SWEPT = (*PAIRED, *ONE_BANK[:2])
"""Cases whose double faults are swept: two banks, and one table."""


def _part(arguments: tuple[int, int, int, int]) -> Count:
    case, every, part, parts = arguments
    return doubles(real(), SWEPT[case], every=every, part=(part, parts))


def sweep(every: int, jobs: int) -> int:
    began_s = time.monotonic()
    total = singles(real())
    print(f"single faults: {total.combinations} combinations, violated: {dict(total.violated)}", flush=True)  # noqa: T201
    parts = 24
    with ProcessPoolExecutor(jobs) as pool:
        work = [(case, every, part, parts) for case in range(len(SWEPT)) for part in range(parts)]
        for number, count in enumerate(pool.map(_part, work)):
            total.merge(count)
            print(f"{number + 1}/{len(work)}: {total.combinations} combinations, violated: {dict(total.violated)}", flush=True)  # noqa: T201
    print(f"ends: {dict(total.ends)}; {time.monotonic() - began_s:.0f} s")  # noqa: T201
    print(*total.examples, sep="\n")  # noqa: T201
    for variant in VARIANTS:
        count = singles(edited(variant.edits), (variant.case,))
        print(f"{variant.name}: {count.combinations} combinations, violated: {dict(count.violated)}", flush=True)  # noqa: T201
        total.violated.update({} if set(variant.must) <= set(count.violated) else {f"unseen: {variant.name}": 1})
    return int(bool(total.violated))


def mutants() -> int:
    alive = [name for name, edits in MUTANTS.items() if not first_violation(edited(edits))]
    print(f"{len(MUTANTS) - len(alive)} of {len(MUTANTS)} mutants killed", *alive, sep="\n")  # noqa: T201
    return int(bool(alive))


def kills(count: int, seed: int) -> int:
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as name, simulated(Path(name), "--speed", "60") as sims:
        bench = Bench(sims.ready["cnc"], Path(name))
        found = random_kills(bench, count, seed, lambda text: print(text, flush=True))  # noqa: T201
        bench.close()
    print(f"{found.text()}; {time.monotonic() - began_s:.0f} s", *found.violations, sep="\n")  # noqa: T201
    return int(bool(found.violations) or found.slowest_s >= LIMIT_S or found.killed < count)


def races(count: int, seed: int) -> int:
    wrong = False
    for case, databases in DATABASES.items():
        began_s = time.monotonic()
        with tempfile.TemporaryDirectory() as name, simulated(Path(name), "--speed", "60") as sims:
            found = random_races(sims.ready["cnc"], sims.ask, Path(name), databases, count, seed)
        print(f"{case}: {found.text()}; {time.monotonic() - began_s:.0f} s", *found.violations, sep="\n", flush=True)  # noqa: T201
        for line, n in found.losers().items():
            print(f"    {n} {line}")  # noqa: T201
        wrong |= bool(found.violations) or found.races < count
    return int(wrong)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("sweep", "mutants", "kills", "races"))
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--count", type=int, default=0, help="default: 300 kills, 200 races")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.what == "kills":
        return kills(arguments.count or 300, arguments.seed)
    if arguments.what == "races":
        return races(arguments.count or 200, arguments.seed)
    return mutants() if arguments.what == "mutants" else sweep(arguments.every, arguments.jobs)


if __name__ == "__main__":
    sys.exit(main())
