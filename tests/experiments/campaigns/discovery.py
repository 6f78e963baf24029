"""Answers of the discovery for a folder of campaigns, one JSON file each, to be judged by someone else's program.

python -m tests.experiments.campaigns.discovery --cases CASES --answers OUT [--only even|odd|case0001,case0002] [--jobs 1]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from abbe.models.discovery.discover import discover
from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.finding import finding_of
from abbe.service.domain.machine import machine_from_doc
from abbe.service.runs.cases import case_of
from abbe.service.runs.exchange import read_folder


def answered(folder: Path, out: Path) -> tuple[str, float]:
    """Discover one campaign and write its answer; its name and the seconds of processor time it took."""
    campaign = read_folder(folder)
    case = case_of(campaign.campaign, machine_from_doc(campaign.campaign["machine"]), campaign.runs)
    start = time.process_time()
    found = discover(case, CATALOGUE)
    seconds = time.process_time() - start
    nothing = {r.path.label: np.zeros(r.path.n) for r in case.runs}
    answer = answer_doc(finding_of(found, case, CATALOGUE, nothing))
    doc = answer | {"cpu_s": round(seconds, 2), "rejected": [list(r) for r in found.rejected]}
    (out / f"{folder.name}.json").write_text(json.dumps(doc))
    return folder.name, seconds


def chosen(folder: Path, only: str) -> bool:
    """Whether a case belongs to the half, or to the list, that was asked for."""
    number = re.search(r"(\d+)$", folder.name)
    if only in ("even", "odd"):
        return number is not None and int(number.group(1)) % 2 == (only == "odd")
    return not only or folder.name in only.split(",")


def main() -> None:
    """Run all chosen cases and print the median and the longest time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--only", default="")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the workers when they start
    args.answers.mkdir(parents=True, exist_ok=True)
    folders = [f for f in sorted(args.cases.iterdir()) if (f / "campaign.json").exists() and chosen(f, args.only)]
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        times = list(pool.map(answered, folders, [args.answers] * len(folders)))
    seconds = sorted(s for _, s in times)
    print(f"{len(times)} cases, processor time median {seconds[len(seconds) // 2]:.1f} s, longest {seconds[-1]:.1f} s")  # noqa: T201


if __name__ == "__main__":
    main()
