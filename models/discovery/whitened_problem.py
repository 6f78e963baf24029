"""Readings of a campaign, prepared for the search: simulation fitted, noise estimated, the simulation's unknowns projected out.

Readings and candidates are projected onto the orthogonal complement of the simulation's columns (Frisch-Waugh-Lovell).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakSet

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.discovery.baseline import Baseline
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.instrument_noise import Colour, beside_turns, comes_back, level, lone, remembered, unscaled
from abbe.models.effects.effect import Signal, Values
from abbe.models.effects.path import Path, Together

ROWS = 2048
"""Readings per block of a product, to save memory."""
FIRST_NOISE = {"bar": Colour(4e-4), "laser": Colour(2.5e-4)}
STEPS = 2
WIDE = 10.0
"""Factor on the priors of the simulation's unknowns when they are projected out for testing, so that no finding rests on a prior."""
ROUNDS = 2
LOUDEST_MM = 0.1
"""Prior standard deviation of the coefficients of the columns in `WhitenedProblem.also`, mm."""
STEADY = 0.02
"""The noise has converged when its relative change is smaller than this."""
FITTED = 3.0
"""Factor on the priors where the simulation is fitted for linearisation."""


@dataclass(frozen=True)
class SignalProjection:
    """Whitened readings and the operator that projects the unknowns out of them.

    With T = [root @ columns^T @ diag(weight); more], shape (p + k, n), the operator is M = 1 - T^T T; with flat priors M is a projection.
    T is as large as the columns, so only its factors are stored.

    Attributes
    ----------
    y : array, shape (n,)
        Whitened gap between readings and the present simulation.
    columns : array, shape (n, p); weight : array, shape (n,)
        Whitened columns of the unknowns are ``columns`` times ``weight``, reading by reading.
    root : array, shape (p, p), lower triangle.
    more : array, shape (k, n): rows of T for further columns that are projected out, such as those of effects.
    y_coordinates : array, shape (p + k,) = T @ y.
    """

    y: F1
    columns: F2
    weight: F1
    root: F2
    more: F2
    y_coordinates: F1

    @classmethod
    def nothing(cls, n: int) -> SignalProjection:
        """Return the projection that changes nothing, for n readings that are all zero."""
        return cls(np.zeros(n), np.zeros((n, 0)), np.ones(n), np.zeros((0, 0)), np.zeros((0, n)), np.zeros(0))

    @classmethod
    def of(cls, y: F1, columns: F2, gram: F2, prior_sd: F1, weight: F1 | None = None) -> SignalProjection:
        """Project out ``columns`` (n, p) times ``weight``, with Gram matrix ``gram``; the unknowns have independent priors."""
        scaled = gram * prior_sd[:, None] * prior_sd
        scaled.flat[:: len(gram) + 1] += 1.0
        root = scipy.linalg.solve_triangular(np.linalg.cholesky(scaled), np.diag(prior_sd), lower=True)
        projection = cls(y, columns, np.ones(y.size) if weight is None else weight, root, np.zeros((0, y.size)), np.zeros(0))
        return replace(projection, y_coordinates=projection.coordinates(y[:, None])[:, 0])

    def coordinates(self, columns: F2) -> F2:
        """Apply T of the class to columns (n, q): return T @ columns, shape (p + k, q).

        Only the readings from the first to the last that a column changes are multiplied: a step or a burst changes few.
        """
        changed = np.flatnonzero(np.any(columns, axis=1))
        at = slice(int(changed[0]), int(changed[-1]) + 1) if changed.size else slice(0, 0)
        part = columns[at]
        return np.concatenate([self.root @ ((part * self.weight[at, None]).T @ self.columns[at]).T, self.more[:, at] @ part])

    def spread(self, amounts: F2) -> F2:
        """Apply the transpose of T to amounts (p + k, q): return T^T @ amounts, shape (n, q)."""
        p = len(self.root)
        return np.asarray((self.columns @ (self.root.T @ amounts[:p])) * self.weight[:, None] + self.more.T @ amounts[p:])

    def left(self, columns: F2) -> F2:
        """Project the unknowns out of columns (n, q): return M @ columns, shape (n, q)."""
        return columns - self.spread(self.coordinates(columns))

    @cached_property
    def residual(self) -> F1:
        """Whitened residual: the readings with the unknowns projected out, M @ y, shape (n,)."""
        return np.asarray(self.y - self.spread(self.y_coordinates[:, None])[:, 0])

    @cached_property
    def leverage(self) -> F1:
        """Share of every reading's noise variance that the fit absorbs, 0 to 1, shape (n,)."""
        out: F1 = np.einsum("kn,kn->n", self.more, self.more)
        for start in range(0, self.y.size, ROWS):
            at = slice(start, start + ROWS)
            part = self.root @ (self.columns[at] * self.weight[at, None]).T
            out[at] += np.einsum("pn,pn->n", part, part)
        return out

    @property
    def chi2(self) -> float:
        """Sum of squares that the fit leaves, with the penalty of the priors: y^T M y."""
        return float(self.y @ self.y - self.y_coordinates @ self.y_coordinates)

    def rows(self, columns: F2, prior_sd: F1) -> F2:
        """Return the rows, shape (k, n), to add to T so that it projects out more columns (n, k) with independent priors."""
        return rows_of(self.left(columns), columns, prior_sd)

    def without(self, columns: F2, prior_sd: F1) -> SignalProjection:
        """Return the projection that removes ``columns`` (n, k) in addition; the new unknowns have independent priors."""
        rows = self.rows(columns, prior_sd)
        return replace(self, more=np.concatenate([self.more, rows]), y_coordinates=np.concatenate([self.y_coordinates, rows @ self.y]))


def rows_of(left: F2, columns: F2, prior_sd: F1) -> F2:
    """Do the same as `SignalProjection.rows` if the projection of ``columns`` is known already (``left``)."""
    gram = columns.T @ left + np.diag(prior_sd**-2.0)
    return np.asarray(scipy.linalg.solve_triangular(scipy.linalg.cholesky(0.5 * (gram + gram.T), lower=True), left.T, lower=True))


@dataclass(frozen=True)
class WhitenedProblem:
    """Identify runs stacked in time order, whitened, with the fitted simulation.

    Attributes
    ----------
    paths : paths of the runs, with the bar directions of the fitted machine (`Baseline.along`).
    gap : array, shape (n,): reading minus the fitted simulation, mm.
    use : array, shape (n,): weight, 0 to 1: 0 for flagged readings and single laser outliers, less than 1 where scatter is in excess.
    theta : array, shape (p,): unknowns of the fitted simulation.
    tangent : columns of the simulation's unknowns, whitened for noise of 1 mm.
    projection : whitened gap, and the operator that projects the simulation's unknowns out of it.
    also : array, shape (n, k): further columns, projected out together with the simulation's (waves of a vibration), mm per mm.
    column_cache : whitened columns of picks and their projection. gains : gain of a pick beside others. banks : banks of candidates of
        this problem that are still in memory. widths : number of columns of an effect along one run, by label. All four are caches.
    """

    case: Case
    base: Baseline
    runs: tuple[CaseRun, ...]
    paths: tuple[Path, ...]
    gap: F1
    use: F1
    theta: F1
    colours: Mapping[str, Colour]
    tangent: Tangent
    projection: SignalProjection
    also: F2
    column_cache: dict[str, tuple[F2, F2]] = field(default_factory=dict)
    gains: dict[tuple[str, tuple[str, ...]], float] = field(default_factory=dict)
    banks: WeakSet[object] = field(default_factory=WeakSet)
    widths: dict[str, int] = field(default_factory=dict)

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """Readings per run."""
        return tuple(p.n for p in self.paths)

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Instrument of every run."""
        return tuple(p.kind for p in self.paths)

    def white(self, columns: F2) -> F2:
        """Whiten columns (n, k), mm, to unit noise; readings that are left out become zero."""
        return self.white_all(columns * self.use[:, None])

    def white_all(self, columns: F2) -> F2:
        """Whiten columns (n, k), mm, to unit noise without the weights ``use``: readings left out of the fit keep their values."""
        out = unscaled(columns, self.lengths, self.kinds, self.colours)
        out /= self.sd_mm()[:, None]
        return out

    def raw(self, signal: Signal, key: str, values: Values) -> F2:
        """Columns of an effect over all runs, mm, shape (n, k)."""
        return np.concatenate(signal(self.paths, key, values))

    def sd_mm(self) -> F1:
        """Standard deviation of every reading's noise, mm, shape (n,)."""
        return np.repeat([self.colours[k].sd_mm for k in self.kinds], self.lengths)

    def lone(self, residual: F1) -> F1:
        """Weights, shape (n,): 0 for single readings far from their neighbours (`abbe.models.discovery.instrument_noise.lone`), else 1."""
        return lone(residual, self.lengths, self.kinds, beside_turns(self.paths), self.case.resolution_mm)

    def by_run(self, values: F1) -> list[F1]:
        """Split stacked values (n,) into one array per run."""
        return np.split(values, np.cumsum(self.lengths)[:-1])


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the readings, shape (n, p), in single precision: linearisation about the perfect machine has errors of 1e-4 anyway."""

    short: NDArray[np.float32]

    @classmethod
    def of(cls, runs: Sequence[CaseRun], base: Baseline) -> Slopes:
        """Compute the derivatives of the readings of ``runs`` with respect to the simulation's unknowns at the perfect machine."""
        out = np.empty((sum(r.path.n for r in runs), base.size), dtype=np.float32)
        start = 0
        for run in runs:
            out[start : start + run.path.n] = base.linear(run.data(), np.zeros(base.size))[1]
            start += run.path.n
        return cls(out)

    def __matmul__(self, theta: F1) -> F1:
        """Return the change of every reading, mm, shape (n,), for values ``theta`` of the unknowns."""
        parts = [self.short[i : i + ROWS].astype(np.float64) @ theta for i in range(0, len(self.short), ROWS)]
        return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True)
class Tangent:
    """Derivatives of all readings with respect to the simulation's unknowns at the perfect machine.

    Errors of micrometres turn bar and beam by 1e-4 at most, so the derivatives are taken as constant; only the reading is exact.
    ``raw``: not whitened, (n, p). ``columns``: whitened for noise of 1 mm, (n, p). ``gram``: their Gram matrix (p, p), per instrument.
    """

    raw: Slopes
    columns: F2
    gram: Mapping[str, F2]

    @classmethod
    def of(cls, raw: Slopes, use: F1, lengths: Sequence[int], kinds: Sequence[str], colours: Mapping[str, Colour]) -> Tangent:
        """Whiten ``raw`` and build the Gram matrices run by run, to hold no more than one large matrix besides ``raw``."""
        n, p = raw.short.shape
        columns = np.empty((n, p), order="F")
        gram = {kind: np.zeros((p, p)) for kind in dict.fromkeys(kinds)}
        start = 0
        for length, kind in zip(lengths, kinds, strict=True):
            at = slice(start, start + length)
            part = unscaled(np.asfortranarray(raw.short[at] * use[at, None]), (length,), (kind,), colours)
            columns[at] = part
            gram[kind] += part.T @ part
            start += length
        return cls(raw, columns, gram)

    def blend(self, colours: Mapping[str, Colour]) -> F2:
        """Return the Gram matrix (p, p) of the columns, each reading divided by its instrument's noise."""
        return np.asarray(sum(g / colours[kind].sd_mm ** 2 for kind, g in self.gram.items()))


def ordered(runs: Sequence[CaseRun]) -> tuple[CaseRun, ...]:
    """Sort runs by the time of their first reading, so that results do not depend on the caller's order."""
    return tuple(sorted(runs, key=lambda r: (float(r.path.at.t_s[0]), r.path.label)))


def whiten(case: Case, base: Baseline) -> WhitenedProblem:
    """Build the problem of a case: fit the present simulation to the identify runs, estimate noise and project the unknowns out."""
    runs = ordered(case.of("identify"))
    use = np.concatenate([r.valid.astype(float) for r in runs])
    paths, n = Together(r.path for r in runs), use.size
    tangent = Tangent.of(Slopes.of(runs, base), use, [p.n for p in paths], [p.kind for p in paths], FIRST_NOISE)
    problem = WhitenedProblem(
        case, base, runs, paths, np.zeros(n), use, np.zeros(base.size), FIRST_NOISE, tangent, SignalProjection.nothing(n), np.zeros((n, 0))
    )
    problem = replace(problem, gap=np.concatenate([r.data().deviation_mm for r in runs]))
    for _ in range(STEPS):
        problem = linearised(problem, np.zeros((n, 0)), np.zeros(0))
    return with_estimated_noise(problem, ())


def linearised(problem: WhitenedProblem, extra: F2, extra_sd: F1) -> WhitenedProblem:
    """Make a Gauss-Newton step of the simulation, fitted together with columns (n, k) of effects; these effects stay in the gap."""
    base, tangent = problem.base, problem.tangent
    data = [r.data() for r in problem.runs]
    sd_mm = problem.sd_mm()[:, None]
    white = problem.white(np.column_stack([problem.gap + tangent.raw @ problem.theta, extra]))
    y, more = white[:, 0], white[:, 1:]
    cross = (white / sd_mm).T @ tangent.columns
    gram = np.block([[tangent.blend(problem.colours), cross[1:].T], [cross[1:], more.T @ more]])
    sd = np.concatenate([base.prior_sd * FITTED, extra_sd])
    gram = gram * sd[:, None] * sd
    gram.flat[:: len(gram) + 1] += 1.0
    solution = sd * np.linalg.solve(gram, sd * np.concatenate([cross[0], more.T @ y]))
    theta = solution[: base.size]
    value = np.concatenate([base.read(d, theta) for d in data])
    paths = Together(base.along(r.path, d, theta) for r, d in zip(problem.runs, data, strict=True))
    gap = np.concatenate([d.deviation_mm for d in data]) - value
    problem.column_cache.clear()  # the old problem's cache would take as much memory again
    return replace(problem, theta=theta, gap=gap, paths=paths, column_cache={}, gains={}, banks=WeakSet())


def with_projection(problem: WhitenedProblem) -> WhitenedProblem:
    """Recompute the projection of a problem from gap, columns and noise."""
    y = problem.white(problem.gap[:, None])[:, 0]
    tangent = problem.tangent
    problem.column_cache.clear()
    projection = SignalProjection.of(
        y, tangent.columns, tangent.blend(problem.colours), problem.base.prior_sd * WIDE, 1.0 / problem.sd_mm()
    )
    if problem.also.shape[1]:
        projection = projection.without(problem.white(problem.also), np.full(problem.also.shape[1], LOUDEST_MM))
    return replace(problem, projection=projection, column_cache={}, gains={}, banks=WeakSet())


def with_estimated_noise(problem: WhitenedProblem, found: Sequence[tuple[F2, F1]], *, memory: bool = False) -> WhitenedProblem:
    """Estimate the noise of a problem again, with the effects ``found`` (raw columns, prior sd) fitted, and exclude single outliers.

    ``memory``: also estimate the autocorrelation of the noise (`remembered`); only after a search, or effects would be taken as noise.
    """
    for k in range(ROUNDS):
        problem = with_projection(problem)
        projection = problem.projection
        for raw, sd in found:
            projection = projection.without(problem.white(raw), sd)
        left = projection.residual * problem.sd_mm()
        lengths, kinds = problem.lengths, problem.kinds
        use = problem.use * problem.lone(left)
        colours = level(left, lengths, kinds, use, projection.leverage, problem.case.resolution_mm, problem.colours)
        if memory and k == 0:
            wander = remembered(left, lengths, kinds, colours)
            parts = problem.by_run(left)
            colours = {kind: c if comes_back(problem.paths, parts, kind) else wander[kind] for kind, c in colours.items()}
        other = any(colours[kind].gain != problem.colours[kind].gain for kind in colours)
        if other or (use != problem.use).any():
            problem = replace(problem, use=use, tangent=Tangent.of(problem.tangent.raw, use, lengths, kinds, colours))
        small = not other and all(abs(colours[k].sd_mm / problem.colours[k].sd_mm - 1.0) < STEADY for k in colours)
        problem = replace(problem, colours=colours)
        if small:
            break
    return with_projection(problem)
