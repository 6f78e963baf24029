"""Runs that show an error motion: how strongly the readings of each run change with it."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.geometry.bases import Term, term_values
from abbe.models.machine import Machine
from abbe.models.solvers.designs import unit_columns
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import run_design, setup_unknowns
from abbe.models.solvers.priors import Priors

LOST = 3
NODES = 41
ROUNDING = 1e-9


def run_sensitivity(machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...]) -> tuple[tuple[str, ...], F2]:
    """Rms change of the readings of each run per unit rms of each motion over its stroke, mean over the motion's shapes.

    The part that unknowns of the set-up (cup, bar, mirror, drift) absorb is removed; the part that other motions could explain stays.

    Returns
    -------
    motions : tuple of str
        Names in the order of the terms.
    sensitivity : array (runs, motions)
        mm per mm, or mm per rad for rotations and squareness.
    """
    nodes = np.stack([np.linspace(lo, hi, NODES) for lo, hi in machine.stroke_mm], axis=1)
    values = term_values(terms, nodes, machine.stroke_mm)
    names = tuple(dict.fromkeys(t.motion for t in terms))
    setup = setup_unknowns(runs, Priors(), machine)
    out = np.zeros((len(runs), len(names)))
    for i, run in enumerate(runs):
        rows = run_design(machine, terms, run, setup)
        own, _ = unit_columns(rows[:, len(terms) + LOST :])
        left, size, _ = np.linalg.svd(own, full_matrices=False)
        taken = left[:, size > ROUNDING]
        rest = rows[:, : len(terms)]
        rest = rest - taken @ (taken.T @ rest)
        for k, name in enumerate(names):
            at = [j for j, t in enumerate(terms) if t.motion == name]
            basis = values[:, at] if terms[at[0]].order else np.ones((1, 1))
            mean_square = basis.T @ basis / len(basis)
            power = np.trace(np.linalg.solve(mean_square, rest[:, at].T @ rest[:, at]))
            out[i, k] = np.sqrt(max(float(power), 0.0) / (len(rest) * len(at)))
    return names, out
