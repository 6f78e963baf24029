"""Variance effects in the rounds of a search: found beside those of earlier rounds, and removed from the problem.

Later rounds look for scatter in residuals without the known vibrations and stick-slips, so that what they leave gets no second name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.solved_model import solve, whole_rest
from abbe.models.discovery.variance.creeping_axis import band
from abbe.models.discovery.variance.scatter_effects import DRIVES, VarianceFinding, extra_variance, rough_place, teeth_mm2
from abbe.models.discovery.whitened_problem import Tangent, WhitenedProblem, with_projection
from abbe.models.effects.path import Path
from abbe.models.machine import AXES

LEAST_LEFT = 0.1
"""Least share of a reading's noise variance that a projection is taken to leave."""


def scattered(problem: WhitenedProblem, picks: Sequence[Pick], known: Sequence[VarianceFinding]) -> tuple[VarianceFinding, ...]:
    """Find variance effects beside the ``known`` ones in the residuals of simulation and ``picks``, which include laser outliers.

    What is found together with a vibration or a stick-slip must be found again when that one is taken out of the residuals (`calmed`).
    """
    white = problem.by_run(whole_rest(problem, solve(problem, picks)))
    found = _beside(problem, white, known)
    drives = [f for f in found if f.name in DRIVES]
    if len(drives) in (0, len(found)):
        return found
    again = _beside(problem, white, [*known, *drives])
    return (*drives, *(f for f in again if f.label in {g.label for g in found}))


def _beside(problem: WhitenedProblem, white: Sequence[F1], known: Sequence[VarianceFinding]) -> tuple[VarianceFinding, ...]:
    """Find variance effects in whitened residuals (one array per run) from which the ``known`` ones are taken out."""
    sigma = tuple(problem.colours[k].sd_mm for k in problem.kinds)
    rest = calmed(problem.paths, white, sigma, known)
    leverage = tuple(problem.by_run(problem.projection.leverage))
    alone = tuple(problem.by_run(1.0 - problem.lone(np.concatenate(rest) * problem.sd_mm())))
    return extra_variance(problem.paths, rest, sigma, leverage=leverage, colours=problem.colours, alone=alone, known=known)


def calmed(paths: Sequence[Path], whitened: Sequence[F1], sigma_mm: Sequence[float], known: Sequence[VarianceFinding]) -> tuple[F1, ...]:
    """Take known vibrations and stick-slips out of whitened residuals, one array (n,) per run; noise alone keeps its variance.

    A vibration is projected out of every ball-bar run, with an amplitude that may swell and fade
    (`abbe.models.discovery.variance.creeping_axis.band`). A stick-slip has no known course, so its readings are divided by their scatter.
    Exact zeros stay. ``sigma_mm``: noise of one reading of each run.
    """
    out = [np.asarray(r, dtype=np.float64) for r in whitened]
    for f in known:
        if f.name == "vibration":
            out = [_without_vibration(p, r, f) if p.kind == "bar" else r for p, r in zip(paths, out, strict=True)]
        elif f.name == "stick_slip":
            teeth = np.split(teeth_mm2(paths, f), np.cumsum([p.n for p in paths])[:-1])
            out = [r / np.sqrt(1.0 + t / s**2) for r, t, s in zip(out, teeth, sigma_mm, strict=True)]
    return tuple(out)


def _without_vibration(path: Path, rest: F1, found: VarianceFinding) -> F1:
    """Project a vibration out of the residuals of a run, and make good the noise that is projected out with it."""
    base = band(found.parameters["frequency_hz"], AXES.index(found.key), path, rest != 0.0)
    left = np.maximum(1.0 - np.square(base).sum(axis=1), LEAST_LEFT)
    return np.asarray((rest - base @ (base.T @ rest)) / np.sqrt(left))


def without(problem: WhitenedProblem, findings: Sequence[VarianceFinding]) -> WhitenedProblem:
    """Remove variance effects: project vibrations out of each ball-bar run, and weight readings with excess scatter down."""
    waves, use = [problem.also], problem.use
    for f in findings:
        if f.name == "vibration":
            waves.append(_waves(problem, AXES.index(f.key), f.parameters["frequency_hz"]))
        elif f.name == "stick_slip":
            use = use / np.sqrt(1.0 + teeth_mm2(problem.paths, f) / np.square(problem.sd_mm()))
        elif f.name == "unnamed_rough":
            there = np.concatenate(rough_place(problem.paths, f.key))
            use = use * np.where(there > 0, 1.0 / f.parameters["times"], 1.0)
        elif f.name == "unnamed_burst":
            use = use * (1.0 - _burst(problem, f.parameters["t0_s"], f.parameters["width_s"]))
    problem = replace(problem, also=np.concatenate(waves, axis=1))
    if (use != problem.use).any():
        tangent = Tangent.of(problem.tangent.raw, use, problem.lengths, problem.kinds, problem.colours)
        problem = replace(problem, use=use, tangent=tangent)
    return with_projection(problem)


def _waves(problem: WhitenedProblem, axis: int, frequency_hz: float) -> F2:
    """Columns of a vibration along an axis: a sine and a cosine for every ball-bar run, mm per mm."""
    out = np.zeros((problem.gap.size, 2 * sum(k == "bar" for k in problem.kinds)))
    start = column = 0
    for path in problem.paths:
        if path.kind == "bar":
            phase = 2.0 * np.pi * frequency_hz * (path.at.t_s - path.at.t_s[0])
            out[start : start + path.n, column : column + 2] = path.look[:, axis, None] * np.stack([np.sin(phase), np.cos(phase)], axis=1)
            column += 2
        start += path.n
    return out


def _burst(problem: WhitenedProblem, t0_s: float, width_s: float) -> F1:
    return np.concatenate([(np.abs(p.at.t_s - t0_s) < 1.5 * width_s) * float(p.kind == "bar") for p in problem.paths])
