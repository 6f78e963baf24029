"""Final solution with the effects found, and its prediction of every run, sealed runs included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.discovery.candidate_bank import Pick, with_values
from abbe.models.discovery.case import CaseRun
from abbe.models.discovery.whitened_problem import WhitenedProblem, ordered
from abbe.models.effects.effect import Signal
from abbe.models.effects.path import Together

STEPS = 2
LONGEST_STEP = 0.3
"""Longest step of a non-linear parameter as a fraction of its value."""


@dataclass(frozen=True)
class SolvedModel:
    """Unknowns of the simulation and of the effects, fitted together to the identify runs, with usual sizes of errors as priors.

    Attributes
    ----------
    picks : the effects, with fitted non-linear parameters.
    theta, theta_covariance : unknowns of the simulation, mm and rad, and their covariance.
    coefficients, covariance : coefficients of each pick, those of its forms last, and their covariance.
    shape_u : standard uncertainty of the non-linear parameters of each pick, by name.
    """

    picks: tuple[Pick, ...]
    theta: F1
    theta_covariance: F2
    coefficients: tuple[F1, ...]
    covariance: tuple[F2, ...]
    shape_u: tuple[Mapping[str, float], ...]


def solve(problem: WhitenedProblem, picks: Sequence[Pick]) -> SolvedModel:
    """Fit simulation and effects together, including the non-linear parameters within their bounds (Gauss-Newton)."""
    picks = tuple(picks)
    raw, first, second = _steps(problem, picks)
    for _ in range(STEPS):
        parts = zip(picks, second.coefficients, raw, second.covariance, strict=True)
        moved = tuple(_moved(p, c[r.shape[1] :], cov) for p, c, r, cov in parts)
        if moved == picks:
            break
        picks = moved
        raw, first, second = _steps(problem, picks)
    shape_u = []
    for pick, r, cov in zip(picks, raw, second.covariance, strict=True):
        k = r.shape[1]
        shape_u.append({q.name: float(np.sqrt(cov[k + j, k + j])) for j, q in enumerate(pick.effect.shape)})
    linear = tuple(c[: r.shape[1], : r.shape[1]] for c, r in zip(second.covariance, raw, strict=True))
    return SolvedModel(picks, first.theta, second.theta_covariance, first.coefficients, linear, tuple(shape_u))


def _steps(problem: WhitenedProblem, picks: Sequence[Pick]) -> tuple[list[F2], SolvedModel, SolvedModel]:
    """Fit the picked effects twice: with their non-linear parameters fixed, then free.

    Returns the columns of each pick and the two fits.
    """
    raw = [p.raw(problem) for p in picks]
    sd = [p.prior_sd(problem, r.shape[1]) for p, r in zip(picks, raw, strict=True)]
    first = _fit(problem, raw, sd)
    slopes = [_slopes(problem, p, c) for p, c in zip(picks, first.coefficients, strict=True)]
    wide = [np.concatenate([r, s], axis=1) for r, s in zip(raw, slopes, strict=True)]
    return raw, first, _fit(problem, wide, [np.concatenate([s, _shape_sd(p)]) for p, s in zip(picks, sd, strict=True)])


def _shape_sd(pick: Pick) -> F1:
    return np.array([q.prior_sd for q in pick.effect.shape])


def _moved(pick: Pick, change: F1, covariance: F2) -> Pick:
    """Step the non-linear parameters of a pick, at most by `LONGEST_STEP`; skip steps below a tenth of the standard uncertainty."""
    k = len(covariance) - len(change)
    values = dict(pick.values)
    for j, q in enumerate(pick.effect.shape):
        if abs(change[j]) > 0.1 * np.sqrt(covariance[k + j, k + j]):
            most = LONGEST_STEP * max(abs(values[q.name]), 0.1 * (q.high - q.low))
            values[q.name] = float(np.clip(values[q.name] + np.clip(change[j], -most, most), q.low, q.high))
    return pick if values == dict(pick.values) else with_values(pick, values)


def _slopes(problem: WhitenedProblem, pick: Pick, coefficients: F1) -> F2:
    """Derivative of the reading with respect to each non-linear parameter, by central differences, shape (n, parameters)."""
    out = np.zeros((problem.gap.size, len(pick.effect.shape)))
    for j, q in enumerate(pick.effect.shape):
        value = pick.values[q.name]
        step = 1e-3 * abs(value) if value else 1e-3 * (q.high - q.low)
        ends = [with_values(pick, {**pick.values, q.name: value + s * step}).raw(problem) @ coefficients for s in (-1, 1)]
        out[:, j] = (ends[1] - ends[0]) / (2.0 * step)
    return out


def _fit(problem: WhitenedProblem, raw: Sequence[F2], sd: Sequence[F1]) -> SolvedModel:
    base, n, tangent, sd_mm = problem.base, problem.base.size, problem.tangent, problem.sd_mm()[:, None]
    white = problem.white(np.column_stack([problem.gap + tangent.raw @ problem.theta, *raw]))
    more = white[:, 1:]
    cross = ((white / sd_mm).T @ tangent.columns).T
    gram = np.block([[tangent.blend(problem.colours), cross[:, 1:]], [cross[:, 1:].T, more.T @ more]])
    root = scipy.linalg.block_diag(base.root, *(np.diag(s) for s in sd))
    gram = root.T @ gram @ root
    gram.flat[:: len(gram) + 1] += 1.0
    inverse = root @ np.linalg.inv(gram) @ root.T
    x = inverse @ np.concatenate([cross[:, 0], more.T @ white[:, 0]])
    at = n + np.concatenate([[0], np.cumsum([r.shape[1] for r in raw])]).astype(int)
    parts = [slice(i, j) for i, j in pairwise(at)]
    blocks = tuple(inverse[p, p] for p in parts)
    return SolvedModel((), x[:n], inverse[:n, :n], tuple(x[p] for p in parts), blocks, ())


def whole_rest(problem: WhitenedProblem, solved: SolvedModel) -> F1:
    """Return the whitened residuals of all valid readings, with or without weight (`WhitenedProblem.use`), and exact zeros for others."""
    model = problem.tangent.raw @ (solved.theta - problem.theta)
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        model = model + pick.raw(problem) @ c
    valid = np.concatenate([r.valid.astype(float) for r in problem.runs])
    left = (problem.gap - model) * valid
    return np.asarray(problem.white_all(left[:, None])[:, 0] * valid)


def predictions(problem: WhitenedProblem, solved: SolvedModel) -> dict[str, F1]:
    """Predict the readings of every run, sealed runs included, mm; set-up unknowns that no identify run determines are zero."""
    parts = shares(problem, solved)
    return {
        r.path.label: np.sum([problem.base.read(r.data(), solved.theta), *(part[r.path.label] for part in parts)], axis=0)
        for r in ordered(problem.case.runs)
    }


def shares(problem: WhitenedProblem, solved: SolvedModel) -> list[dict[str, F1]]:
    """Return the part of each pick in the predicted readings of every run, mm, by label of the run."""
    if not solved.picks:
        return []
    runs = ordered(problem.case.runs)
    paths = Together(problem.base.along(r.path, r.data(), solved.theta) for r in runs)
    identified = tuple(r.path.label in {p.label for p in problem.paths} for r in runs)
    out = []
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        used, total = 0, [np.zeros(p.n) for p in paths]
        for signal in (pick.effect.signal, *(f.signal for f in pick.forms)):
            columns = signal(paths, pick.key, pick.values)
            width = _width(signal, problem, pick)
            part = _spread(columns, identified, c[used : used + width])
            used += width
            total = [t + col @ part for t, col in zip(total, columns, strict=True)]
        out.append({p.label: t for p, t in zip(paths, total, strict=True)})
    return out


def _width(signal: Signal, problem: WhitenedProblem, pick: Pick) -> int:
    return int(signal(problem.paths, pick.key, pick.values)[0].shape[1])


def _spread(columns: Sequence[F2], identified: Sequence[bool], c: F1) -> F1:
    """Spread the coefficients c, fitted on identify runs, over the columns of all runs; 0 for columns that change no identify run."""
    if columns[0].shape[1] == c.size:
        return c
    observed = np.any([np.abs(col).max(axis=0) > 0.0 for col, known in zip(columns, identified, strict=True) if known], axis=0)
    out = np.zeros(columns[0].shape[1])
    out[np.flatnonzero(observed)] = c
    return out


def free_columns(run: CaseRun, fitted_setups: set[str]) -> F2:
    """Return columns of the unknowns fitted to the run itself: a laser's zero; cup and bar length of a set-up without identify runs."""
    p = run.path
    if p.kind == "laser":
        return np.ones((p.n, 1))
    if p.setup in fitted_setups:
        return np.zeros((p.n, 0))
    return np.column_stack([p.look, np.ones(p.n)])


def left_over(run: CaseRun, predicted_mm: F1, fitted_setups: set[str]) -> F1:
    """Reading minus prediction after fitting the run's own unknowns, mm; NaN for flagged readings."""
    assert run.deviation_mm is not None
    gap = np.where(run.valid, run.deviation_mm, 0.0) - np.where(run.valid, predicted_mm, 0.0)
    free = free_columns(run, fitted_setups) * run.valid[:, None]
    if free.shape[1]:
        gap = gap - free @ np.linalg.lstsq(free, gap, rcond=None)[0]
    return np.asarray(np.where(run.valid, gap, np.nan))


def left_together(runs: Sequence[CaseRun], predicted_mm: Mapping[str, F1], fitted_setups: set[str]) -> dict[str, F1]:
    """Return `left_over` of several runs, by label; ball-bar runs of the same set-up without identify runs share cup and bar lengths."""
    groups: dict[str, list[CaseRun]] = {}
    for run in runs:
        own_cup = run.path.kind == "bar" and run.path.setup not in fitted_setups
        groups.setdefault(f"set-up {run.path.setup}" if own_cup else f"run {run.path.label}", []).append(run)
    out: dict[str, F1] = {}
    for group in groups.values():
        if len(group) == 1:
            label = group[0].path.label
            out[label] = left_over(group[0], predicted_mm[label], fitted_setups)
        else:
            out |= _left_of_cup(group, predicted_mm)
    return out


def _left_of_cup(group: list[CaseRun], predicted_mm: Mapping[str, F1]) -> dict[str, F1]:
    """Residuals of runs about one cup after fitting its position and the length of each bar."""
    bars = sorted({r.path.radius_mm for r in group})
    rows, gaps = [], []
    for run in group:
        assert run.deviation_mm is not None
        length = np.array([float(run.path.radius_mm == bar) for bar in bars])
        rows.append(np.column_stack([run.path.look, np.tile(length, (run.path.n, 1))]) * run.valid[:, None])
        gaps.append(np.where(run.valid, run.deviation_mm, 0.0) - np.where(run.valid, predicted_mm[run.path.label], 0.0))
    free, gap = np.concatenate(rows), np.concatenate(gaps)
    left = gap - free @ np.linalg.lstsq(free, gap, rcond=None)[0]
    parts = np.split(left, np.cumsum([r.path.n for r in group])[:-1])
    return {r.path.label: np.asarray(np.where(r.valid, part, np.nan)) for r, part in zip(group, parts, strict=True)}
