"""A positioning test of one axis as campaign documents: positions both ways, cycles, what is put into it, and repeats at single places."""

from __future__ import annotations

from typing import Any

import numpy as np

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.service.discovery.discover import search
from abbe.service.discovery.finding import finding_of
from abbe.service.domain.finding import Finding
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.progress import ignore_progress
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.runs.cases import case_of
from tests.run_documents import runs_of

Doc = dict[str, Any]
MACHINE: Doc = {
    "name": "AXIS",
    "chain": "w-X-b-Y-Z-t",
    "vertical_axis": "Z",
    "stroke_mm": {"X": [0.0, 400.0], "Y": [-1.0, 1.0], "Z": [-1.0, 1.0]},
}
HEAD: Doc = {
    "format": "abbe-campaign/1",
    "campaign": "axis",
    "machine": MACHINE,
    "current_model": {"includes": ["rigid21"], "errors": None},
    "instruments": {"laser": {"resolution_mm": 1e-4}},
    "temperature_sensors": False,
}


def axis_run(number: int, x_mm: Any, direction: Any, reading_um: Any, role: str = "identify", setup: str = "L") -> Doc:
    """One ``laser_linear`` along X, a reading every 10 s, rounded to 0.1 um."""
    n = len(x_mm)
    columns: Doc = {
        "t_s": (600.0 * number + 10.0 * np.arange(n)).tolist(),
        "x_mm": list(map(float, x_mm)),
        "y_mm": [0.0] * n,
        "z_mm": [0.0] * n,
    }
    columns |= {"feed_mm_min": [3000.0] * n, "direction": [int(d) for d in direction]}
    columns["deviation_mm"] = [round(float(v) * 1e-3, 4) for v in reading_um]
    along = {"setup_id": setup, "t_set_s": 0.0, "axis": "X", "start_mm": [20.0, 0, 0], "end_mm": [320.0, 0, 0], "nominal_beam": [1.0, 0, 0]}
    head = {"format": "abbe-run/1", "campaign": "axis", "run_id": f"r{number:02d}", "test": "laser_linear", "role": role}
    return head | {"machine": MACHINE, "setup": along, "columns": columns}


def cycles(
    count: int = 5,
    *,
    lost_um: float = 0.0,
    scale_um_m: float = 0.0,
    drift_um_h: float = 0.0,
    shape: Any = None,
    noise_um: float = 0.4,
    seed: int = 1,
) -> list[Doc]:
    """Eleven positions out and back, ``count`` times in one set-up; the last one only judges where there are three or more."""
    rng, out = np.random.default_rng(seed), []
    x = np.tile(np.concatenate([np.linspace(20.0, 320.0, 11), np.linspace(320.0, 20.0, 11)]), 1)
    way = np.concatenate([np.ones(11), -np.ones(11)])
    for k in range(1, count + 1):
        hours = (600.0 * k + 10.0 * np.arange(22)) / 3600.0
        y = -0.5 * lost_um * way + scale_um_m * 1e-3 * (x - 20.0) + drift_um_h * hours + rng.normal(0.0, noise_um, 22)
        y = y if shape is None else y + shape(x)
        out.append(axis_run(k, x, way, y, "holdout" if k == count and count > 2 else "identify"))
    return out


def with_repeats(shape: Any, *, lost_um: float = 0.0, noise_um: float = 0.3, seed: int = 2) -> list[Doc]:
    """Twenty-two positions out and back once; then, only to judge, ten visits from both sides at three places in set-ups of their own."""
    rng = np.random.default_rng(seed)
    out = np.linspace(20.0, 320.0, 22)
    x, way = np.concatenate([out, out[::-1]]), np.concatenate([np.ones(22), -np.ones(22)])
    runs = [axis_run(1, x, way, shape(x) - 0.5 * lost_um * way + rng.normal(0.0, noise_um, 44))]
    for k, place in enumerate((80.0, 170.0, 260.0), start=2):
        back = np.tile([1.0, -1.0], 10)
        at = np.full(20, place)
        runs.append(axis_run(k, at, back, shape(at) - 0.5 * lost_um * back + rng.normal(0.0, noise_um, 20), "holdout", f"H{k}"))
    return runs


def axis_case(runs: list[Doc]) -> Case:
    """The runs as the discovery takes them."""
    return case_of(HEAD, machine_from_doc(MACHINE), runs_of(runs))


def searched(runs: list[Doc]) -> tuple[Discovery, Finding]:
    """What the search finds, as it is, and as the finding that is stored."""
    return found_in(axis_case(runs))


def found_in(case: Case) -> tuple[Discovery, Finding]:
    """The same of a case."""
    from abbe.service.effects.axis_test import SLOW_DRIFT

    found = search(case, catalogue(), ignore_progress)
    return found, finding_of(found, case, (*catalogue(), SLOW_DRIFT), {r.path.label: np.zeros(r.path.n) for r in case.runs})
