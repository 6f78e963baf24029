"""Runs of a campaign that contradict the others: wrong unit, wrong sign, swapped axes, another machine.

All runs form one linear model with wide priors. For every run and every possible mistake, the evidence of the whole campaign is computed
with this mistake corrected, and with this run unrelated to the others. The best hypothesis is accepted only if its log evidence is higher
by `STRONG`. Source: marginal likelihood of a linear model with normal priors (Bayes factors; Kass and Raftery 1995 call 5 "very strong").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, Term, smooth_terms
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData, block_average, nominal_reading
from abbe.models.solvers.observe import SetupUnknowns, run_design, setup_unknowns
from abbe.models.solvers.priors import Priors, term_prior_sd

SIGMA_GRID_MM = np.geomspace(1e-6, 1.0, 49)
OUTLIER_SIGMA, OUTLIER_SHARE = 3.5, 0.2
"""Readings `OUTLIER_SIGMA` standard deviations off their prediction by the run's others are left out: at most `OUTLIER_SHARE` of a run."""


@dataclass(frozen=True)
class Part:
    """One run without its outliers: whitened design, in units of the prior, and readings.

    ``log_sigma``: log of the scaling of the readings, subtracted from the log evidence.
    """

    a: F2
    y: F1
    log_sigma: float

    @cached_property
    def information(self) -> F2:
        """Information of the run on the unknowns, shape (p, p), without their prior."""
        return np.asarray(self.a.T @ self.a)

    @cached_property
    def moment(self) -> F1:
        """Moment of the unknowns by this run, shape (p,): transposed design times readings."""
        return np.asarray(self.a.T @ self.y)


@dataclass(frozen=True, slots=True)
class Posterior:
    """Posterior from some runs: Cholesky factor of the information with the prior, unknowns, and log evidence."""

    factor: F2
    theta: F1
    log_evidence: float


def together(parts: Sequence[Part]) -> Posterior:
    """Posterior from some runs together."""
    n = parts[0].a.shape[1]
    information = sum((p.information for p in parts), np.eye(n))
    lower = scipy.linalg.cholesky(information, lower=True)
    half = scipy.linalg.solve_triangular(lower, sum((p.moment for p in parts), np.zeros(n)), lower=True)
    theta = scipy.linalg.solve_triangular(lower, half, lower=True, trans=1)
    left = sum(float(p.y @ p.y) for p in parts) - float(half @ half)
    log_p = -0.5 * left - float(np.log(np.diag(lower)).sum()) - sum(p.log_sigma for p in parts)
    return Posterior(lower, theta, log_p)


def conditional(others: Posterior, variants: dict[str, Part]) -> dict[str, float]:
    """Log evidence of each variant of a run given the other runs."""
    out: dict[str, float] = {}
    known: list[tuple[F2, F2, F2]] = []
    for name, part in variants.items():
        found = next((k for k in known if np.array_equal(k[0], part.a)), None)
        if found is None:
            spread = scipy.linalg.solve_triangular(others.factor, part.a.T, lower=True).T
            found = (part.a, spread, scipy.linalg.cholesky(spread @ spread.T + np.eye(len(spread)), lower=True))
            known.append(found)
        left = scipy.linalg.solve_triangular(found[2], part.y - part.a @ others.theta, lower=True)
        out[name] = -0.5 * float(left @ left) - float(np.log(np.diag(found[2])).sum()) - part.log_sigma
    return out


@dataclass(frozen=True)
class Design:
    """Design of one run, shape (n, p), in units of the prior."""

    a: F2

    @cached_property
    def spectrum(self) -> tuple[F1, F2]:
        """Eigenvalues (n,), none below 0, and eigenvectors (n, n) of the prior covariance of the run's readings."""
        values, vectors = scipy.linalg.eigh(self.a @ self.a.T)
        return np.clip(values, 0.0, None), vectors


def scatter(design: Design, y: F1) -> tuple[float, NDArray[np.bool_]]:
    """Most probable noise of one run, mm, and a mask of its outliers, bool, shape (n,).

    The noise is one of `SIGMA_GRID_MM`; each reading is compared with its prediction by the run's other readings.
    """
    drop = np.zeros(y.size, dtype=bool)
    while True:
        sigma, z = _against_the_rest(Design(design.a[~drop]) if drop.any() else design, y[~drop])
        bad = np.abs(z) > OUTLIER_SIGMA
        if not bad.any() or drop.sum() + bad.sum() > OUTLIER_SHARE * drop.size:
            return sigma, drop
        drop[np.flatnonzero(~drop)[bad]] = True


def _against_the_rest(design: Design, y: F1) -> tuple[float, F1]:
    """Most probable noise, and every reading's distance from its prediction by the others, in standard deviations.

    Source: Rasmussen and Williams, Gaussian Processes, eqs 5.8 and 5.12.
    """
    values, vectors = design.spectrum
    turned = vectors.T @ y
    spread = values[:, None] + SIGMA_GRID_MM**2
    log_p = -0.5 * (turned[:, None] ** 2 / spread + np.log(spread)).sum(axis=0)
    sigma = float(SIGMA_GRID_MM[int(np.argmax(log_p))])
    over = 1.0 / (values + sigma**2)
    return sigma, (vectors @ (over * turned)) / np.sqrt((vectors**2) @ over)


WIDE = Priors(
    scale_rad=200e-6,
    squareness_rad=200e-6,
    positioning_mm=10e-3,
    straightness_mm=10e-3,
    angle_rad=30e-6,
    angle_slope_rad=40e-6,
    backlash_mm=20e-3,
    cup_mm=0.2,
    bar_unknown_mm=0.2,
    tilt_rad=1e-3,
    zero_mm=0.1,
)
"""Priors wider than the solution's: a bad machine or set-up is no reason to suspect a run."""
ORDER = 10
BLOCKS = 120
STRONG, NAMED = 25.0, 5.0
"""Least gain of natural log evidence: `STRONG` to suspect a run, `NAMED` to prefer a named cause to "other"."""
FACTORS = {"um": 1e-3, "inch": 25.4, "sign": -1.0, "mm_as_um": 1e3, "mm_as_inch": 1.0 / 25.4}
"""Factors that correct deviations written in another unit or with the other sign."""
SWAPS = {"swap_xy": (0, 1), "swap_yz": (1, 2), "swap_xz": (0, 2)}
ON_SPHERE_MM = 1.5
GROSS, GROSS_MM = 4.0, 2e-3
"""A run with cause "other" is reported only if its misfit exceeds both this multiple of the expected rms and this length."""
SURE_SIGMA = 5.0
"""A reading this many standard deviations from its prediction by all other readings is an outlier, not a sign of a bad run."""
OUTLIER_MM = 0.1
"""Width of the range in which an outlier may lie."""
LARGE_MM = 0.3
"""Outliers are searched only in runs whose readings are all below this; no machine has larger deviations."""


@dataclass(frozen=True, slots=True)
class SuspectRun:
    """A run that does not fit the others.

    Attributes
    ----------
    run : str
    cause : str
        Key of `FACTORS` or `SWAPS`: the run fits after this mistake is corrected. "other": no correction makes it fit.
    gain : float
        Gain of the campaign's log evidence by this hypothesis.
    misfit_mm, expected_mm : float
        Rms difference between the run and the prediction of the other runs (its own set-up refitted), and its expected value.
    tied : tuple of str
        Other runs that explain the contradiction equally well: of two runs, either may be wrong.
    """

    run: str
    cause: str
    gain: float
    misfit_mm: float
    expected_mm: float
    tied: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Run:
    """A run as given, and with each possible mistake corrected.

    ``first_setup``: index of the first set-up unknown; ``cleaned``: outliers relative to the other runs are already removed.
    """

    label: str
    as_is: Part
    undone: dict[str, Part]
    sigma_mm: float
    first_setup: int
    cleaned: bool = False


@dataclass(frozen=True)
class _Model:
    """Model of all runs, with unknowns in units of their prior standard deviation (``scale``)."""

    machine: Machine
    terms: tuple[Term, ...]
    setup: SetupUnknowns
    scale: F1

    def design(self, short: RunData) -> Design:
        return Design(run_design(self.machine, self.terms, short, self.setup) * self.scale)


def suspects(machine: Machine, runs: Sequence[RunData], *, limit: float = STRONG) -> tuple[SuspectRun, ...]:
    """Find runs that contradict the others, worst first; each is set aside before the search for the next.

    Parameters
    ----------
    runs : sequence of RunData
        With fewer than two, the result is empty.
    limit : float
        Least gain of log evidence.
    """
    if len(runs) < 2:
        return ()
    left, found = _prepared(machine, runs), list[SuspectRun]()
    while len(left) > 1 and len(found) < len(runs) // 2:
        worst = _worst(left, limit)
        if worst is None:
            break
        run = next(r for r in left if r.label == worst.run)
        left.remove(run)
        cleaned = None if run.cleaned else _cleaned(run, together([r.as_is for r in left]))
        if cleaned is None:
            found.append(worst)
        else:
            left.append(cleaned)
    return tuple(found)


def _cleaned(run: _Run, others: Posterior) -> _Run | None:
    """The run without readings that are outliers relative to the other runs; None if no readings or too many are outliers."""
    part = run.as_is
    spread = scipy.linalg.solve_triangular(others.factor, part.a.T, lower=True).T
    off, drop = part.y - part.a @ others.theta, np.zeros(part.y.size, dtype=bool)
    while True:
        precision = scipy.linalg.inv(spread[~drop] @ spread[~drop].T + np.eye(int((~drop).sum())))
        z = precision @ off[~drop] / np.sqrt(np.diag(precision))
        if np.abs(z).max() <= SURE_SIGMA:
            break
        drop[np.flatnonzero(~drop)[int(np.argmax(np.abs(z)))]] = True
        if drop.sum() > OUTLIER_SHARE * drop.size:
            return None
    if not drop.any():
        return None
    lost = float(drop.sum() * (np.log(OUTLIER_MM) - np.log(run.sigma_mm)))
    return replace(run, as_is=Part(part.a[~drop], part.y[~drop], part.log_sigma + lost), undone=_without(run.undone, drop), cleaned=True)


def _without(undone: dict[str, Part], drop: NDArray[np.bool_]) -> dict[str, Part]:
    """Leave the same readings out of every variant that still has all readings."""
    return {n: Part(p.a[~drop], p.y[~drop], p.log_sigma) if p.y.size == drop.size else p for n, p in undone.items()}


def _prepared(machine: Machine, runs: Sequence[RunData]) -> list[_Run]:
    """Every run without its outliers, whitened by the median noise of its instrument in this campaign."""
    model = _model(machine, runs)
    short = [_shortened(r) for r in runs]
    designs, readings = [model.design(r) for r in short], [_readings(r) for r in short]
    found = [scatter(*given) for given in zip(designs, readings, strict=True)]
    usual = {
        kind: float(np.median([s for (s, _), r in zip(found, runs, strict=True) if r.kind == kind])) for kind in {r.kind for r in runs}
    }
    first = len(model.terms) + len(DIRECTIONS)
    out = []
    for run, a, y, (_, drop) in zip(runs, designs, readings, found, strict=True):
        sigma, without = usual[run.kind], _readings(_shortened(replace(run, deviation_mm=np.zeros_like(run.deviation_mm))))
        undone = {name: _part(a, without + f * (y - without), drop, sigma, f) for name, f in FACTORS.items()}
        undone |= {name: _part(model.design(r), _readings(r), drop, sigma) for name, r in _swapped(run).items()}
        out.append(_Run(run.label, _part(a, y, drop, sigma), undone, sigma, first))
    return out


def _model(machine: Machine, runs: Sequence[RunData]) -> _Model:
    terms = smooth_terms(ORDER)
    setup = setup_unknowns(tuple(replace(r, u_length_mm=None, length_calibrated=False) for r in runs), WIDE)
    scale = np.concatenate([term_prior_sd(machine, terms, WIDE), np.full(len(DIRECTIONS), WIDE.backlash_mm), setup.prior_sd])
    return _Model(machine, terms, setup, scale)


def _shortened(run: RunData) -> RunData:
    return block_average(run, BLOCKS) if run.kind == "bar" else run


def _readings(short: RunData) -> F1:
    """Readings of a shortened run minus those of a perfect machine."""
    return np.asarray(short.deviation_mm - nominal_reading(short))


def _part(design: Design, y: F1, drop: NDArray[np.bool_], sigma: float, factor: float = 1.0) -> Part:
    """A whitened run; ``log_sigma`` accounts for the factor on the readings and spreads outliers evenly over `OUTLIER_MM`."""
    if np.abs(y).max() < LARGE_MM and abs(factor) != 1.0:
        drop = scatter(design, y)[1]
    log_sigma = float(np.log(np.where(drop, OUTLIER_MM, sigma)).sum() - y.size * np.log(abs(factor)))
    return Part(design.a[~drop] / sigma, y[~drop] / sigma, log_sigma)


def _worst(runs: Sequence[_Run], limit: float) -> SuspectRun | None:
    as_is = together([r.as_is for r in runs]).log_evidence
    found = [_judged(run, [r.as_is for r in runs if r is not run], as_is) for run in runs]
    found = [s for s in found if s.gain > limit and s.misfit_mm > _least_misfit_mm(s)]
    if not found:
        return None
    worst = max(found, key=lambda s: s.gain)
    return replace(worst, tied=tuple(s.run for s in found if s.run != worst.run and worst.gain - s.gain < limit))


def _least_misfit_mm(s: SuspectRun) -> float:
    """Return the least misfit, mm, that proves the cause: a run no farther from the others than expected is only noisy."""
    return max(GROSS * s.expected_mm, GROSS_MM) if s.cause == "other" else s.expected_mm


def _judged(run: _Run, rest: list[Part], as_is: float) -> SuspectRun:
    """Return the mistake in a run that explains the campaign best."""
    others = together(rest)
    misfit, expected = _misfit(others, run)
    noisy = _noisier(run.as_is, max(1.0, misfit / expected))
    best, cause = others.log_evidence + max(together([run.as_is]).log_evidence, conditional(others, {"": noisy})[""]), "other"
    for name, log_p in conditional(others, run.undone).items():
        if others.log_evidence + log_p > best + NAMED * (cause == "other"):
            best, cause = others.log_evidence + log_p, name
    return SuspectRun(run.label, cause, best - as_is, misfit, expected)


def _noisier(part: Part, factor: float) -> Part:
    """Return the run with ``factor`` times its noise: that division by 25.4 makes a noisy run quiet does not prove a wrong unit."""
    return Part(part.a / factor, part.y / factor, part.log_sigma + part.y.size * float(np.log(factor)))


def _swapped(run: RunData) -> dict[str, RunData]:
    """Shortened variants of a ball-bar run with two axes exchanged, where the positions still lie on the sphere."""
    if run.centre_mm is None or run.radius_mm is None:
        return {}
    out = {}
    for name, (i, j) in SWAPS.items():
        order = [0, 1, 2]
        order[i], order[j] = j, i
        axes = run.axes_mm[:, order]
        off = np.abs(np.linalg.norm(axes - run.centre_mm, axis=1) - run.radius_mm).max()
        if off < ON_SPHERE_MM:
            out[name] = _shortened(replace(run, axes_mm=axes, sign=run.sign[:, order]))
    return out


def _misfit(others: Posterior, run: _Run) -> tuple[float, float]:
    """Rms difference between a run (own set-up refitted) and the prediction of the others, and the expected value of this rms, mm."""
    part, first = run.as_is, run.first_setup
    r = part.y - part.a[:, :first] @ others.theta[:first]
    own = part.a[:, first:]
    own = own[:, np.abs(own).max(axis=0) > 0]
    q, _ = scipy.linalg.qr(own, mode="economic")
    left = r - q @ (q.T @ r)
    spread = scipy.linalg.solve_triangular(others.factor, part.a.T, lower=True).T
    spread = spread - q @ (q.T @ spread)
    expected = 1.0 + float((spread**2).sum()) / len(r)
    return run.sigma_mm * float(np.sqrt(np.mean(left**2))), run.sigma_mm * float(np.sqrt(expected))
