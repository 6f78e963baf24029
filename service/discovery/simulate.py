"""What the present model says every run should read: fitted to the runs that may be fitted, the model book's effects included."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.case import CaseRun, Role
from abbe.models.discovery.prediction import left_together, predictions, solve
from abbe.models.discovery.whitened_problem import scene_of
from abbe.service.campaign_data.packed_arrays import packed
from abbe.service.discovery.discover import DiscoveryJob
from abbe.service.discovery.discovery_doc import noise_mm_of

FORMAT = "abbe-simulation/1"
ROLES: tuple[Role, ...] = ("identify", "holdout")
AGREE = 1.1
"""Gap over noise up to which the two are said to agree. Fitting and estimating the noise alone give up to 1.05."""


@dataclass(frozen=True)
class Simulation:
    """Readings of every run as the present model has them, and what measurement leaves of them.

    ``predicted_mm``: by run, sealed runs too, as the instrument would read it; ``left_mm``: reading less prediction once the runs have
    set what is their own (the zero of a laser run, cup and bar length of a set-up that no fitted run shares), NaN where the
    instrument flagged it; ``noise_mm``: of one reading, by instrument.
    """

    predicted_mm: dict[str, F1]
    left_mm: dict[str, F1]
    noise_mm: dict[str, float]


def simulate(job: DiscoveryJob) -> Simulation:
    """Fit the present model to the identify runs and predict every run of the campaign."""
    scene = scene_of(job.case, baseline_of(job.case))
    predicted = predictions(scene, solve(scene, ()))
    seen = {r.path.setup for r in scene.runs}
    left = left_together([r for r in job.case.runs if r.deviation_mm is not None], predicted, seen)
    total = {label: p + job.known_mm[label] + job.table_mm.get(label, 0.0) for label, p in predicted.items()}
    return Simulation(total, left, {kind: c.sd_mm for kind, c in scene.colours.items()})


def gap_doc(job: DiscoveryJob, told: Simulation) -> dict[str, Any]:
    """The gap of every run and role, µm: rms of measured minus simulated, and the noise that no model takes out."""
    runs = {r.path.label: _run(r, told) for r in job.case.runs}
    gaps = {}
    for role in ROLES:
        some = [r for r in job.case.of(role) if r.path.label in told.left_mm]
        if some:
            left = np.concatenate([told.left_mm[r.path.label] for r in some])
            floor = np.concatenate([np.full(r.path.n, noise_mm_of(told.noise_mm, r.path.kind)) for r in some])
            if np.isfinite(left).any():  # the instrument flagged every reading: nothing to compare
                gaps[role] = {"before_um": _rms(left) * 1e3, "floor_um": _rms(floor[np.isfinite(left)]) * 1e3}
    return {"gaps": gaps, "runs": runs, "noise_um": {kind: v * 1e3 for kind, v in told.noise_mm.items()}}


def simulation_doc(job: DiscoveryJob, told: Simulation) -> dict[str, Any]:
    """The simulation as JSON: the gap per run and role, and every prediction, mm."""
    head = {"format": FORMAT, "campaign": job.campaign.name, "machine": job.campaign.site.name, "present_model": sorted(job.case.includes)}
    known = {"model_version": None if job.base is None else job.base.version, "known_effects": list(job.known)}
    return (
        head | known | gap_doc(job, told) | {"flags": list(job.flags), "predictions": {k: v.tolist() for k, v in told.predicted_mm.items()}}
    )


def simulated_finding(job: DiscoveryJob, told: Simulation) -> dict[str, Any]:
    """The simulation in the form that the page of a finding is drawn from: nothing was looked for, before and after are the same."""
    doc = gap_doc(job, told)
    runs = {label: r | ({"rms_after_um": r["rms_before_um"]} if "rms_before_um" in r else {}) for label, r in doc["runs"].items()}
    gaps = {role: g | {"after_um": g["before_um"]} for role, g in doc["gaps"].items()}
    series = {label: {"before": packed(v), "after": packed(v)} for label, v in told.left_mm.items()}
    empty: dict[str, Any] = {
        "verdict": "none",
        "p_value": 1.0,
        "effects": [],
        "where": {},
        "next_test": None,
        "rejected": [],
        "confounded_with": [],
    }
    return empty | {"runs": runs, "gaps": gaps, "series": series, "noise_um": doc["noise_um"]}


def verdict_line(doc: dict[str, Any]) -> tuple[str, str, str]:
    """Sign, word and sentence: how far the present model is from the readings. Whether that is more than chance, `abbe discover` says."""
    times = {role: g["before_um"] / g["floor_um"] for role, g in doc["gaps"].items() if g["floor_um"] > 0.0}
    worst = max(times.values(), default=1.0)
    word = "Measured and simulated agree" if worst < AGREE else "Measured and simulated differ"
    told = "; ".join(f"{role} runs {g['before_um']:.2f} µm rms where {g['floor_um']:.2f} µm is noise" for role, g in doc["gaps"].items())
    more = "" if worst < AGREE else " What is missing, abbe discover looks for."
    return ("ok" if worst < AGREE else "open"), f"{word}.", f"{told[:1].upper()}{told[1:]}.{more}"


def _run(run: CaseRun, told: Simulation) -> dict[str, Any]:
    doc = {"test": run.path.test, "role": run.role, "readings": run.path.n, "floor_um": noise_mm_of(told.noise_mm, run.path.kind) * 1e3}
    left = told.left_mm.get(run.path.label)
    return doc if left is None else doc | {"rms_before_um": _rms(left) * 1e3}


def _rms(values: F1) -> float:
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if good.size else 0.0
