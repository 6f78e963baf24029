"""Whether runs that were never fitted agree with the simulation: their residual against noise and the prediction's own uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Agreement, Unjudged
from abbe.models.discovery.case import CaseRun
from abbe.models.discovery.noise import lone, unscaled
from abbe.models.discovery.prediction import SolvedModel, free_columns, left_over
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.probability import f_above

LAGS = 10
"""Memory that is left in whitened noise is looked for over so many readings: the memory usual for instruments (`noise.MEMORY`) has faded to
6 % by then, and more lags would add more noise to the sum than memory."""
BLOCKS, SHORTEST = 12, 8
"""A run is summed in so many blocks: enough for a wave of up to six periods along it, and eight or more are left once it has set its cup
and length. Of so many readings or more: over them the usual memory has faded to a tenth, so that sums are nearly independent."""
FREE_MM = 1.0
"""Prior of what a run may set for itself: wide."""
NO_NOISE = "the fitted runs do not tell the noise of their instrument"
TOO_FEW = "too few of their readings count"


@dataclass(frozen=True)
class _Noise:
    """What the fitted runs say of one instrument's whitened noise.

    ``variance`` of a reading over what was assumed; ``freedom`` that it is known with; ``spread``: how many times more the mean square of
    readings varies than for independent normal ones; ``long``: its long-run variance over that of a reading, 1 or more.
    """

    variance: float
    freedom: float
    spread: float
    long: float


def agreements(
    scene: WhitenedProblem, solved: SolvedModel, predicted_mm: Mapping[str, F1]
) -> tuple[tuple[Agreement, ...], tuple[Unjudged, ...]]:
    """How every run that only judges agrees with a solution without effects, the worst first.

    A run's whitened residual, reading by reading and in sums over blocks, which see what is smooth, is weighted by the inverse covariance
    of noise and prediction together; its mean square over that of the fitted runs of the same instrument follows an F distribution. Degrees
    of freedom are less where readings have memory or long tails; the smaller p counts twice.

    Parameters
    ----------
    scene : fitted runs with their noise. solved : of the scene, no effects. predicted_mm : reading of every run, shape (n,), by label.

    Returns
    -------
    tuple of Agreement
        ``p`` family-wise over the runs (Sidak).
    tuple of Unjudged
        Runs of an instrument whose noise nobody knows, for it was never fitted or its fitted runs went into the unknowns; and runs with too
        few readings that count.
    """
    noise = {kind: _noise(scene, kind) for kind in scene.colours}
    root = _root(solved.theta_covariance)
    seen = {r.path.setup for r in scene.runs}
    found, open_ = [], []
    for run in (r for r in scene.case.of("holdout") if r.deviation_mm is not None):
        label, known = run.path.label, noise.get(run.path.kind)
        if known is None:
            open_.append(Unjudged(label, NO_NOISE))
            continue
        told = _worse(*_white(scene, solved, root * np.sqrt(known.long), run, predicted_mm[label], seen), known)
        if told is None:
            open_.append(Unjudged(label, TOO_FEW))
        else:
            found.append((label, *told))
    tried = len(found)
    every = [Agreement(label, times, float(-np.expm1(tried * np.log1p(-min(p, 1.0 - 1e-12))))) for label, times, p in found]
    return tuple(sorted(every, key=lambda a: (a.p, a.run))), tuple(open_)


def _root(covariance: F2) -> F2:
    """A matrix whose product with its own transpose is a covariance; rounding may have made that a little negative somewhere."""
    values, vectors = linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _noise(scene: WhitenedProblem, kind: str) -> _Noise | None:
    """From what the fitted model leaves of the fitted runs of an instrument; None where it leaves too little to know."""
    res, leverage, use = (scene.by_run(v) for v in (scene.space.residual, scene.space.leverage, scene.use))
    mine = [k for k, name in enumerate(scene.kinds) if name == kind]
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


def _white(scene: WhitenedProblem, solved: SolvedModel, root: F2, run: CaseRun, predicted_mm: F1, seen: set[str]) -> tuple[F2, int]:
    """Whitened residual of a run's readings that count, then what may move the prediction (columns, one standard deviation each).

    Also how many of these the run sets for itself; they are the last. One standard deviation is that of the noise as it was assumed: what
    the noise is over that, `_tested` takes for all of it together.
    """
    p, data = run.path, run.data()
    gap = np.where(run.valid, data.deviation_mm - predicted_mm, 0.0)
    left = np.where(run.valid, left_over(run, predicted_mm, seen), 0.0)
    keep = run.valid * lone(left, [p.n], [p.kind])
    free = free_columns(run, seen)
    columns = np.column_stack([gap, scene.base.linear(data, solved.theta)[1] @ root, FREE_MM * free]) * keep[:, None]
    white = unscaled(columns, [p.n], [p.kind], scene.colours) / scene.colours[p.kind].sd_mm
    return np.asarray(white[keep > 0]), free.shape[1]


def _worse(white: F2, free: int, known: _Noise) -> tuple[float, float] | None:
    """Rms over what is allowed, and p, reading by reading or in sums, whichever is farther off; None where neither can be tested."""
    tests = [_tested(white, free, known, 1.0, known.spread), _tested(_sums(white), free, known, known.long, 1.0)]
    told = [t for t in tests if t is not None]
    if not told:
        return None
    times, p = min(told, key=lambda t: t[1])
    return times, min(1.0, len(told) * p)


def _sums(white: F2) -> F2:
    """Sums over blocks of one size; noise that is white keeps its variance."""
    count = min(BLOCKS, len(white) // SHORTEST)
    if count < 1:
        return np.zeros((0, white.shape[1]))
    parts = np.array_split(white, count)
    return np.array([part.sum(axis=0) / np.sqrt(len(part)) for part in parts])


def _tested(white: F2, free: int, noise: _Noise, variance: float, spread: float) -> tuple[float, float] | None:
    """Rms over what is allowed, and how often chance gives as much; None where too few values are left to tell.

    ``free`` of the columns, the last, are the run's own: they take as many degrees of freedom as the values tell of them (a circle about
    its cup three and not four, sums over whole turns hardly any). ``variance`` of the values' noise over that of a reading; ``spread`` as
    in `_Noise`.
    """
    y, known = white[:, 0] / np.sqrt(variance), white[:, 1:] / np.sqrt(variance)
    inner = known.T @ known
    inner.flat[:: len(inner) + 1] += 1.0
    b, own = known.T @ y, len(inner) - free
    solution = linalg.solve(inner, np.column_stack([b, np.eye(len(inner))[:, own:]]), assume_a="pos")
    freedom = len(white) - free + float(np.trace(solution[own:, 1:]))
    if freedom < 1.0:
        return None
    ratio = float(y @ y - b @ solution[:, 0]) / (freedom * noise.variance)
    return float(np.sqrt(max(ratio, 0.0))), float(f_above(ratio, freedom / spread, noise.freedom / spread))
