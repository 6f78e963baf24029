"""How readings outside the fit agree with their prediction: holdout runs, tested against noise and the uncertainty of the prediction;
without holdout runs, blocks of the fitted runs that are left out of the fit in turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Agreement, Gap, Unjudged
from abbe.models.discovery.case import CaseRun
from abbe.models.discovery.instrument_noise import beside_turns, lone, unscaled
from abbe.models.discovery.lack import Floor
from abbe.models.discovery.solved_model import SolvedModel, free_columns, left_over
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.probability import f_above

LAGS = 10
"""Lags over which the autocorrelation of the whitened noise is summed. At the last lag the usual correlation (`instrument_noise.MEMORY`)
has fallen to 6 %; more lags would add mainly noise."""
BLOCKS, SHORTEST = 12, 8
"""Blocks per run, and readings in the shortest block. The blocks resolve up to six periods, and eight or more degrees of freedom remain
after cup and length are fitted. Over a block the usual correlation falls to a tenth, so block sums are nearly independent."""
FREE_MM = 1.0
"""Prior standard deviation of a run's own unknowns, mm, so wide that these unknowns are free."""
NO_NOISE = "the noise of the instrument cannot be estimated from the fitted runs"
TOO_FEW = "too few of their readings count"


@dataclass(frozen=True)
class _Noise:
    """Noise of one instrument, estimated from the whitened residuals of the fitted runs.

    ``variance``: ratio of a reading's variance to the assumed one. ``freedom``: degrees of freedom of this estimate. ``spread``: variance
    of the mean square of the residuals, as a multiple of its value for independent normal readings. ``long``: variance of the mean of many
    readings, as a multiple of its value for independent readings, 1 or more.
    """

    variance: float
    freedom: float
    spread: float
    long: float


def agreements(
    problem: WhitenedProblem, solved: SolvedModel, predicted_mm: Mapping[str, F1]
) -> tuple[tuple[Agreement, ...], tuple[Unjudged, ...]]:
    """Test how every holdout run agrees with its prediction by a solution without effects; the worst run first.

    A run's whitened residual is tested twice, reading by reading and in block sums (sensitive to smooth deviations), weighted by the
    inverse covariance of noise and prediction together. Its mean square over the mean square of the fitted runs of the same instrument
    follows an F distribution, with fewer degrees of freedom where readings are correlated or have long tails. p is twice the smaller p of
    both tests.

    Parameters
    ----------
    problem : fitted runs with their noise.
    solved : solution of this problem without effects.
    predicted_mm : predicted reading of every run, shape (n,), by label of the run.

    Returns
    -------
    tuple of Agreement
        Their ``p`` is family-wise over the runs (Sidak).
    tuple of Unjudged
        Runs of an instrument of unknown noise (not fitted, or without degrees of freedom), and runs with too few valid readings.
    """
    noise = {kind: _noise(problem, kind) for kind in problem.colours}
    root = _root(solved.theta_covariance)
    fitted_setups = {r.path.setup for r in problem.runs}
    found, open_ = [], []
    for run in (r for r in problem.case.of("holdout") if r.deviation_mm is not None):
        label, known = run.path.label, noise.get(run.path.kind)
        if known is None:
            open_.append(Unjudged(label, NO_NOISE))
            continue
        tested = _worse(*_white(problem, solved, root * np.sqrt(known.long), run, predicted_mm[label], fitted_setups), known)
        if tested is None:
            open_.append(Unjudged(label, TOO_FEW))
        else:
            found.append((label, *tested))
    tried = len(found)
    every = [Agreement(label, times, float(-np.expm1(tried * np.log1p(-min(p, 1.0 - 1e-12))))) for label, times, p in found]
    return tuple(sorted(every, key=lambda a: (a.p, a.run))), tuple(open_)


def _root(covariance: F2) -> F2:
    """Factor R with R R^T = ``covariance``; eigenvalues that rounding made negative count as zero."""
    values, vectors = scipy.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _noise(problem: WhitenedProblem, kind: str) -> _Noise | None:
    """Estimate the noise of an instrument from its fitted runs; None if these have too few degrees of freedom."""
    res, leverage, use = (problem.by_run(v) for v in (problem.projection.residual, problem.projection.leverage, problem.use))
    mine = [k for k, name in enumerate(problem.kinds) if name == kind]
    parts = [res[k][use[k] > 0] for k in mine]
    total, count = sum(float(r @ r) for r in parts), sum(r.size for r in parts)
    freedom = sum(float(np.sum((1.0 - leverage[k])[use[k] > 0])) for k in mine)
    if total <= 0.0 or freedom <= 1.0:
        return None
    rho = np.array([sum(float(r[lag:] @ r[:-lag]) for r in parts if r.size > lag) / total for lag in range(1, LAGS + 1)])
    fourth = count * sum(float(np.sum(r**4)) for r in parts) / total**2
    spread = 1.0 + max(0.5 * (fourth - 3.0), 0.0) + 2.0 * float(np.sum(np.maximum(rho**2 - 1.0 / count, 0.0)))
    long = 1.0 + 2.0 * float(np.sum(rho * (1.0 - np.arange(1, LAGS + 1) / (LAGS + 1.0))))
    return _Noise(total / freedom, freedom, spread, max(long, 1.0))


def _white(
    problem: WhitenedProblem, solved: SolvedModel, root: F2, run: CaseRun, predicted_mm: F1, fitted_setups: set[str]
) -> tuple[F2, int]:
    """Return columns over the valid readings of a run, and the number of the last columns that are the run's own unknowns.

    The first column is the whitened residual. Each other column is the effect of one standard deviation of one unknown of the prediction.
    All are whitened with the assumed noise; `_tested` applies the ratio of estimated to assumed noise.
    """
    p, data = run.path, run.data()
    gap = np.where(run.valid, data.deviation_mm - predicted_mm, 0.0)
    left = np.where(run.valid, left_over(run, predicted_mm, fitted_setups), 0.0)
    keep = run.valid * lone(left, [p.n], [p.kind], beside_turns([p]), problem.case.resolution_mm)
    free = free_columns(run, fitted_setups)
    columns = np.column_stack([gap, problem.base.linear(data, solved.theta)[1] @ root, FREE_MM * free]) * keep[:, None]
    white = unscaled(columns, [p.n], [p.kind], problem.colours) / problem.colours[p.kind].sd_mm
    return np.asarray(white[keep > 0]), free.shape[1]


def _worse(white: F2, free: int, known: _Noise) -> tuple[float, float] | None:
    """Ratio of rms to expected rms, and p, for single readings or block sums, whichever is worse; None if neither can be tested."""
    tests = [_tested(white, free, known, 1.0, known.spread), _tested(_sums(white), free, known, known.long, 1.0)]
    tested = [t for t in tests if t is not None]
    if not tested:
        return None
    times, p = min(tested, key=lambda t: t[1])
    return times, min(1.0, len(tested) * p)


def _sums(white: F2) -> F2:
    """Return sums over blocks of equal size, scaled so that white noise keeps its variance."""
    count = min(BLOCKS, len(white) // SHORTEST)
    if count < 1:
        return np.zeros((0, white.shape[1]))
    parts = np.array_split(white, count)
    return np.array([part.sum(axis=0) / np.sqrt(len(part)) for part in parts])


def _tested(white: F2, free: int, noise: _Noise, variance: float, spread: float) -> tuple[float, float] | None:
    """Ratio of rms to expected rms, and p; None where too few degrees of freedom remain.

    The last ``free`` columns of ``white`` are the run's own unknowns. They cost only as many degrees of freedom as the values determine:
    three, not four, for a circle about its cup; hardly any for sums over whole turns. ``variance``: noise variance of a value in units of
    the noise variance of a reading. ``spread``: as in `_Noise`.
    """
    y, known = white[:, 0] / np.sqrt(variance), white[:, 1:] / np.sqrt(variance)
    inner = known.T @ known
    inner.flat[:: len(inner) + 1] += 1.0
    b, own = known.T @ y, len(inner) - free
    solution = scipy.linalg.solve(inner, np.column_stack([b, np.eye(len(inner))[:, own:]]), assume_a="pos")
    freedom = len(white) - free + float(np.trace(solution[own:, 1:]))
    if freedom < 1.0:
        return None
    ratio = float(y @ y - b @ solution[:, 0]) / (freedom * noise.variance)
    return float(np.sqrt(max(ratio, 0.0))), float(f_above(ratio, freedom / spread, noise.freedom / spread))


FOLDS = 5
"""Number of blocks of a fitted run. Each fit leaves out one block of every run, in neighbouring runs at different parts of the path."""


def left_out_gap(problem: WhitenedProblem, solved: SolvedModel, floor: Mapping[str, Floor]) -> Gap | None:
    """Return the gap of the fitted runs, each block predicted by a fit to the other blocks; None if no mean effect was found.

    Unknowns of the simulation and coefficients of the effects are fitted anew without the block. Selection and non-linear parameters
    of the effects come from all readings. So this proves less than a holdout run, and more than the residuals of the fit.
    """
    if not solved.picks:
        return None
    raw = [p.raw(problem) for p in solved.picks]
    sd = [p.prior_sd(problem, r.shape[1]) for p, r in zip(solved.picks, raw, strict=True)]
    used = problem.use > 0
    before = _left(problem, np.zeros((problem.gap.size, 0)), np.zeros(0))[used]
    after = _left(problem, np.concatenate(raw, axis=1), np.concatenate(sd))[used]
    noise = np.repeat([floor[k].sd_mm for k in problem.kinds], problem.lengths)[used]
    return Gap(*(float(np.sqrt(np.mean(v**2))) for v in (before, after, noise)))


def _left(problem: WhitenedProblem, effects: F2, sd: F1) -> F1:
    """Return the residual of every reading from fits to the other blocks, mm, shape (n,); ``effects``: columns (n, k), mm per unit."""
    block = np.concatenate([(FOLDS * np.arange(n) // n + i) % FOLDS for i, n in enumerate(problem.lengths)])
    tangent, p = problem.tangent, problem.base.size
    read = problem.gap + tangent.raw @ problem.theta
    white, noise = problem.white(np.column_stack([read, effects])), problem.sd_mm()
    root = scipy.linalg.block_diag(problem.base.root, np.diag(sd))
    normal = []
    for b in range(FOLDS):
        at = block == b
        a = np.concatenate([tangent.columns[at] / noise[at, None], white[at, 1:]], axis=1) @ root
        normal.append((a.T @ a, a.T @ white[at, 0]))
    gram, right = (np.sum(part, axis=0) for part in zip(*normal, strict=True))
    out = np.zeros(read.size)
    for b, (own, own_right) in enumerate(normal):
        x = root @ np.linalg.solve(gram - own + np.eye(len(root)), right - own_right)
        out[block == b] = (read - tangent.raw @ x[:p] - effects @ x[p:])[block == b]
    return out
