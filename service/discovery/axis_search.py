"""Search a positioning test of one axis for a drift of its repeats, then for catalogue effects that exceed the scatter of the repeats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery, Fitted, Significance
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import ShareSink, discover
from abbe.models.discovery.finding import gaps_of
from abbe.models.discovery.lack import Floor
from abbe.models.discovery.solved_model import left_over, predictions, solve
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.effect import Effect
from abbe.models.probability import chi2_above
from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.service.effects.axis_test import AXES, axis_drift, drift_at, places_of

CHANCE = 1e-3
"""Largest probability that chance alone explains an effect that is reported."""


@dataclass(frozen=True)
class _Scatter:
    """Scatter of repeated visits: ``sd_mm``, and the factor ``long`` by which correlation of neighbours raises the variance of sums."""

    sd_mm: float
    long: float


def axis_discovery(case: Case, effects: tuple[Effect, ...], progress: ShareSink | None = None) -> Discovery:
    """Search a test of one axis for a drift of its repeats, then the readings without that drift for effects of the catalogue.

    The effects must exceed the scatter of the repeats, which is known without a noise model. If no effect does,
    return the result of `axis_drift`.
    """
    drift = axis_drift(case)
    drifts = drift_at(case) if drift is not None and drift.verdict == "named" else {}
    quiet = _without(case, drifts)
    found = discover(quiet, effects, progress=progress)
    fitted, scatter = _scale(quiet), _scatter(quiet)
    if drift is None or scatter is None:
        return replace(found, fitted=fitted)
    if found.verdict == "none" or not _exceeds_scatter(quiet, found, scatter):
        return replace(drift, fitted=fitted)
    table = (*drift.location.table, *found.location.table)
    if drift.verdict == "none":
        return replace(found, location=replace(found.location, table=table), fitted=fitted)
    return replace(_combined(case, drift, found, drifts, table), fitted=fitted)


def _without(case: Case, drifts: dict[str, F1]) -> Case:
    runs = tuple(
        r if r.deviation_mm is None or r.path.label not in drifts else replace(r, deviation_mm=r.deviation_mm - drifts[r.path.label])
        for r in case.runs
    )
    return replace(case, runs=runs)


def _combined(case: Case, drift: Discovery, found: Discovery, drifts: dict[str, F1], table: tuple[Significance, ...]) -> Discovery:
    """Join the drift and the other named effects to one finding; its residuals "before" still contain the drift."""
    problem = whiten(case, baseline_of(case))
    before = predictions(problem, solve(problem, ()))
    fitted_setups = {r.path.setup for r in problem.runs}
    left = {r.path.label: left_over(r, before[r.path.label], fitted_setups) for r in case.runs if r.deviation_mm is not None}
    floor = {kind: Floor(sd, 1.0) for kind, sd in found.noise_mm.items()}
    return replace(
        found,
        verdict="named" if found.verdict == "named" else "unknown",
        effects=(*drift.effects, *found.effects),
        location=replace(found.location, table=table),
        next_test=drift.next_test or found.next_test,
        gaps=gaps_of(problem, left, found.residual_after_mm, floor),
        residual_before_mm=left,
        predicted_mm={label: v + drifts[label] for label, v in found.predicted_mm.items()},
        predicted_before_mm=before,
        p_value=min(drift.p_value, found.p_value),
        confounded_with=(*drift.confounded_with, *found.confounded_with),
    )


def _scatter(case: Case) -> _Scatter | None:
    """Return the scatter of the fitted runs; None if they repeat too few places to tell, or if all repeats are equal."""
    runs = case.of("identify")
    if len(runs) < 2:
        return None
    place, y, run = _stacked(case)
    columns = np.column_stack([place[:, None] == np.unique(place), run[:, None] == np.unique(run)]).astype(np.float64)
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    freedom = y.size - int(np.linalg.matrix_rank(columns))
    if freedom < len(runs) or not left.any():
        return None
    near = run[1:] == run[:-1]
    memory = float(left[1:][near] @ left[:-1][near] / max(float(left @ left), 1e-300))
    memory = min(max(memory, 0.0), 0.9)
    return _Scatter(float(np.sqrt(left @ left / freedom)), (1.0 + memory) / (1.0 - memory))


def _stacked(case: Case) -> tuple[F1, F1, F1]:
    """Return the place, value and run number of all valid readings of the fitted runs."""
    runs = case.of("identify")
    data = [(places_of(r)[r.valid], r.data().deviation_mm[r.valid]) for r in runs]
    number = np.concatenate([np.full(len(p), float(k)) for k, (p, _) in enumerate(data)])
    return np.concatenate([p for p, _ in data]), np.concatenate([y for _, y in data]), number


def _exceeds_scatter(case: Case, found: Discovery, scatter: _Scatter) -> bool:
    """Check whether the finding shifts positions by more than their repeats allow, and every named effect exceeds its own U.

    The shift is the part of the residuals that the named effects explain, or all of the residuals if no effect was named.
    """
    if any(abs(e.strength) <= 2.0 * e.u_strength for e in found.effects):
        return False
    runs = case.of("identify")
    resolution = case.resolution_mm["laser"] / np.sqrt(12.0)
    before, after = found.residual_before_mm, found.residual_after_mm
    moves = [np.nan_to_num(before[r.path.label] - (after[r.path.label] if found.effects else 0.0))[r.valid] for r in runs]
    moved = np.concatenate([m - m.mean() for m in moves])
    place, _, _ = _stacked(case)
    _, at, count = np.unique(place, return_inverse=True, return_counts=True)
    means = np.bincount(at, moved) / count
    square = float(count @ means**2) / (max(scatter.sd_mm, resolution) ** 2 * scatter.long)
    return bool(chi2_above(square, len(count)) < CHANCE)


def _scale(case: Case) -> tuple[Fitted, ...]:
    """Fit the scale of the axis, um/m. The search does not look for it, because the present model contains it.

    Least squares, together with a zero of every run and a lost motion that varies along the axis.
    """
    runs = case.of("identify")
    look = runs[0].path.look[0]
    axis = int(np.argmax(np.abs(look)))
    x = np.concatenate([(r.path.at.q_mm @ look)[r.valid] for r in runs])
    x -= x.mean()
    up = np.concatenate([r.path.at.sign[r.valid, axis] for r in runs])
    y = np.concatenate([r.data().deviation_mm[r.valid] for r in runs])
    run = np.repeat(np.arange(len(runs)), [int(r.valid.sum()) for r in runs])
    columns = np.column_stack([x, up, x * up, run[:, None] == np.unique(run)]).astype(np.float64)
    freedom = y.size - int(np.linalg.matrix_rank(columns))
    if freedom < 1 or float(np.ptp(x)) <= 0.0:
        return ()
    c = np.linalg.lstsq(columns, y, rcond=None)[0]
    left = y - columns @ c
    u = float(np.sqrt(left @ left / freedom * np.linalg.pinv(columns.T @ columns)[0, 0] + U_WAVELENGTH**2))
    return (Fitted("scale", AXES[axis], float(c[0]) * 1e6, u * 1e6, "um/m"),)
