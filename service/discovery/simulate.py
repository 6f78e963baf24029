"""Predict every run with the present model, fitted to the identify runs, including the effects of the model book."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.case import CaseRun, Role
from abbe.models.discovery.solved_model import left_together, predictions, solve
from abbe.models.discovery.whitened_problem import whiten
from abbe.service.discovery.discover import DiscoveryJob
from abbe.service.discovery.finding import noise_mm_of, rms
from abbe.service.domain.finding import Finding, GapUm, PackedReadings, RunResidual, RunSeries

FORMAT = "abbe-simulation/1"
ROLES: tuple[Role, ...] = ("identify", "holdout")
AGREE = 1.1
"""Ratio of gap to noise up to which measured and simulated agree. Fitting and noise estimation alone give up to 1.05."""


@dataclass(frozen=True)
class Simulation:
    """Predicted readings of every run and their residuals.

    ``predicted_mm``: readings of the instrument by run label, sealed runs included; ``residual_mm``: measured minus predicted, after
    fitting each run's own set-up values (the zero of a laser run, cup and bar length of a set-up without a fitted run), NaN where the
    instrument flagged the reading; ``noise_mm``: noise of one reading, by instrument.
    """

    predicted_mm: dict[str, F1]
    residual_mm: dict[str, F1]
    noise_mm: dict[str, float]


def simulate(job: DiscoveryJob) -> Simulation:
    """Fit the present model to the identify runs and predict every run of the campaign."""
    problem = whiten(job.case, baseline_of(job.case))
    predicted = predictions(problem, solve(problem, ()))
    fitted_setups = {r.path.setup for r in problem.runs}
    left = left_together([r for r in job.case.runs if r.deviation_mm is not None], predicted, fitted_setups)
    total = {label: p + job.known_mm[label] + job.table_mm.get(label, 0.0) for label, p in predicted.items()}
    return Simulation(total, left, {kind: c.sd_mm for kind, c in problem.colours.items()})


def simulated_finding(job: DiscoveryJob, simulation: Simulation) -> Finding:
    """Return the gap of every run and role as a finding without a search: before and after are equal."""
    gaps: dict[str, GapUm] = {}
    for role in ROLES:
        some = [r for r in job.case.of(role) if r.path.label in simulation.residual_mm]
        if some:
            left = np.concatenate([simulation.residual_mm[r.path.label] for r in some])
            floor = np.concatenate([np.full(r.path.n, noise_mm_of(simulation.noise_mm, r.path.kind)) for r in some])
            if np.isfinite(left).any():  # otherwise the instrument flagged every reading: nothing to compare
                gap_um = rms(left) * 1e3
                gaps[role] = GapUm(before_um=gap_um, after_um=gap_um, floor_um=rms(floor[np.isfinite(left)]) * 1e3)
    packed = {label: PackedReadings.of(v) for label, v in simulation.residual_mm.items()}
    return Finding(
        case=job.case.name,
        verdict="none",
        noise_um={kind: v * 1e3 for kind, v in simulation.noise_mm.items()},
        gaps=gaps,
        runs={r.path.label: _run(r, simulation) for r in job.case.runs},
        series={label: RunSeries(before=v, after=v) for label, v in packed.items()},
    )


def _run(run: CaseRun, simulation: Simulation) -> RunResidual:
    floor_um = noise_mm_of(simulation.noise_mm, run.path.kind) * 1e3
    left = simulation.residual_mm.get(run.path.label)
    gap_um = None if left is None else rms(left) * 1e3
    return RunResidual(test=run.path.test, role=run.role, readings=run.path.n, floor_um=floor_um, rms_before_um=gap_um, rms_after_um=gap_um)


def simulation_doc(job: DiscoveryJob, simulation: Simulation) -> dict[str, Any]:
    """Return the simulation as JSON: the gap per run and role, µm, and every prediction, mm."""
    found = simulated_finding(job, simulation)
    head = {"format": FORMAT, "campaign": job.campaign.name, "machine": job.campaign.site.name, "present_model": sorted(job.case.includes)}
    known = {"model_version": None if job.base is None else job.base.version, "known_effects": list(job.known)}
    gaps = {role: {"before_um": gap.before_um, "floor_um": gap.floor_um} for role, gap in found.gaps.items()}
    runs = {label: {k: v for k, v in asdict(r).items() if k != "rms_after_um" and v is not None} for label, r in found.runs.items()}
    predictions = {label: v.tolist() for label, v in simulation.predicted_mm.items()}
    return (
        head | known | {"gaps": gaps, "runs": runs, "noise_um": dict(found.noise_um), "flags": list(job.flags), "predictions": predictions}
    )


def verdict_line(found: Finding) -> tuple[str, str, str]:
    """Return sign, headline and text about the gap of the present model. `abbe discover` tests whether it exceeds chance."""
    worst = max((g.before_um / g.floor_um for g in found.gaps.values() if g.floor_um > 0.0), default=1.0)
    text = ", ".join(f"{g.before_um:.2f} µm rms in {role} runs (noise alone: {g.floor_um:.2f} µm)" for role, g in found.gaps.items())
    text = f"The gap is {text}."
    if worst < AGREE:
        return "ok", "Measured and simulated agree.", text
    return "open", "Measured and simulated differ.", f"{text} abbe discover looks for what is missing."
