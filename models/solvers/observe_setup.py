"""Set-up unknowns of a campaign: cups, bars, mirrors, beams, zeros and drifts, with their priors.

Published methods take the set-ups as perfect (math.md 4.5, 5.4). Here each is an unknown with a documented prior
(`abbe.models.solvers.priors`).

- ``cup_<setup>_x/y/z``, mm: where the cup stands less where the machine really was when the spindle put it down: the mounting alone.
- ``bar_length_<radius>``, mm: what the reading is too long by (docs/explanation/conventions.md), so what the bar is SHORTER than it says;
  one per nominal radius, because one bar serves all runs of its length. Radii that are the same to 0.01 mm are one bar (`bar_length_name`).
- ``bar_drift_<setup>_x/y/z``, mm/s: slow growth of the tool against the cup since the set-up's first reading.
- ``tilt_<setup>_1/2``, rad: how far the mirror's normal leans towards the two directions of `perpendicular`.
- ``cosine_<setup>``: 1 / (m.l) - 1 of mirror m and beam l. The direction of the beam enters by this one number only, of second order in
  the angles (math.md 5.4), so it is the unknown and not the angles, whose derivative is zero where they are.
- ``laser_scale``: relative error of the laser's wavelength, common to all laser runs of the campaign.
- ``zero_<run>``, mm, and ``drift_<run>``, mm/s: error of a laser run's first record, which is its zero; slow drift.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors, bar_length_sd

LEAST_DRIFT_MM = 2e-5
"""A drift that cannot reach this (0.02 um) while a set-up stands is not worth three unknowns."""
SAME_PLACE_MM = 1e-3
SAME_BEAM = 1e-4
"""Two beams of one set-up may differ by this much (components of unit vectors): rounding, not another beam."""

STRAIGHT_MM = 0.01
"""A path that stays this near its own best line is a straight one: commanded positions are rounded to 1 um and less, and a mirror tilted
by 0.5 mrad makes 5 nm of it. Steps of a step diagonal are millimetres."""
NEAR_BEAM = 1e-3
"""A nominal beam may differ from a straight path by this much (components of unit vectors): it was written down with three digits or
more. What a tilted mirror makes of it is a scale of the run and counts in its cosine error."""
BAR_DIGITS = 2


@dataclass(frozen=True)
class SetupUnknowns:
    """Names and prior standard deviations of the set-up unknowns of a campaign; when each ball-bar set-up was first read, s."""

    names: tuple[str, ...]
    prior_sd: F1
    start_s: Mapping[str, float] = field(default_factory=dict)


def setup_unknowns(runs: tuple[RunData, ...], priors: Priors, machine: Machine | None = None) -> SetupUnknowns:
    """Set-up unknowns of a set of runs, named as the module says.

    Runs with the same nominal radius share one bar; where they state its length differently, the widest statement is believed. Runs with
    the same set-up share cup, mirror and beam.

    Parameters
    ----------
    machine : Machine, optional
        Machine whose tool applies to runs that state none. None: such a run has the tool of its set-up.

    Raises
    ------
    ValueError
        Two runs of one set-up with different cups, beams, tools or instruments: something was re-mounted, which is another set-up.
    """
    _check_setups(runs, None if machine is None else machine.tool_mm)
    spans = _bar_spans(runs)
    sd: dict[str, float] = {"laser_scale": priors.laser_scale} if any(r.kind == "laser" for r in runs) else {}
    for run in runs:
        if run.kind == "bar":
            sd |= _bar_unknowns(run, sd, priors, spans[run.setup])
        else:
            sd |= _laser_unknowns(run, priors)
    return SetupUnknowns(tuple(sd), np.array(list(sd.values())), {name: start for name, (start, _) in spans.items()})


def _bar_unknowns(run: RunData, known: Mapping[str, float], priors: Priors, span_s: tuple[float, float]) -> dict[str, float]:
    assert run.radius_mm is not None
    length = bar_length_name(run.radius_mm)
    out = {f"cup_{run.setup}_{a}": priors.cup_mm for a in "xyz"}
    out[length] = max(known.get(length, 0.0), bar_length_sd(run.u_length_mm, run.length_calibrated, priors))
    if priors.bar_drift_mm_s * (span_s[1] - span_s[0]) >= LEAST_DRIFT_MM:
        out |= {f"bar_drift_{run.setup}_{a}": priors.bar_drift_mm_s for a in "xyz"}
    return out


def _laser_unknowns(run: RunData, priors: Priors) -> dict[str, float]:
    """Tilts where they show; along a straight path the mirror's tilt times what the beam is off the path is one more cosine error."""
    out = {f"tilt_{run.setup}_{k}": priors.tilt_rad for k in "12"} if _bent(run) else {}
    away = 0.0 if out else _off_path(run)
    out[f"cosine_{run.setup}"] = float(np.hypot(priors.cosine, priors.tilt_rad * away))
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


def _check_setups(runs: tuple[RunData, ...], tool_mm: F1 | None) -> None:
    """Refuse what cannot be one mounting; ``tool_mm``: of a run that states none."""
    firsts: dict[str, RunData] = {}
    for given in runs:
        run = given if given.tool_mm is not None else replace(given, tool_mm=tool_mm)
        first = firsts.setdefault(run.setup, run)
        if first.tool_mm is None and run.tool_mm is not None:
            first = firsts[run.setup] = replace(first, tool_mm=run.tool_mm)
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
    return a is None or b is None or float(np.abs(a - b).max()) <= SAME_PLACE_MM


def _bent(run: RunData) -> bool:
    """Whether a tilted mirror shows: the path is no straight one, or one that the beam is not meant to follow.

    Judged by the path and not by the beam: one with six digits leaves any diagonal by a micrometre, and a tilt that reads as a scale of
    the run would hide that scale.
    """
    return straight_line_of(run.axes_mm) is None or _off_path(run) > NEAR_BEAM


def _off_path(run: RunData) -> float:
    """Sine of the angle between a straight path and the beam; 0 of a run that stands still."""
    assert run.beam is not None
    line = straight_line_of(run.axes_mm)
    return 0.0 if line is None or not line[1].any() else float(np.linalg.norm(np.cross(line[1], run.beam)))


def straight_line_of(axes_mm: F2) -> tuple[F1, F1] | None:
    """Middle and unit vector of the line that positions (n, 3) lie on within `STRAIGHT_MM`, else None.

    The vector points from the first position to the one farthest from it; zeros if the path stands still. Axes that move by less than the
    same limit do not move: their component is exactly zero.
    """
    middle = axes_mm.mean(axis=0)
    d = axes_mm - middle
    d = np.where(np.abs(d).max(axis=0) < STRAIGHT_MM, 0.0, d)
    if not d.any():
        return middle, np.zeros(3)
    along = np.linalg.svd(d, full_matrices=False)[2][0]
    along = np.where((d == 0.0).all(axis=0), 0.0, along)
    if np.abs(d - np.outer(d @ along, along)).max() >= STRAIGHT_MM:
        return None
    far = d[int(np.argmax(np.linalg.norm(axes_mm - axes_mm[0], axis=1)))] - d[0]
    return middle, along if far @ along >= 0.0 else -along


def bar_length_name(radius_mm: float) -> str:
    """Name of the unknown length of a bar: by its nominal radius rounded to 0.01 mm.

    The stored radius of one bar differs from run to run by its calibrated length and by rounding, two bars by millimetres.
    """
    return f"bar_length_{round(radius_mm, BAR_DIGITS):.10g}"


def perpendicular(beam: F1) -> F2:
    """Two unit vectors perpendicular to a beam and to each other, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])
