"""The bench's campaigns with sealed truths: always the same seeds, every kind, made by the simulators' own formulas."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path

from abbe.models.discovery.case import Case
from abbe.service.domain.machine import machine_from_doc
from abbe.service.runs.cases import case_of
from abbe.service.runs.exchange import read_folder
from abbe.simulators.hidden import plans
from abbe.simulators.hidden.cases import make_case
from abbe.simulators.hidden.suite import write_case

FIRST_SEED = 5_200_000
"""Chosen before anything was run, and used for nothing else: nobody tunes on the bench's cases."""
CASES = 16
KINDS = ("single", "double", "null", "unknown", "single", "double", "single", "null")
"""One round of cases; 16 are 6 with one effect, 4 with two, 4 with none, 2 with one that no catalogue knows."""


LONG, LONG_SEED, LONG_KIND = "long", 7_700_001, "unknown"
"""Of five long campaigns (one effect, two twice, none, an unknown one) this one took most memory before anything was done about it."""
LONG_HELIX, LONG_CIRCLE = 1250, 972
"""Readings per run at which plan "full" has 19 998 of a ball-bar that are fitted or judge: the most that are searched one by one."""


def kinds_of(count: int) -> list[str]:
    """Kinds of the first ``count`` cases: the first four are one of each."""
    return list(islice(cycle(KINDS), count))


def write_cases(folder: Path, count: int) -> list[str]:
    """Write ``public/<case>/`` and ``sealed/<case>.json``; gives the names."""
    names = []
    for i, kind in enumerate(kinds_of(count)):
        names.append(f"case{i:04d}")
        write_case(make_case(names[-1], FIRST_SEED + i, kind), folder)
    return names


def write_long(folder: Path) -> str:
    """Write the long campaign beside the others; gives its name."""
    with _readings_per_run(LONG_HELIX, LONG_CIRCLE):
        write_case(make_case(LONG, LONG_SEED, LONG_KIND), folder)
    return LONG


@contextmanager
def _readings_per_run(helix: int, circle: int) -> Iterator[None]:
    """Runs are read more often, everything else stays as practice has it."""
    usual = plans.HELIX_N, plans.CIRCLE_N
    plans.HELIX_N, plans.CIRCLE_N = helix, circle
    try:
        yield
    finally:
        plans.HELIX_N, plans.CIRCLE_N = usual


def measured_bar_readings(case: Case) -> int:
    """Readings of a ball-bar that are fitted or judge."""
    return sum(r.path.n for r in case.of("identify", "holdout") if r.path.kind == "bar")


def read_case(folder: Path, name: str) -> Case:
    """A campaign as `abbe discover` reads it; its truth is not looked at."""
    campaign = read_folder(folder / "public" / name)
    return case_of(campaign.campaign, machine_from_doc(campaign.campaign["machine"]), campaign.runs)


def truth(folder: Path, name: str) -> dict:
    """What is sealed of a case."""
    return json.loads((folder / "sealed" / f"{name}.json").read_text(encoding="utf-8"))
