"""Speed, memory and, in the discovery, names against what a user would take instead: ``make bench``.

Every contestant runs in a process of its own, in rounds, so that a busy moment of the computer hits all of them. Times never make it fail:
the exit code is 1 when results differ, and only then.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from tests.experiments.bench import capture, discovery, discovery_case, history, parsers, reanalysis, report, start
from tests.experiments.bench.case import CASES, make
from tests.experiments.bench.contestants import EXTRA, FLOORS, OURS, PEERS, contestants
from tests.experiments.bench.facts import facts
from tests.experiments.bench.trials_contestants import TRIAL_CASES
from tests.experiments.bench.trials_judge import judged
from tests.experiments.bench.worker import NO_RESULT

SLOW_S = 0.5
"""A contestant of the map whose call takes longer is run in the first round only."""
PARTS = ("map", "trials", "discovery", "capture", "parsers", "history", "reanalysis", "start")
ROUNDING_MM = 1e-12
SECOND_ORDER_MM = 1e-5
"""What exact kinematics may add to rule G on this machine: measured 1.6e-6. Leaving out any one of the 18 tables changes 5.6e-4 or more
(tests/experiments/test_bench_case.py)."""


NOTHING: dict[str, dict] = {one: {} for one in ("cases", *PARTS[1:])}


def main() -> int:
    """Run all contestants, compare, print."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=...", description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3, help="how often each contestant's process is run (default 3)")
    parser.add_argument("--json", type=Path, help="write all figures to this file as well")
    parser.add_argument(
        "--only",
        choices=PARTS,
        help="error map; trials and joint solution; naming of effects; samples into the database; a month of checks; solving; start",
    )
    parser.add_argument("--cases", type=int, default=discovery_case.CASES, help=f"campaigns to name (default {discovery_case.CASES})")
    given = parser.parse_args()
    parts = [given.only] if given.only else PARTS
    found = {"facts": facts(), **NOTHING}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        computed = {
            "map": lambda: {case: _map(case, given.rounds, folder) for case in CASES},
            "trials": lambda: {case: _trials(case, list(names), given.rounds, folder) for case, names in TRIAL_CASES.items()},
            "discovery": lambda: discovery.compared(folder, max(1, given.cases), _progress),
            "capture": lambda: capture.compared(given.rounds, _progress),
            "parsers": lambda: parsers.compared(given.rounds, _progress),
            "history": lambda: history.compared(_progress),
            "reanalysis": lambda: reanalysis.compared(_progress),
            "start": lambda: start.compared(_progress),
        }
        for part in parts:
            key = "cases" if part == "map" else part
            found[key] = computed[part]()
            print(report.text({**NOTHING, "facts": found["facts"], key: found[key]}), "\n", flush=True)  # noqa: T201 - each part as it comes
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    whole = [*found["cases"].values(), *found["trials"].values()]
    right = all(one["right"] for part in ("capture", "parsers", "history", "reanalysis", "start") for one in found[part].values())
    return 0 if right and all(a["ok"] for case in whole for a in case["agreement"].values()) else 1


def _map(name: str, rounds: int, folder: Path) -> dict:
    names = list(contestants(name))
    runs = {k: [] for k in names}
    for n in range(rounds):
        for k in names:
            if runs[k] and min(runs[k][0]["times_s"]) > SLOW_S:
                continue
            _progress(f"{name}, round {n + 1} of {rounds}: {k}")
            runs[k].append(_run(name, k, folder / f"{name}-{k}.npy"))
            print(f"{name}, round {n + 1}, {k}: {min(runs[k][-1]['times_s']) * 1e3:.1f} ms", file=sys.stderr, flush=True)  # noqa: T201
    _progress("")
    return {"contestants": {k: _summary(v) for k, v in runs.items()}, "agreement": _agreement(name, folder)}


def _trials(name: str, names: list[str], rounds: int, folder: Path) -> dict:
    runs = {k: [] for k in names}
    for n in range(rounds):
        for k in names:
            _progress(f"{name}, round {n + 1} of {rounds}: {k}")
            runs[k].append(_run(name, k, folder / f"{name}-{k}.npz" if n == 0 else NO_RESULT))  # results are the same in every round
    _progress("")
    results = {k: dict(np.load(folder / f"{name}-{k}.npz")) for k in names}
    return {"contestants": {k: _trial_summary(v) for k, v in runs.items()}, "agreement": judged(name, results)}


def _trial_summary(runs: list[dict]) -> dict:
    """Best and middle time of one call and per item (trial, point, solution)."""
    times = np.array([t for r in runs for t in r["times_s"]])
    beyond = [r["beyond_mb"] for r in runs]
    return {
        "min_s": float(times.min()),
        "median_s": float(np.median(times)),
        "calls": len(times),
        "items": runs[0]["items"],
        "per_item_s": float(times.min()) / runs[0]["items"],
        "beyond_mb": None if None in beyond else max(beyond),
    }


def _progress(words: str) -> None:
    """One line that a terminal shows and a log does not."""
    if sys.stderr.isatty():
        print(f"\r{words:<60}" if words else f"\r{'':<60}\r", end="", file=sys.stderr, flush=True)  # noqa: T201


def _run(case: str, name: str, result: Path | str) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "tests.experiments.bench.worker", case, name, str(result)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{case} {name} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def _summary(runs: list[dict]) -> dict:
    """Best and middle time over all rounds; the largest memory of any."""
    times = np.array([t for r in runs for t in r["times_s"]])
    beyond = [r["beyond_output_mb"] for r in runs]
    peak = [r["process_peak_mb"] for r in runs]
    return {
        "min_s": float(times.min()),
        "median_s": float(np.median(times)),
        "calls": len(times),
        "look_up_s": None if runs[0]["look_up_s"] is None else min(r["look_up_s"] for r in runs),
        "beyond_output_mb": None if None in beyond else max(beyond),
        "process_peak_mb": None if None in peak else max(peak),
        "output_mb": runs[0]["output_mb"],
    }


def _agreement(name: str, folder: Path) -> dict:
    """Largest difference from rule G and from the exact chain, both by the product's plain functions; peers are exact, ours first order."""
    case = make(name)
    motions = case.tables.motions(case.points)
    first = deviation_mm(case.tables.machine, case.points, motions)
    exact = exact_deviation_mm(case.tables.machine, case.points, motions)
    out = {}
    for k in [*OURS[name], *PEERS, *EXTRA[name]]:
        result = np.load(folder / f"{name}-{k}.npy")
        to_first, to_exact = float(np.abs(result - first).max()), float(np.abs(result - exact).max())
        ok = to_first < (ROUNDING_MM if k in OURS[name] else SECOND_ORDER_MM) and to_exact < SECOND_ORDER_MM
        out[k] = {"to_first_order_mm": to_first, "to_exact_mm": to_exact, "ok": ok}
    assert not set(out) & set(FLOORS[name])
    return out


if __name__ == "__main__":
    sys.exit(main())
