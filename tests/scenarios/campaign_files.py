"""Campaigns of the independent truth as exchange files: what an export of a shop's measurements holds, one reading a row."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.models.solvers.observations import RunData
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.machine import machine_doc
from abbe.service.site import Site
from tests.experiments.campaigns import population

Doc = dict[str, Any]
EVERY = 4
"""Of 2000 readings of a ball-bar run every fourth is kept: tests read and write many files."""


@cache
def _measured(seed: int, kind: population.Kind) -> tuple[Site, str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(population, "BLOCKS", 10**6)  # readings, not averages
        case = population.draw_case(seed, kind)
    site = Site(f"M{seed}", case.machine, machine_doc(f"M{seed}", case.machine), DeviceUrls())
    return site, json.dumps([_document(run, site.doc) for run in case.runs])


def measured(seed: int, kind: population.Kind = "joint") -> tuple[Site, list[Doc]]:
    """Machine number ``seed`` and its runs as ``abbe-run/1``; fresh copies, to be spoiled."""
    site, text = _measured(seed, kind)
    return site, json.loads(text)


def thinned(runs: list[Doc], every: int) -> list[Doc]:
    """The same runs with every n-th reading of a ball-bar: for what does not depend on how many there are."""
    parts = {run["run_id"]: every if run["test"].startswith("ballbar") else 1 for run in runs}
    return [run | {"columns": {name: values[:: parts[run["run_id"]]] for name, values in run["columns"].items()}} for run in runs]


def machine_of(seed: int, kind: population.Kind = "joint") -> Site:
    """Machine number ``seed`` alone."""
    return _measured(seed, kind)[0]


def _document(run: RunData, machine: Doc) -> Doc:
    if run.kind == "bar":
        run = replace(run, **{k: getattr(run, k)[::EVERY] for k in ("axes_mm", "deviation_mm", "sign", "t_s", "weight_n")})
    n = run.deviation_mm.size
    columns = {f"{c}_mm": run.axes_mm[:, k].tolist() for k, c in enumerate("xyz")}
    columns = {
        "t_s": run.t_s.tolist(),
        **columns,
        "feed_mm_min": [_feed_mm_min(run)] * n,
        "direction": [1] * n,
        "deviation_mm": run.deviation_mm.tolist(),
    }
    test, setup = _bar(run) if run.kind == "bar" else _laser(run)
    setup |= {"setup_id": run.setup, "t_set_s": float(run.t_s[0])}
    if run.tool_mm is not None:
        setup["tool_mm"] = run.tool_mm.tolist()
    head = {"format": "abbe-run/1", "campaign": "c1", "run_id": run.label, "test": test, "role": "identify", "machine": machine}
    return head | {"setup": setup, "columns": columns}


def _feed_mm_min(run: RunData) -> float:
    """A ball-bar moves all the time: its feed is path over time. A laser run stands still at every point: what its drives were told."""
    if run.kind == "laser":
        return 1000.0
    return float(np.linalg.norm(np.diff(run.axes_mm, axis=0), axis=1).sum() / (run.t_s[-1] - run.t_s[0]) * 60.0)


def _bar(run: RunData) -> tuple[str, Doc]:
    setup = {"centre_mm": run.centre_mm.tolist(), "radius_mm": run.radius_mm, "length_calibrated": run.length_calibrated}
    if run.u_length_mm is not None:
        setup["u_length_mm"] = run.u_length_mm
    if run.label.startswith("circle"):
        return "ballbar_circle", setup | {"plane": run.label[-2:]}
    return "ballbar_helix", setup | {"turns": 5.0}


def _laser(run: RunData) -> tuple[str, Doc]:
    far = int(np.argmax((run.axes_mm - run.axes_mm[0]) @ run.beam))
    start, end = run.axes_mm[0], run.axes_mm[far]
    setup = {"start_mm": start.tolist(), "end_mm": end.tolist(), "nominal_beam": run.beam.tolist()}
    if run.label.startswith("line"):
        return "laser_linear", setup | {"axis": run.label[4]}
    steps = round(int(np.count_nonzero(np.abs(np.diff(run.axes_mm[: far + 1], axis=0)) > 1e-9)) / 3)
    _, diagonal, order = run.label.split("_")
    return "laser_diagonal", setup | {
        "diagonal": diagonal,
        "order": order,
        "steps": steps,
        "increment_mm": ((end - start) / steps).tolist(),
    }


def write_folder(folder: Path, machine: Doc, runs: list[Doc]) -> Path:
    """A campaign folder (run-format.md 4)."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for k, run in enumerate(runs):
        name = f"r{k:02d}.json"
        (folder / name).write_text(json.dumps(run))
        entries.append({"run_id": run["run_id"], "test": run["test"], "role": run["role"], "file": name})
    head = {"format": "abbe-campaign/1", "campaign": "c1", "machine": machine, "temperature_sensors": False, "runs": entries}
    model = {"current_model": {"includes": ["rigid21"], "errors": None}, "instruments": {}, "setups": {}}
    (folder / "campaign.json").write_text(json.dumps(head | model))
    return folder
