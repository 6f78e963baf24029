"""Displacement of a standing spindle or table as the lagged response to temperatures (test at standstill, ISO 230-3).

Every sensor acts twice: at once, and through a first-order lag whose time constant all sensors share, so that each may be fast, slow, or
fast and then partly reversed. Sensitivities have one normal prior about zero. The scatter has a memory (Ornstein-Uhlenbeck). For each time
constant, prior and noise are those of largest evidence; the fits of all time constants are averaged by their evidence. A lag starts in
equilibrium.

There are two models. The first takes absolute temperatures, which also show how the start differs from run to run. The second
takes the changes since the start of a run, and the reading at the start. In both, each run has an offset, which is not predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.probability import t_above

REFERENCE_C = 20.0
"""Reference temperature, ISO 1."""
BLOCK_S = 300.0
"""Readings are averaged over this time before the fit; heat deforms a machine more slowly."""
TIME_CONSTANTS_S = tuple(60.0 * m for m in (3, 5, 8, 12, 16, 20, 25, 30, 40, 60, 90, 120, 180))
MEMORIES_S = tuple(60.0 * m for m in (20, 45, 100, 250, 500))
SENSITIVITIES_MM = tuple(1e-3 * v for v in (0.5, 1, 2, 4, 8, 16, 32))
"""Standard deviations tried for the prior of a sensitivity, mm/K; 12 um/K is 1 m of steel."""
OFFSETS_MM = tuple(1e-3 * v for v in (0.1, 0.3, 1, 2, 3, 4, 6, 9, 14, 20))
SCATTERS_MM = tuple(1e-3 * v for v in (0.1, 0.2, 0.5, 1, 1.5, 2, 3, 4, 6, 9, 14))
WIDE_MM = 1.0
"""Prior standard deviation of the displacement at 20 degrees C and of a shift, so wide that both are free."""
CHANCE = 0.01
"""A shift of several runs is claimed below this p-value, which is corrected for the number of tried beginnings and ends."""
LEAST_RUNS = 5
UNLIKELY = 7.0
"""A time constant is left out if its log evidence is lower than the best by more than this: odds of one to a thousand."""
LEAST_U_MM = 1e-5
"""Least standard uncertainty of a predicted displacement; readings and temperatures do not allow less."""

Grid = tuple[float, float, float, float]
"""Prior of a sensitivity (mm/K), offset of a run (mm), scatter (mm), memory of the scatter (s)."""
GRIDS = (SENSITIVITIES_MM, OFFSETS_MM, SCATTERS_MM, MEMORIES_S)
START: Grid = (SENSITIVITIES_MM[4], OFFSETS_MM[2], SCATTERS_MM[6], MEMORIES_S[2])


@dataclass(frozen=True, eq=False)
class StandstillRun:
    """Readings of one run, n rows in order of time: ``t_s`` (n,), ``displacement_mm`` (n,) since its first reading, ``temperatures_c``
    (n, sensors)."""

    label: str
    t_s: F1
    displacement_mm: F1
    temperatures_c: F2

    @cached_property
    def _features(self) -> dict[float, F2]:
        return {}

    @cached_property
    def blocks(self) -> NDArray[np.intp]:
        """Number of the block of each reading, shape (n,)."""
        return np.unique(np.floor((self.t_s - self.t_s[0]) / BLOCK_S), return_inverse=True)[1]

    def features(self, time_constant_s: float) -> F2:
        """Temperatures minus 20 degrees C, and the same after the lag, K, shape (n, 2 sensors)."""
        if time_constant_s not in self._features:
            now = self.temperatures_c - REFERENCE_C
            lagged = now.copy()
            for i, share in enumerate(-np.expm1(-np.diff(self.t_s) / time_constant_s), start=1):
                lagged[i] = lagged[i - 1] + share * (now[i - 1] - lagged[i - 1])
            self._features[time_constant_s] = np.hstack([now, lagged])
        return self._features[time_constant_s]

    def means(self, values: F2) -> F2:
        """Means over the blocks, shape (blocks, columns)."""
        count = np.bincount(self.blocks)
        return np.column_stack([np.bincount(self.blocks, column) / count for column in values.T])


@dataclass(frozen=True)
class Shift:
    """An offset from run ``first`` to run ``last`` (indices in the order of the runs) that the temperatures do not explain.

    ``p``: probability that chance gives an equal or larger offset, over all beginnings and ends.
    """

    first: int
    last: int
    size_mm: float
    u_mm: float
    p: float

    def holds(self, run: int) -> bool:
        """Whether the offset acts in a run."""
        return self.first <= run <= self.last


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit for one time constant; ``since_start``: the fit uses changes of temperature since the start of each run.

    ``mean``, ``covariance``: values and covariance of two sensitivities for each sensor, the displacement at 20 degrees C, and a shift.
    """

    since_start: bool
    time_constant_s: float
    noise: Grid
    evidence: float
    mean: F1
    covariance: F2


@dataclass(frozen=True, eq=False)
class ThermalResponse:
    """Fitted response: an average of ``fits`` with ``weights``.

    ``shift``: offset of some runs, None if there is none; ``widening``: factor on u of predictions.
    """

    fits: tuple[Fit, ...]
    weights: F1
    shift: Shift | None = None
    widening: float = 1.0

    @property
    def most_probable(self) -> Fit:
        """The fit of the largest weight."""
        return self.fits[int(np.argmax(self.weights))]

    @property
    def time_constant_s(self) -> tuple[float, float]:
        """Time constant and its standard uncertainty, s, which includes the grid of time constants that are tried."""
        tried = np.array([f.time_constant_s for f in self.fits])
        steps = np.interp(tried, TIME_CONSTANTS_S, np.gradient(np.array(TIME_CONSTANTS_S)))
        return self._averaged(tried, steps**2 / 12.0)

    def _averaged(self, means: F1, variances: F1) -> tuple[float, float]:
        mean = float(self.weights @ means)
        return mean, float(np.sqrt(self.weights @ (variances + (means - mean) ** 2)))

    def sensitivity(self, sensor: int, *, settled: bool) -> tuple[float, float]:
        """Displacement per kelvin of one sensor alone, and its standard uncertainty, mm/K: at once, or after the lag (``settled``)."""
        take = np.zeros(self.fits[0].mean.size)
        take[sensor], take[sensor + (take.size - 2) // 2] = 1.0, float(settled)
        return self._averaged(np.array([take @ f.mean for f in self.fits]), np.array([take @ f.covariance @ take for f in self.fits]))

    def predict(self, run: StandstillRun, shifted: float = 0.0) -> tuple[F1, F1]:
        """Displacement of a run that was not fitted, and its standard uncertainty, mm, shape (n,) each; its first reading is known to be 0.

        ``shifted``: probability that the shift acts in this run.
        """
        means, variances = [], []
        for f in self.fits:
            columns = _columns(run, f.time_constant_s, since_start=f.since_start)
            columns = np.column_stack([columns, np.full(run.t_s.size, shifted)])
            _, offset, scatter, memory = f.noise
            mean, sides = columns @ f.mean, columns @ f.covariance
            variance = np.einsum("ij,ij->i", sides, columns) + offset**2 + scatter**2 + shifted * (1.0 - shifted) * f.mean[-1] ** 2
            if f.since_start:
                common = sides @ columns[0] + offset**2 + scatter**2 * np.exp((run.t_s[0] - run.t_s) / memory)
                mean, variance = mean - common / common[0] * mean[0], variance - common**2 / common[0]
            means.append(mean)
            variances.append(np.maximum(variance, 0.0))
        mean = self.weights @ np.array(means)
        return mean, self.widening * np.sqrt(self.weights @ (np.array(variances) + (np.array(means) - mean) ** 2) + LEAST_U_MM**2)


class Series:
    """Runs in their order, prepared for fits of any subset: normal equations of each run by time constant and memory."""

    def __init__(self, runs: Sequence[StandstillRun], *, since_start: bool) -> None:
        self.runs = tuple(runs)
        self.since_start = since_start
        self._grams: dict[tuple[float, float], tuple[F3, F1]] = {}
        self._blocks = np.array([r.blocks.max() + 1 for r in runs])

    def _normal(self, time_constant_s: float, memory_s: float) -> tuple[F3, F1]:
        """Normal equations of every run's columns (sensitivities, one, displacement) and its log determinant, for a scatter of 1 mm."""
        key = (time_constant_s, memory_s)
        if key not in self._grams:
            made = [_gram(run, *key, since_start=self.since_start) for run in self.runs]
            self._grams[key] = np.array([g for g, _ in made]), np.array([d for _, d in made])
        return self._grams[key]

    def fit(self, kept: Sequence[int], shift: Shift | None, tau_s: float, noise: Grid) -> Fit:
        """Fit the runs ``kept`` with given time constant, noise, and place of the shift."""
        sensitivity, offset, scatter, memory = noise
        normal, determinants = self._normal(tau_s, memory)
        rows = np.asarray(kept)
        g = normal[rows] / scatter**2
        one = g.shape[1] - 2
        ones = g[:, one, one]
        gain = offset**2 / (1.0 + offset**2 * ones)
        g = g - gain[:, None, None] * g[:, :, one, None] * g[:, None, one, :]
        whole = g.sum(axis=0)
        off = np.zeros_like(whole) if shift is None else g[[shift.holds(k) for k in kept]].sum(axis=0)
        prior = np.append(np.full(one, sensitivity**-2), [WIDE_MM**-2] * 2)
        h = np.diag(prior)
        h[:-1, :-1] += whole[:-1, :-1]
        h[-1, :-1] = h[:-1, -1] = off[one, :-1]
        h[-1, -1] += off[one, one]
        right = np.append(whole[:-1, -1], off[one, -1])
        covariance = np.linalg.inv(h)
        mean = covariance @ right
        evidence = -0.5 * float(whole[-1, -1] - right @ mean - np.log(prior).sum()) - float(np.log(np.diag(np.linalg.cholesky(h))).sum())
        evidence += 0.5 * float(np.log1p(-gain * ones).sum() - determinants[rows].sum())
        return Fit(self.since_start, tau_s, noise, evidence - float(self._blocks[rows].sum() * np.log(scatter)), mean, covariance)

    def best(self, kept: Sequence[int], shift: Shift | None, tau_s: float, start: Grid) -> Fit:
        """Return the fit whose noise has the largest evidence; the search climbs from ``start`` step by step."""
        found, better = self.fit(kept, shift, tau_s, start), True
        while better:
            better = False
            for k, values in enumerate(GRIDS):
                at = values.index(found.noise[k])
                near = [
                    self.fit(kept, shift, tau_s, _with(found.noise, k, v)) for v in (*values[max(at - 1, 0) : at], *values[at + 1 : at + 2])
                ]
                best = max(near, key=lambda f: f.evidence)
                if best.evidence > found.evidence + 1e-6:
                    found, better = best, True
        return found

    def response(self, kept: Sequence[int] | None = None) -> ThermalResponse:
        """Fit the runs ``kept`` (all by default), with a shift if there is one."""
        kept = range(len(self.runs)) if kept is None else kept
        plain = self._averaged(kept, None, START)
        shift = shift_of(self, kept, plain.most_probable)
        return plain if shift is None else self._averaged(kept, shift, plain.most_probable.noise)

    def _averaged(self, kept: Sequence[int], shift: Shift | None, start: Grid) -> ThermalResponse:
        """Fit with each time constant, and weigh the fits by their evidence."""
        fits = list[Fit]()
        for tau in TIME_CONSTANTS_S:
            fits.append(self.best(kept, shift, tau, fits[-1].noise if fits else start))
        least = max(f.evidence for f in fits) - UNLIKELY
        fits = [f for f in fits if f.evidence > least]
        weights = np.exp(np.array([f.evidence - least for f in fits]))
        return ThermalResponse(tuple(fits), weights / weights.sum(), shift)


def shift_of(series: Series, kept: Sequence[int], fit: Fit) -> Shift | None:
    """Return the most significant offset of two or more neighbouring runs from the third run on; None if chance explains the offset.

    Each place is tried with several scatters from run to run. At the best place all noise is fitted again, because a fit without a shift
    counts the shift as noise. The p-value is multiplied by the number of places.
    """
    places = [Shift(first, last, 0.0, 0.0, 1.0) for first, last in combinations(list(kept)[2:], 2)]
    tried = []
    for place in places:
        fits = [series.fit(kept, place, fit.time_constant_s, _with(fit.noise, 1, v)) for v in OFFSETS_MM[2::2]]
        tried.append((_sigmas(max(fits, key=lambda f: f.evidence)), place))
    place = max(tried, key=lambda one: one[0])[1]
    best = max((series.best(kept, place, fit.time_constant_s, noise) for noise in (fit.noise, START)), key=lambda f: f.evidence)
    p = 2.0 * float(t_above(_sigmas(best), len(kept) - 2)) * len(places)
    return Shift(place.first, place.last, float(best.mean[-1]), float(np.sqrt(best.covariance[-1, -1])), p) if p < CHANCE else None


def _sigmas(fit: Fit) -> float:
    """Size of the shift over its standard uncertainty."""
    return float(abs(fit.mean[-1]) / np.sqrt(fit.covariance[-1, -1]))


def probability_shifted(shift: Shift | None, kept: Sequence[int], run: float) -> float:
    """Probability that the shift acts in a run that was not fitted: 0 or 1, or 0.5 if it acts in only one of the two neighbouring runs.

    ``run``: position of this run among the runs ``kept``, possibly between two of them.
    """
    if shift is None:
        return 0.0
    before = [shift.holds(k) for k in kept if k < run][-1:]
    after = [shift.holds(k) for k in kept if k > run][:1]
    return float(np.mean([*before, *after]))


def _with(noise: Grid, k: int, value: float) -> Grid:
    a, b, c, d = [value if i == k else v for i, v in enumerate(noise)]
    return a, b, c, d


def _columns(run: StandstillRun, time_constant_s: float, *, since_start: bool) -> F2:
    features = run.features(time_constant_s)
    return np.column_stack([features - features[0] if since_start else features, np.ones(run.t_s.size)])


def _gram(run: StandstillRun, time_constant_s: float, memory_s: float, *, since_start: bool) -> tuple[F2, float]:
    columns = np.column_stack([_columns(run, time_constant_s, since_start=since_start), run.displacement_mm])
    t, values = run.means(run.t_s[:, None])[:, 0], run.means(columns)
    kept = np.exp(-np.diff(t) / memory_s)
    free = np.sqrt(1.0 - kept**2)
    white = np.vstack([values[:1], (values[1:] - kept[:, None] * values[:-1]) / free[:, None]])
    return white.T @ white, 2.0 * float(np.log(free).sum())
