"""What a run reads of a machine and its set-up: unknowns with their priors, linearised reading, reading.

Cup offsets, bar lengths, mirror tilts, laser zeros and drifts are unknowns with documented priors (`models.solvers.priors`): published
methods take the set-ups as perfect (math.md 4.5, 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.arrays import F1, F2, F3
from models.geometry.bases import Term
from models.geometry.chain import design
from models.machine import Machine
from models.solvers.observations import RunData
from models.solvers.priors import Priors, bar_length_sd


def with_tool(machine: Machine, tool_mm: F1 | None) -> Machine:
    """The machine with another tool, for rule G's levers; None: its own."""
    return machine if tool_mm is None else replace(machine, tool_mm=tool_mm)


@dataclass(frozen=True)
class Setup:
    """Names and priors of the set-up unknowns of a campaign."""

    names: tuple[str, ...]
    prior_sd: F1


def setup_unknowns(runs: tuple[RunData, ...], priors: Priors) -> Setup:
    """Set-up unknowns of a set of runs: per cup, per bar length, per mirror, per laser run.

    Runs with the same nominal radius share one bar; where they state its length differently, the widest statement is believed.
    """
    sd: dict[str, float] = {}
    for run in runs:
        if run.kind == "bar":
            sd |= {f"cup_{run.setup}_{a}": priors.cup_mm for a in "xyz"}
            bar = f"bar_length_{run.radius_mm:g}"
            sd[bar] = max(sd.get(bar, 0.0), bar_length_sd(run.u_length_mm, run.length_calibrated, priors))
        else:
            if _bent(run):
                sd |= {f"tilt_{run.setup}_{k}": priors.tilt_rad for k in "12"}
            sd[f"zero_{run.label}"] = priors.zero_mm
            sd[f"drift_{run.label}"] = priors.drift_mm_s
    return Setup(tuple(sd), np.array(list(sd.values())))


def perpendicular(beam: F1) -> F2:
    """Two unit vectors perpendicular to a beam and to each other, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])


def _bent(run: RunData) -> bool:
    """Whether the path leaves the beam, so that a tilted mirror shows."""
    assert run.beam is not None
    d = run.axes_mm - run.axes_mm[0]
    return bool(np.abs(d - np.outer(d @ run.beam, run.beam)).max() > 1e-6)


def bar_normals(run: RunData) -> F2:
    """Unit vectors from the nominal cup to the commanded positions, shape (n, 3)."""
    assert run.centre_mm is not None
    d = run.axes_mm - run.centre_mm
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def run_field(machine: Machine, terms: tuple[Term, ...], run: RunData) -> F3:
    """Design of the deviation along a run, with the run's own tool, shape (n, 3, terms)."""
    return design(with_tool(machine, run.tool_mm), terms, run.axes_mm)


def run_design(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: Setup) -> F2:
    """Linearised reading per unit of every unknown of the campaign, shape (n, terms + 3 + set-up)."""
    field = run_field(machine, terms, run)
    lost = -0.5 * run.sign
    out = np.zeros((run.deviation_mm.size, len(setup.names)))
    at = {name: i for i, name in enumerate(setup.names)}
    if run.kind == "bar":
        n = bar_normals(run)
        for k, a in enumerate("xyz"):
            out[:, at[f"cup_{run.setup}_{a}"]] = -n[:, k]
        out[:, at[f"bar_length_{run.radius_mm:g}"]] = 1.0
        return np.concatenate([np.einsum("ni,nik->nk", n, field), n * lost, out], axis=1)
    assert run.beam is not None
    d = run.axes_mm - run.axes_mm[0]
    if _bent(run):
        for k, t in enumerate(perpendicular(run.beam)):
            out[:, at[f"tilt_{run.setup}_{k + 1}"]] = d @ t
    out[:, at[f"zero_{run.label}"]] = 1.0
    out[:, at[f"drift_{run.label}"]] = run.t_s - run.t_s[0]
    seen = np.einsum("i,nik->nk", run.beam, field - field[0])
    return np.concatenate([seen, (lost - lost[0]) * run.beam, out], axis=1)


def predict(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: Setup, theta: F1) -> F1:
    """Reading of a run for given unknowns; the ball-bar without linearisation, shape (n,)."""
    if run.kind == "laser":
        return np.asarray(run_design(machine, terms, run, setup) @ theta)
    assert run.centre_mm is not None
    assert run.radius_mm is not None
    at = {name: i for i, name in enumerate(setup.names)}
    n_terms = len(terms)
    tip = run.axes_mm - run.centre_mm + run_field(machine, terms, run) @ theta[:n_terms]
    tip = tip - 0.5 * run.sign * theta[n_terms : n_terms + 3]
    rest = theta[n_terms + 3 :]
    tip = tip - np.array([rest[at[f"cup_{run.setup}_{a}"]] for a in "xyz"])
    return np.asarray(np.linalg.norm(tip, axis=1) - run.radius_mm + rest[at[f"bar_length_{run.radius_mm:g}"]])
