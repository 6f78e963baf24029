"""The discovery judged on cases that nobody tuned it on: made by `abbe.simulators.hidden`, answered by the product, judged by their truths.

    export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
    python -m tests.experiments.campaigns.discovery_suite --first 900001 --cases 60 [--kinds null] [--folder DIR] [--textbook] [--verbose]

One thread for linear algebra: matrices of some hundred unknowns get slower by more. With ``--folder`` cases, truths and answers stay there
and a broken-off run goes on where it was; Ctrl-C prints the table so far.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from abbe.simulators.hidden.cases import make_case
from abbe.simulators.hidden.draws import KINDS
from abbe.simulators.hidden.suite import kinds_of, write_case
from tests.experiments.campaigns.discovery import answered
from tests.experiments.campaigns.discovery_judge import Tally, judge, label

GOALS: dict[str, tuple[str, str]] = {
    # what: goal, what the reference attempt of discovery.md 1 reached (pooled)
    "one effect, snr_local >= 2": (">= 97 %", "91.0 %"),
    "... plans full/ballbar/one_*": (">= 99 %", "-"),
    "one effect, snr_total >= 10": (">= 95 %", "92.7 %"),
    "two effects: both, nothing else": (">= 92 %", "77.8 %"),
    "recall of visible effects": (">= 97 %", "-"),
    "null: false alarms": ("<= 1 %", "0.4 %"),
    "false names": ("<= 2 %", "9.3 %"),
    "outside of the catalogue: unknown": (">= 95 %", "98.1 %"),
    "... located": (">= 90 %", "72 %"),
    "ambiguity stated where there is one": (">= 95 %", "50 %"),
    "... separating measurement proposed": (">= 90 %", "62 %"),
    "ambiguity stated where there is none": ("<= 5 %", "-"),
    "sealed runs, seen, <= 1.10 floor": (">= 95 %", "93 %"),
    "sealed runs, new origin, plan full, <= 1.15 floor": (">= 90 %", "-"),
    "truth within +-2u": ("90-98 %", "-"),
}
SAMPLES: dict[str, tuple[float, str, str]] = {
    # what: second quantile, goal, reference attempt
    "sealed runs, seen, rms/floor": (0.95, "median <= 1.03", "1.022"),
    "sealed runs, new origin, rms/floor": (0.9, "-", "-"),
    "gap closed": (0.1, "median >= 0.94, 10 % >= 0.85", "0.93, 0.79"),
    "strength error, snr_local >= 2": (0.9, "median <= 2 %, 90 % <= 15 %", "1.6-4.5 %, 33 %"),
    "seconds": (1.0, "median <= 10, longest <= 30", "0.4-1.2"),
}


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(text)
    sys.stdout.flush()


def wilson(hits: int, of: int) -> tuple[float, float]:
    """95 % interval of a share, in percent."""
    if not of:
        return 0.0, 100.0
    z, p = 1.96, hits / of
    middle, half = p + z * z / 2 / of, z * math.sqrt(p * (1 - p) / of + z * z / 4 / of / of)
    return 100 * (middle - half) / (1 + z * z / of), 100 * (middle + half) / (1 + z * z / of)


def table(tally: Tally) -> str:
    """All shares and quantiles, with goals and what the reference attempt reached."""
    lines = [f"{'':52} {'found':>34}  {'goal':30} reference"]
    for what, (goal, reference) in GOALS.items():
        hits, of = tally.counts.get(what, [0, 0])
        low, high = wilson(hits, of)
        found = f"{100 * hits / of:5.1f} % ({hits}/{of}) [{low:.1f}, {high:.1f}]" if of else "-"
        lines.append(f"{what:52} {found:>34}  {goal:30} {reference}")
    for what, (q, goal, reference) in SAMPLES.items():
        values = tally.samples.get(what, [])
        found = f"median {np.median(values):.3f}, {100 * q:.0f} % {np.quantile(values, q):.3f} (n={len(values)})" if values else "-"
        lines.append(f"{what:52} {found:>34}  {goal:30} {reference}")
    if tally.wrong:
        lines.append("wrong: " + ", ".join(f"{what} x{n}" for what, n in tally.wrong.most_common(20)))
    return "\n".join(lines)


def judged(folder: Path, name: str, seed: int, kind: str, tally: Tally, *, wild: bool, verbose: bool) -> None:
    """Make, answer and judge one case; what is there already is not done again."""
    truth_file, answer_file = folder / "sealed" / f"{name}.json", folder / "answers" / f"{name}.json"
    if not truth_file.exists():  # written last
        write_case(make_case(name, seed, kind, wild=wild), folder)
    if not answer_file.exists():
        answered(folder / "public" / name, folder / "answers")
    truth, answer = json.loads(truth_file.read_text()), json.loads(answer_file.read_text())
    tally.sample("seconds", float(answer.get("cpu_s", 0.0)))
    if not judge(tally, truth, answer) and verbose:
        hidden = [(e["label"], round(e["snr_local"], 2), round(e["snr_total"]), e["aliases"][:3]) for e in truth["effects"]]
        found = [label(e) for e in answer["effects"]]
        say(f"\n{name} seed {seed} {truth['plan']} {truth['level']} {hidden} -> {answer['verdict']} {found}\n")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--textbook", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    with TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        (folder / "answers").mkdir(parents=True, exist_ok=True)
        tally, begin = Tally(), time.monotonic()
        kinds = kinds_of(options.cases, options.kinds.split(","), options.first)
        done = 0
        try:
            for i, kind in enumerate(kinds):
                judged(folder, f"case{i:04d}", options.first + i, kind, tally, wild=not options.textbook, verbose=options.verbose)
                done = i + 1
                say(f"\r{done}/{len(kinds)} cases, {time.monotonic() - begin:.0f} s")
        except KeyboardInterrupt:
            say("\nbroken off")
        say(f"\n{done} cases, seeds {options.first} to {options.first + done - 1}\n{table(tally)}\n")


if __name__ == "__main__":
    main()
