"""Details of a motion that neither a smooth nor a rough basis follows: one unknown per place of a step test.

A screw with a lead of 10 mm, read every 40 mm, looks like a slow wave. Four step diagonals stop at the same places of each axis, so the
deviation of a motion at such a place is common to all four, and a separate unknown keeps it out of the smooth motions.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import motion_names
from abbe.models.machine import AXES
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SetupUnknowns
from abbe.models.solvers.priors import Priors

PLACE_MM = 0.01
"""Positions of an axis within this distance are one place."""
MOST_PLACES = 80
"""An axis with more places in a run is read so densely that a basis can follow it."""
FEWEST_PLACES = 3
LEAST_SHARE = 1e-3
"""A motion of which the beam sees a smaller share is left out."""


def with_details(setup: SetupUnknowns, runs: tuple[RunData, ...], priors: Priors) -> SetupUnknowns:
    """Return the set-up unknowns with a detail ``detail_<motion>_<mm>`` of every translational motion at every place of the laser runs."""
    seen = {run.label: _seen(run) for run in runs if run.kind == "laser"}
    names = tuple(dict.fromkeys(name for columns in seen.values() for name in columns))
    if not names:
        return setup
    sd = np.concatenate([setup.prior_sd, np.full(len(names), priors.detail_mm)])
    at = {name: len(setup.names) + i for i, name in enumerate(names)}
    details = {}
    for run in runs:
        if run.label in seen:
            details[run.label] = np.zeros((run.deviation_mm.size, sd.size))
            for name, column in seen[run.label].items():
                details[run.label][:, at[name]] = column
    return replace(setup, names=setup.names + names, prior_sd=sd, details=details)


def _seen(run: RunData) -> dict[str, F1]:
    """Reading of a laser run, relative to its first record, per unit of every detail that the run sees."""
    assert run.beam is not None
    out: dict[str, F1] = {}
    for a, c in product(range(3), range(3)):
        places = np.round(run.axes_mm[:, a] / PLACE_MM).astype(np.int64)
        each = np.unique(places)
        if abs(run.beam[c]) < LEAST_SHARE or not FEWEST_PLACES <= each.size <= MOST_PLACES:
            continue
        for place in each:
            there: F2 = np.where(places == place, run.beam[c], 0.0)
            out[f"detail_{motion_names(AXES[a])[c]}_{place * PLACE_MM:g}"] = np.asarray(there - there[0])
    return out
