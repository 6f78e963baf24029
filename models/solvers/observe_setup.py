"""Set-up unknowns of a campaign: cups, bars, mirrors, beams, zeros and drifts, with their priors.

Published methods take the set-ups as perfect (math.md 4.5, 5.4). Here each is an unknown with a documented prior (`models.solvers.priors`).

- ``cup_<setup>_x/y/z``, mm: where the cup stands less where the machine really was when the spindle put it down: the mounting alone.
- ``bar_length_<radius>``, mm: what the bar is longer than it says; one per nominal radius, because one bar serves all runs of its length.
- ``bar_drift_<setup>_x/y/z``, mm/s: slow growth of the tool against the cup since the set-up's first reading.
- ``tilt_<setup>_1/2``, rad: how far the mirror's normal leans towards the two directions of `perpendicular`.
- ``cosine_<setup>``: 1 / (m.l) - 1 of mirror m and beam l. The direction of the beam enters by this one number only, of second order in
  the angles (math.md 5.4), so it is the unknown and not the angles, whose derivative is zero where they are.
- ``laser_scale``: relative error of the laser's wavelength, common to all laser runs of the campaign.
- ``zero_<run>``, mm, and ``drift_<run>``, mm/s: error of a laser run's first record, which is its zero; slow drift.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from models.arrays import F1, F2
from models.solvers.observations import RunData
from models.solvers.priors import Priors, bar_length_sd

LEAST_DRIFT_MM = 2e-5
"""A drift that cannot reach this (0.02 um) while a set-up stands is not worth three unknowns."""
SAME_PLACE_MM = 1e-3
SAME_BEAM = 1e-4
"""Two beams of one set-up may differ by this much (components of unit vectors): rounding, not another beam."""

STATED = ("laser_scale", "cosine_", "drift_", "bar_drift_")
"""How the names of unknowns begin that no hand sets and that are known within their prior, and never free when ranks are counted: else a
wavelength good to 0.3e-6 would hide every scale, and a drift of the cup (linear in time, as the height is in a helix) a squareness."""


@dataclass(frozen=True)
class Setup:
    """Names and prior standard deviations of the set-up unknowns of a campaign; when each ball-bar set-up was first read, s."""

    names: tuple[str, ...]
    prior_sd: F1
    start_s: Mapping[str, float] = field(default_factory=dict)


def setup_unknowns(runs: tuple[RunData, ...], priors: Priors) -> Setup:
    """Set-up unknowns of a set of runs, named as the module says.

    Runs with the same nominal radius share one bar; where they state its length differently, the widest statement is believed. Runs with
    the same set-up share cup, mirror and beam.

    Raises
    ------
    ValueError
        Two runs of one set-up with different cups, beams, tools or instruments: something was re-mounted, which is another set-up.
    """
    _check_setups(runs)
    spans = _bar_spans(runs)
    sd: dict[str, float] = {"laser_scale": priors.laser_scale} if any(r.kind == "laser" for r in runs) else {}
    for run in runs:
        if run.kind == "bar":
            sd |= _bar_unknowns(run, sd, priors, spans[run.setup])
        else:
            sd |= _laser_unknowns(run, priors)
    return Setup(tuple(sd), np.array(list(sd.values())), {name: start for name, (start, _) in spans.items()})


def _bar_unknowns(run: RunData, known: Mapping[str, float], priors: Priors, span_s: tuple[float, float]) -> dict[str, float]:
    length = f"bar_length_{run.radius_mm:g}"
    out = {f"cup_{run.setup}_{a}": priors.cup_mm for a in "xyz"}
    out[length] = max(known.get(length, 0.0), bar_length_sd(run.u_length_mm, run.length_calibrated, priors))
    if priors.bar_drift_mm_s * (span_s[1] - span_s[0]) >= LEAST_DRIFT_MM:
        out |= {f"bar_drift_{run.setup}_{a}": priors.bar_drift_mm_s for a in "xyz"}
    return out


def _laser_unknowns(run: RunData, priors: Priors) -> dict[str, float]:
    out = {f"tilt_{run.setup}_{k}": priors.tilt_rad for k in "12"} if _bent(run) else {}
    out[f"cosine_{run.setup}"] = priors.cosine
    out[f"zero_{run.label}"] = priors.zero_mm
    out[f"drift_{run.label}"] = priors.drift_mm_s
    return out


def _bar_spans(runs: tuple[RunData, ...]) -> dict[str, tuple[float, float]]:
    """First and last reading of every ball-bar set-up, s."""
    spans: dict[str, tuple[float, float]] = {}
    for run in runs:
        if run.kind == "bar":
            first, last = spans.get(run.setup, (np.inf, -np.inf))
            spans[run.setup] = (min(first, float(run.t_s.min())), max(last, float(run.t_s.max())))
    return spans


def _check_setups(runs: tuple[RunData, ...]) -> None:
    """Refuse what cannot be one mounting."""
    firsts: dict[str, RunData] = {}
    for run in runs:
        first = firsts.setdefault(run.setup, run)
        if run.kind != first.kind:
            what = "instrument"
        elif run.centre_mm is not None and first.centre_mm is not None and np.abs(run.centre_mm - first.centre_mm).max() > SAME_PLACE_MM:
            what = "cup"
        elif run.beam is not None and first.beam is not None and np.abs(run.beam - first.beam).max() > SAME_BEAM:
            what = "beam"
        elif not _same_tool(run.tool_mm, first.tool_mm):
            what = "tool"
        else:
            continue
        raise ValueError(f"run {run.label}: set-up {run.setup} has another {what} than in run {first.label}; re-mounted is a new set-up")


def _same_tool(a: F1 | None, b: F1 | None) -> bool:
    """Whether two runs use one tool: with another, the same axis positions meet another cup, and the mirror was taken off in between."""
    return a is b if a is None or b is None else float(np.abs(a - b).max()) <= SAME_PLACE_MM


def _bent(run: RunData) -> bool:
    """Whether the path leaves the beam, so that a tilted mirror shows (along it 0.5 mrad meets lateral errors only: 5 nm at 10 um)."""
    assert run.beam is not None
    d = run.axes_mm - run.axes_mm[0]
    return bool(np.abs(d - np.outer(d @ run.beam, run.beam)).max() > 1e-6)


def perpendicular(beam: F1) -> F2:
    """Two unit vectors perpendicular to a beam and to each other, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])
