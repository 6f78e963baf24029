"""Core of the joint solution: one campaign as scaled arrays, and its iteration to the exact model.

If neither a smooth nor a rough basis follows a motion, every place of a step test gets an unknown for its details (`with_details`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, SMOOTH_ORDER, Term, motion_names
from abbe.models.machine import AXES, Machine
from abbe.models.solvers.components import (
    I1,
    KINDS,
    ROUGH_CAUTION,
    ComponentPosterior,
    Components,
    Grams,
    InformationSums,
    PlannedReadings,
    blend,
    cautious,
    estimate,
    fit_shapes,
    grams,
    posterior,
    sums,
    total,
)
from abbe.models.solvers.observations import RunData, nominal_reading
from abbe.models.solvers.observe import SetupUnknowns, predict, run_design, setup_unknowns
from abbe.models.solvers.order_choice import folds
from abbe.models.solvers.priors import Priors, SizeModel, size_model
from abbe.models.solvers.residuals import inflation, leverage, outlier_threshold, outlier_weights, robust_scale

DEFAULT_SIGMA_MM = {"bar": 4e-4, "laser": 3e-4, "artefact": 5e-4}
"""Standard uncertainty of one reading where nothing was repeated: makers' figures for good instruments."""
RESOLUTION_MM = 5e-5
"""Smallest standard uncertainty of an averaged value: the resolution of displays and encoders."""
FEWEST_REPEATS = 8
FOURTH: F1 = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def repeat_noise_mm(runs: tuple[RunData, ...], kind: str) -> float | None:
    """Standard deviation of one raw reading of an instrument from repeats, mm; None without repeats.

    Ball-bar: fourth differences of neighbours on a dense path, to which smooth motions do not contribute. Laser: differences of readings at
    equal positions of one run, lost motion and drift removed; fourth differences if every position was visited once. The median makes
    outliers harmless.
    """
    found = [v for run in runs if run.kind == kind != "artefact" for v in (_of_run(run),) if v.size]
    values = np.concatenate(found) if found else np.zeros(0)
    if values.size < FEWEST_REPEATS:
        return None
    return max(float(np.median(np.abs(values)) / 0.6744897501960817), 0.1 * RESOLUTION_MM)


def _of_run(run: RunData) -> F1:
    """Differences of repeats, scaled so that their standard deviation is that of one raw reading."""
    y = run.deviation_mm - nominal_reading(run)
    if run.kind == "laser":
        pairs = same_place(run.axes_mm)
        if len(pairs) >= FEWEST_REPEATS:
            return _pairs(run, y, pairs)
    return _fourth(run, y)


def same_place(axes_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Index pairs of successive readings at the same commanded position, shape (m, 2)."""
    _, place = np.unique(np.round(axes_mm, 4), axis=0, return_inverse=True)
    order = np.argsort(place, kind="stable")
    equal = np.flatnonzero(np.diff(place[order]) == 0)
    return np.stack([order[equal], order[equal + 1]], axis=1)


def _pairs(run: RunData, y: F1, pairs: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F1:
    i, j = pairs.T
    difference = y[j] - y[i]
    known = np.column_stack([run.sign[j] - run.sign[i], run.t_s[j] - run.t_s[i], np.ones(len(pairs))])
    scale = np.linalg.norm(known, axis=0)
    known = known[:, scale > 0] / scale[scale > 0]
    fit, _, rank, _ = np.linalg.lstsq(known, difference, rcond=None)
    left = (difference - known @ fit) * np.sqrt(len(pairs) / max(len(pairs) - int(rank), 1))
    return np.asarray(left / np.sqrt(1.0 / run.weight_n[i] + 1.0 / run.weight_n[j]))


def _fourth(run: RunData, y: F1) -> F1:
    if y.size < FEWEST_REPEATS:
        return np.zeros(0)
    windows = np.lib.stride_tricks.sliding_window_view
    same = (np.ptp(windows(run.sign, 5, axis=0), axis=-1) == 0).all(axis=-1)
    spread = np.sqrt(windows(1.0 / run.weight_n, 5) @ FOURTH**2)
    return np.asarray((windows(y, 5) @ FOURTH)[same] / spread[same])


ROUNDS = 8
SETTLED = 0.02
"""The iteration ends when no predicted reading moves, and no weight changes, by more than this (readings in units of their noise)."""
HUBER = 1.5
GENTLE = 3
StageSink = Callable[[str], None]


@dataclass(frozen=True)
class InstrumentNoise:
    """Noise per instrument, mm: expected for one raw reading; least for an averaged value; from repeats alone (None without them)."""

    sigma_mm: dict[str, float]
    floor_mm: dict[str, float]
    repeats_mm: dict[str, float | None]


@dataclass(frozen=True)
class CampaignProblem:
    """A campaign: unknowns with their reference sizes, and the linearised readings in units of noise and size."""

    machine: Machine
    runs: tuple[RunData, ...]
    terms: tuple[Term, ...]
    setup: SetupUnknowns
    names: tuple[str, ...]
    sizes: SizeModel
    noise: InstrumentNoise
    sigma: F1
    readings: PlannedReadings

    def predicted(self, theta: F1) -> F1:
        """Exact readings of all runs, mm."""
        return np.concatenate([predict(self.machine, self.terms, r, self.setup, theta) for r in self.runs])

    @property
    def measured(self) -> F1:
        """Readings of all runs, mm."""
        return np.concatenate([r.deviation_mm for r in self.runs])

    def split(self, values: F1) -> tuple[F1, ...]:
        """Split values of all readings into one array per run."""
        return tuple(np.split(values, np.cumsum([r.deviation_mm.size for r in self.runs])[:-1]))


@dataclass(frozen=True)
class CampaignFit:
    """The converged solution: unknowns, components, weights, residuals (``size``: whitened), normal equations per fold."""

    theta: F1
    covariance: F2
    prior_sd: F1
    sizes: SizeModel
    components: Components
    posterior: ComponentPosterior
    weight: F1
    size: F1
    residual_mm: F1
    decimation: F1
    parts: tuple[InformationSums, ...]


@dataclass(frozen=True)
class Score:
    """Part of the residuals that further unknowns would explain (Rao's score)."""

    weight: F1
    left: F1
    scaled: F2
    covariance: F2
    sigma: F1

    @classmethod
    def of(cls, problem: CampaignProblem, fit: CampaignFit) -> Score:
        """Prepare the score of a fit."""
        kind = problem.readings.kind
        weight = fit.weight * np.exp(-fit.components.eta)[kind] / fit.decimation[kind]
        root = fit.sizes.root * fit.components.half(fit.sizes)
        return cls(weight, fit.residual_mm / problem.sigma, problem.readings.a @ root, fit.posterior.cov, problem.sigma)

    def asked(self, columns: F2) -> tuple[F1, F2]:
        """Derivative of the log evidence by the unknowns of these columns, (k,), and its information, (k, k)."""
        b = columns / self.sigma[:, None]
        weighted = b * self.weight[:, None]
        across = weighted.T @ self.scaled
        return weighted.T @ self.left, b.T @ weighted - across @ self.covariance @ across.T

    def excess(self, columns: F2) -> float:
        """Score for a common variance of the unknowns, in standard deviations."""
        asked, information = self.asked(columns)
        return float((asked @ asked - np.trace(information)) / np.sqrt(2.0 * np.sum(information * information)))

    def gain_rescaled(self, columns: F2) -> float:
        """Gain of log evidence by unknowns of size 1 in these columns if the noise is estimated anew."""
        asked, information = self.asked(columns)
        whole = np.eye(len(asked)) + information
        explained = float(asked @ np.linalg.solve(whole, asked)) / max(float(self.weight @ self.left**2), 1e-12)
        return -0.5 * self.left.size * float(np.log(max(1.0 - explained, 0.02))) - 0.5 * float(np.linalg.slogdet(whole)[1])


def expected_noise(runs: tuple[RunData, ...], sigma_mm: dict[str, float] | None, floor_mm: dict[str, float] | None) -> InstrumentNoise:
    """Noise stated by the caller, else from repeats, else `DEFAULT_SIGMA_MM`."""
    repeats = {kind: repeat_noise_mm(runs, kind) for kind in KINDS}
    sigma = {k: (sigma_mm or {}).get(k) or repeats[k] or DEFAULT_SIGMA_MM[k] for k in KINDS}
    return InstrumentNoise(sigma, {k: max((floor_mm or {}).get(k, 0.0), RESOLUTION_MM) for k in KINDS}, repeats)


PLACE_MM = 0.01
"""Positions of an axis within this distance are one place."""
MOST_PLACES = 80
"""An axis with more places in a run is read so densely that a basis can follow it."""
FEWEST_PLACES = 3
LEAST_SHARE = 1e-3
"""A motion of which the beam sees a smaller share is left out."""


def with_details(setup: SetupUnknowns, runs: tuple[RunData, ...], priors: Priors) -> SetupUnknowns:
    """Return the set-up unknowns with a detail ``detail_<motion>_<mm>`` of every translational motion at every place of the laser runs.

    A screw with a lead of 10 mm, read every 40 mm, looks like a slow wave. Four step diagonals stop at the same places of each axis, so the
    deviation of a motion at such a place is common to all four, and a separate unknown keeps it out of the smooth motions.
    """
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


def build(machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...], priors: Priors, noise: InstrumentNoise) -> CampaignProblem:
    """Linearise all runs about the perfect machine; with rough terms, details of the machine are unknowns, too."""
    setup = setup_unknowns(runs, priors, machine)
    if any(t.order > SMOOTH_ORDER for t in terms):
        setup = with_details(setup, runs, priors)
    rest = tuple(f"backlash_{a}" for a in DIRECTIONS) + setup.names
    rest_sd = np.concatenate([np.full(len(DIRECTIONS), priors.backlash_mm), setup.prior_sd])
    sizes = size_model(machine, terms, rest, rest_sd, priors)
    sigma = np.concatenate([np.hypot(noise.sigma_mm[r.kind] / np.sqrt(r.weight_n), noise.floor_mm[r.kind]) for r in runs])
    a = np.concatenate([run_design(machine, terms, r, setup) for r in runs])
    a *= sizes.typical
    a /= sigma[:, None]
    n = [r.deviation_mm.size for r in runs]
    rows = [np.repeat(v, n).astype(np.int64) for v in (np.arange(len(runs)), folds(runs), [KINDS.index(r.kind) for r in runs])]
    names = tuple(t.name for t in terms) + rest
    readings = PlannedReadings(a, np.zeros(len(sigma)), rows[0], rows[1], rows[2])
    return CampaignProblem(machine, runs, terms, setup, names, sizes, noise, sigma, readings)


def settle(problem: CampaignProblem, report: StageSink) -> CampaignFit:
    """Iterate weights, components and the exact model to convergence."""
    r = problem.readings
    gram, measured, sizes = grams(r), problem.measured, problem.sizes
    x, weight = np.zeros(len(problem.names)), np.ones(len(measured))
    c = Components(np.zeros(len(sizes.names)), np.zeros(len(KINDS)))
    limit = outlier_threshold(len(measured))
    dirty = False
    for step in range(ROUNDS):
        z = (measured - problem.predicted(sizes.typical * x)) / problem.sigma + r.a @ x
        whole = total(sums(PlannedReadings(r.a, z, r.run, r.fold, r.kind), gram, weight))
        if step == 1 or (dirty and step == GENTLE):
            sizes, found = fit_shapes(whole, sizes, c)
            c = found.components
        elif step:
            c = estimate(whole.turned(sizes.root, sizes.turned), sizes, c).components
        root = sizes.root * c.half(sizes)
        before, x = x, root @ posterior(whole.turned(sizes.root, sizes.turned), c, sizes).x
        size = (z - r.a @ x) / np.exp(0.5 * c.eta)[r.kind]
        if not step:
            size = size / _robust_scale(size, r.kind)[r.kind]
        dirty = dirty or bool(np.abs(size).max() > limit)
        new = _weights(size / _spread(problem, whole, c, sizes) if dirty and step >= GENTLE else size, limit, gentle=step < GENTLE)
        moved, changed = float(np.abs(r.a @ (x - before)).max()), float(np.abs(new - weight).max())
        weight = new
        report(f"round {step + 1}: predictions moved by up to {moved:.2g} sigma, {int((weight < 1).sum())} readings down-weighted")
        if step >= (GENTLE if dirty else 2) and moved < SETTLED and changed < SETTLED:
            break
    return _finish(replace(problem, sizes=sizes), x, weight, c, gram)


def _robust_scale(size: F1, kind: I1) -> F1:
    return np.array([robust_scale(size[kind == k]) if (kind == k).any() else 1.0 for k in range(len(KINDS))])


def _weights(size: F1, limit: float, *, gentle: bool) -> F1:
    """Weights of the readings: redescending; Huber's if ``gentle`` and with gross outliers, so that a bad start rejects no good reading."""
    hard = outlier_weights(size, limit)
    if gentle and (hard == 0.0).any():
        return np.asarray(np.minimum(1.0, HUBER / np.maximum(np.abs(size), HUBER)))
    return hard


def _spread(problem: CampaignProblem, whole: InformationSums, c: Components, sizes: SizeModel) -> F1:
    """Standard deviation of each residual in units of its noise; the leverage makes it smaller than 1."""
    information, _, _ = blend(whole.turned(sizes.root, sizes.turned), c, c.half(sizes))
    np.fill_diagonal(information, information.diagonal() + 1.0)
    low = scipy.linalg.cholesky(information, lower=True)
    h = leverage(problem.readings.a, scipy.linalg.solve_triangular(low, (sizes.root * c.half(sizes)).T, lower=True))
    return np.asarray(np.sqrt(np.maximum(1.0 - h / np.exp(c.eta)[problem.readings.kind], 0.05)))


def _finish(problem: CampaignProblem, x: F1, weight: F1, c: Components, gram: Grams) -> CampaignFit:
    """Solve a last time with the exact residuals; correlated neighbours count as fewer readings.

    The estimate uses the cautious prior. The covariance of a rough machine uses a narrower prior (`ROUGH_CAUTION`).
    """
    r, typical = problem.readings, problem.sizes.typical
    residual = problem.measured - problem.predicted(typical * x)
    z = residual / problem.sigma + r.a @ x
    parts = sums(PlannedReadings(r.a, z, r.run, r.fold, r.kind), gram, weight)
    size = residual / problem.sigma / np.exp(0.5 * c.eta)[r.kind] / _spread(problem, total(parts), c, problem.sizes)
    decimation = _thinning(problem, size, weight)
    parts = tuple(s.decimated(decimation) for s in parts)
    whole = total(parts)
    sizes = problem.sizes
    found = estimate(whole.turned(sizes.root, sizes.turned), sizes, c)
    p, root, sizes, c = _solved(whole, *cautious(sizes, found))
    theta = typical * (root @ p.x)
    if problem.sizes.rough and not any(run.kind == "artefact" for run in problem.runs):
        p, root, sizes, c = _solved(whole, *cautious(problem.sizes, found, ROUGH_CAUTION))
    root = typical[:, None] * root
    cov = root @ p.cov @ root.T
    left = problem.measured - problem.predicted(theta)
    return CampaignFit(theta, cov, np.linalg.norm(root, axis=1), sizes, c, p, weight, size, left, decimation, parts)


def _solved(whole: InformationSums, sizes: SizeModel, c: Components) -> tuple[ComponentPosterior, F2, SizeModel, Components]:
    """Posterior, and the root of the prior in units of the typical sizes."""
    return posterior(whole.turned(sizes.root, sizes.turned), c, sizes), sizes.root * c.half(sizes), sizes, c


def sums_of(problem: CampaignProblem, fit: CampaignFit, rows: NDArray[np.intp]) -> InformationSums:
    """Normal equations of some readings of the converged solution, to be subtracted from the equations of all (`InformationSums.minus`)."""
    r = problem.readings
    a, kind, weight = r.a[rows], r.kind[rows], fit.weight[rows] / fit.decimation[r.kind[rows]]
    y = fit.residual_mm[rows] / problem.sigma[rows] + a @ (fit.theta / problem.sizes.typical)
    each = [(a[at], y[at], weight[at]) for at in (kind == k for k in range(len(KINDS)))]
    return InformationSums(
        np.array([(b * w[:, None]).T @ b for b, _, w in each]),
        np.array([(w * z) @ b for b, z, w in each]),
        np.array([float(w @ z**2) for _, z, w in each]),
        np.array([float(w.sum()) for _, _, w in each]),
    )


def rough_evidence(problem: CampaignProblem, fit: CampaignFit, terms: tuple[Term, ...]) -> float:
    """Score for further terms, whose variance the fit takes as zero, in units of its standard deviation if there are no such terms.

    The score is the derivative of the log evidence by the variance of ``terms`` (prior: `size_model`), divided by the root of its expected
    information (Rao's score test). It is positive if residuals are more alike than noise at readings where these terms are alike.
    """
    sizes = size_model(problem.machine, terms, (), np.zeros(0), Priors())
    columns = np.concatenate([run_design(problem.machine, terms, r, problem.setup)[:, : len(terms)] for r in problem.runs])
    kind = problem.readings.kind
    weight = fit.weight * np.exp(-fit.components.eta)[kind] / fit.decimation[kind]
    b = columns * sizes.typical / problem.sigma[:, None]
    weighted = b * weight[:, None]
    root = fit.sizes.root * fit.components.half(fit.sizes)
    across = sizes.root.T @ (weighted.T @ problem.readings.a) @ root
    information = sizes.root.T @ (b.T @ weighted) @ sizes.root - across @ fit.posterior.cov @ across.T
    asked = sizes.root.T @ (weighted.T @ (fit.residual_mm / problem.sigma))
    return float((asked @ asked - np.trace(information)) / np.sqrt(2.0 * np.sum(information * information)))


def _thinning(problem: CampaignProblem, size: F1, weight: F1) -> F1:
    per_run = problem.split(np.where(weight > 0.5, size, 0.0))
    return np.array([inflation(tuple(z for z, run in zip(per_run, problem.runs, strict=True) if run.kind == kind)) for kind in KINDS])
