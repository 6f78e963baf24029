"""What the discovery says when a campaign's files lie: directions shuffled, feeds hidden, temperatures dropped, runs' times exchanged.

python -m tests.experiments.campaigns.discovery_mutations --first 77000 --count 10 [--kinds single,null] [--only feed,clock]

A lie may cost the answer its name (weaker: none, unknown, or a rival stated); it must not give it a confident wrong one.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.discover import discover
from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.campaign_data.campaign_checks import check_files, refuse
from abbe.service.errors import AbbeError
from abbe.service.runs.cases import case_of
from abbe.service.site import machine_from_doc
from abbe.simulators.hidden.draws import KINDS
from abbe.simulators.hidden.suite import campaign, make_suite, run_file, sealed
from tests.experiments.campaigns.discovery_judge import label
from tests.run_documents import runs_of

Doc = dict[str, Any]
Documents = tuple[Doc, list[Doc]]
"""A campaign object and its run objects."""
Mutation = Callable[[Documents, np.random.Generator], Documents]
VISIBLE = 10.0


def untouched(files: Documents, rng: np.random.Generator) -> Documents:
    """As measured: what the lies are compared with."""
    return files


def direction_shuffled(files: Documents, rng: np.random.Generator) -> Documents:
    """Every run's ``direction`` in another order of its readings."""
    for run in files[1]:
        run["columns"]["direction"] = rng.permutation(run["columns"]["direction"]).tolist()
    return files


def direction_flipped(files: Documents, rng: np.random.Generator) -> Documents:
    """About half of all runs say that they went the other way."""
    for run in files[1]:
        sign = int(rng.choice([-1, 1]))
        run["columns"]["direction"] = [sign * d for d in run["columns"]["direction"]]
    return files


def feed_hidden(files: Documents, rng: np.random.Generator) -> Documents:
    """All runs say the same feed."""
    for run in files[1]:
        run["columns"]["feed_mm_min"] = [1500.0] * len(run["columns"]["t_s"])
    return files


def temperatures_dropped(files: Documents, rng: np.random.Generator) -> Documents:
    """No sensor was read."""
    for run in files[1]:
        run["columns"] = {k: v for k, v in run["columns"].items() if not k.startswith("temp_")}
    return files[0] | {"temperature_sensors": False}, files[1]


def clock_shuffled(files: Documents, rng: np.random.Generator) -> Documents:
    """Runs exchange their places in time; within a run, and when set-ups were mounted, all stays."""
    runs = sorted(files[1], key=lambda r: float(r["columns"]["t_s"][0]))
    spans = [(r["columns"]["t_s"][0], r["columns"]["t_s"][-1]) for r in runs]
    pauses = [b[0] - a[1] for a, b in itertools.pairwise(spans)] + [0.0]
    start = spans[0][0]
    for k, pause in zip(rng.permutation(len(runs)), pauses, strict=True):
        columns = runs[k]["columns"]
        columns["t_s"] = [round(t - spans[k][0] + start, 4) for t in columns["t_s"]]
        start = columns["t_s"][-1] + pause
    return files


MUTATIONS: dict[str, Mutation] = {
    "none": untouched, "direction shuffled": direction_shuffled, "direction flipped": direction_flipped, "feed hidden": feed_hidden,
    "temperatures dropped": temperatures_dropped, "clock shuffled": clock_shuffled,
}  # fmt: skip


def documents(case: Any) -> Documents:
    """Files of a hidden case as an importer reads them."""
    noisy = {r.run_id: case.setting.noise.put(case.clean_mm[r.run_id], r, case.setting.seed) for r in case.runs}
    files = campaign(case), [run_file(case, r, noisy[r.run_id]) for r in case.runs]
    read: Documents = json.loads(json.dumps(files))
    return read[0], read[1]


def truth_of(case: Any) -> Doc:
    """The sealed truth of a hidden case."""
    return sealed(case, {r.run_id: case.clean_mm[r.run_id] for r in case.runs})


def answered(files: Documents, *, checked: bool) -> Discovery | str:
    """What the workflow says: a discovery, or why the campaign is refused."""
    doc, runs = files
    machine = machine_from_doc(doc["machine"])
    try:
        if checked:
            refuse(check_files(doc["machine"], runs_of(r for r in runs if r["role"] == "identify")))
        return discover(case_of(doc, machine, runs_of(runs)), CATALOGUE)
    except AbbeError as error:
        return str(error)


def graded(truth: Doc, found: Discovery | str) -> str:
    """ "right", "weaker" (refused, none, unknown, or the truth is a stated rival), or "wrong": a confident wrong name."""
    if isinstance(found, str):
        return "refused"
    names = [e.label for e in found.effects]
    good = {n for e in truth["effects"] for n in (e["label"], *e["aliases"], *e["explained_by_catalogue"])}
    if truth["kind"] == "unknown":
        good |= {n for n in names if n.split(":")[0] == truth["effects"][0]["name"]}
    allowed = {label(n) for n in good}
    wrong = [e for e in found.effects if label(e.label) not in allowed and not allowed & {label(a) for a, _ in e.alternatives}]
    if wrong:
        return "wrong"
    visible = [e for e in truth["effects"] if e["snr_total"] >= VISIBLE]
    if truth["kind"] in ("null", "unknown"):
        asked = {"null": "none", "unknown": "unknown"}[truth["kind"]]
        return "right" if found.verdict == asked or names else "weaker"
    named = {label(n) for n in names}
    return "right" if all({label(n) for n in (e["label"], *e["aliases"])} & named for e in visible) else "weaker"


def said(found: Discovery | str) -> str:
    """An answer in one word or two."""
    return found if isinstance(found, str) else "+".join(e.label for e in found.effects) or found.verdict


def main() -> None:
    """Print every answer that is not right, and the rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=77000)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--only", default="", help="mutations by a word of their names, separated by commas")
    parser.add_argument("--unchecked", action="store_true", help="without the workflow's checks of its files")
    args = parser.parse_args()
    chosen = [m for m in MUTATIONS if not args.only or any(word in m for word in args.only.split(","))]
    rates: dict[str, Counter[str]] = {m: Counter() for m in chosen}
    for case in make_suite(args.first, args.count, args.kinds.split(",")):
        truth, files = truth_of(case), documents(case)
        hidden = "+".join(f"{e['label']} ({e['snr_total']:.0f})" for e in truth["effects"]) or "nothing"
        for m in chosen:
            mutated = MUTATIONS[m](copy.deepcopy(files), np.random.default_rng([case.setting.seed, 5]))
            found = answered(mutated, checked=not args.unchecked)
            grade = graded(truth, found)
            rates[m][grade] += 1
            if grade != "right":
                print(f"{case.name} {truth['plan']:10} {hidden} | {m}: {grade}: {said(found)}", flush=True)  # noqa: T201
    for m, rate in rates.items():
        print(f"{m:22}" + ", ".join(f"{grade} {n}/{rate.total()}" for grade, n in sorted(rate.items())))  # noqa: T201


if __name__ == "__main__":
    main()
