"""Changes of a machine since a solution: which error motions have changed and by how much, cross-validated by other runs.

The model of a known machine is complete; only its values are old. So new runs are compared with the old solution and its covariance, and
changes of error motions compete to explain the residuals: the six linear ones (scales, squareness) and the shape of each motion. Selection
is stepwise by the log marginal likelihood of a linear normal model (as in `abbe.models.solvers.components`) minus a price, the logarithm of
the number of candidates. For validation, each half of the set-ups judges the changes that the other half chose. Set-ups and lost motion are
refitted throughout, because a new cup is not a change of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term, term_values
from abbe.models.machine import AXES
from abbe.models.solvers.components import InformationSums, total
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, build, expected_noise, settle
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors
from abbe.models.uncertainty.known_field import KnownField

LINEAR = ("EXX", "EYY", "EZZ", "C0Y", "B0Z", "A0Z")
LINEAR_SIZES = (3e-6, 10e-6, 30e-6, 100e-6, 300e-6)
"""Sizes of a change of scale or squareness that are tried, rad."""
SHAPE_SIZES = (0.1, 0.3, 1.0, 3.0)
"""Sizes of a change of a motion's shape that are tried, as multiples of its documented size (`abbe.models.solvers.priors`)."""
ENOUGH = 3.0
"""Least log evidence (after its price) of a named change: with the change, the readings are twenty times as likely."""
NEAR = 3.0
"""The runs cannot distinguish a named change from a rival whose evidence is lower by no more than this."""
MOST = 6
POINTS = 41
FEWEST_SETUPS = 2
"""Minimum number of set-ups in each half for cross-validation."""


@dataclass(frozen=True)
class AskedChange:
    """A candidate change of the machine: ``directions`` times q coefficients is added to the p unknowns. ``directions`` has shape (p, q).

    The coefficients are normal with mean 0; their standard deviation is one of ``sizes``. ``several`` tells whether the candidate is the
    shape of a motion (True: several coefficients) or a scale or squareness (False: one).
    """

    name: str
    directions: F2
    sizes: tuple[float, ...]
    several: bool = False


@dataclass(frozen=True)
class ChangeEvidence:
    """Gain in log evidence of a candidate at its best size, and that size."""

    name: str
    gain: float
    size: float


def evidence_of(gram: F2, rhs: F1, base: F2, asked: Sequence[AskedChange]) -> list[ChangeEvidence]:
    """Return the evidence of each candidate if it is the only change added.

    Parameters
    ----------
    gram, rhs : arrays, shape (p, p) and (p,)
        Normal equations of the whitened readings minus their expectation without any change.
    base : array, shape (p, k)
        Factor of the prior covariance of everything else; it is integrated out.
    asked : sequence of AskedChange

    Returns
    -------
    list of ChangeEvidence
        In the order of ``asked``. Gain: log ratio of the marginal likelihoods with and without the candidate.
    """
    own, gradient = without(gram, rhs, base)
    return [_one(a, own, gradient) for a in asked]


def without(gram: F2, rhs: F1, base: F2) -> tuple[F2, F1]:
    """Return normal equations, (p, p) and (p,), after everything along ``base`` (p, k) is integrated out."""
    if not base.shape[1]:
        return gram, rhs
    inside = base.T @ gram @ base
    inside[np.diag_indices_from(inside)] += 1.0
    low = scipy.linalg.cholesky(inside, lower=True)
    half = scipy.linalg.solve_triangular(low, base.T @ np.column_stack([gram, rhs]), lower=True)
    return gram - half[:, :-1].T @ half[:, :-1], rhs - half[:, :-1].T @ half[:, -1]


def log_evidence(gram: F2, rhs: F1, base: F2) -> float:
    """Return the log marginal likelihood with ``base`` (p, k) as factor of the prior covariance, relative to unknowns of zero."""
    if not base.shape[1]:
        return 0.0
    inside = base.T @ gram @ base
    inside[np.diag_indices_from(inside)] += 1.0
    low = scipy.linalg.cholesky(inside, lower=True)
    z = scipy.linalg.solve_triangular(low, base.T @ rhs, lower=True)
    return 0.5 * float(z @ z) - float(np.log(low.diagonal()).sum())


def _one(asked: AskedChange, gram: F2, rhs: F1) -> ChangeEvidence:
    d = asked.directions
    values, vectors = scipy.linalg.eigh(d.T @ gram @ d)
    values, along = np.maximum(values, 0.0), vectors.T @ (d.T @ rhs)
    found = []
    for size in asked.sizes:
        inside = 1.0 + size**2 * values
        found.append(0.5 * float(np.sum(size**2 * along**2 / inside) - np.sum(np.log(inside))))
    best = int(np.argmax(found))
    return ChangeEvidence(asked.name, found[best], asked.sizes[best])


@dataclass(frozen=True)
class TakenChange:
    """A chosen candidate: its size, its gain (after the price) given the other chosen ones, and its rivals with how much less they gain."""

    asked: AskedChange
    size: float
    gain: float
    rivals: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Chosen:
    """Changes chosen from some runs, and these runs' normal equations relative to the old solution: ``gram`` (p, p) and ``rhs`` (p,).

    ``own``, ``gradient``: the same equations after all unknowns except the changes are integrated out.
    """

    taken: tuple[TakenChange, ...]
    gram: F2
    rhs: F1
    own: F2
    gradient: F1


@dataclass(frozen=True, eq=False)
class ChangeContext:
    """The old solution, and the new runs linearised about their own fit. Unknowns are in units of their typical size."""

    known: KnownField
    problem: CampaignProblem
    fit: CampaignFit

    @property
    def _n(self) -> int:
        return len(self.known.terms)

    @cached_property
    def _open(self) -> F2:
        """Factor of the covariance of all unknowns if nothing changed, shape (p, p): old solution, lost motion and set-ups."""
        typical, p, n = self.problem.sizes.typical, len(self.problem.names), self._n
        out = np.zeros((p, p))
        out[:n, :n] = self.known.root() / typical[:n, None]
        out[range(n, p), range(n, p)] = self.fit.prior_sd[n:] / typical[n:]
        return out

    @cached_property
    def candidates(self) -> tuple[AskedChange, ...]:
        """All candidate changes for which the old solution has terms."""
        names = {t.motion if t.order == 0 else t.name for t in self.known.terms}
        linear = [m for m in LINEAR if (m if m[1] == "0" else f"{m}.1") in names]
        out = [AskedChange(m, self._scaled(self.known.linear({m: 1.0})), LINEAR_SIZES) for m in linear]
        bent = dict.fromkeys(t.motion for t in self.known.terms if _is_shape(t))
        return (*out, *(AskedChange(f"{m} shape", self._shape(m), SHAPE_SIZES, several=True) for m in bent))

    def _scaled(self, coefficients: F1) -> F2:
        """Convert coefficients (P,), mm or rad, to a direction of all unknowns in units of their typical size, shape (p, 1)."""
        out = np.zeros((len(self.problem.names), 1))
        out[: self._n, 0] = coefficients / self.problem.sizes.typical[: self._n]
        return out

    def _shape(self, motion: str) -> F2:
        """Factor of the prior covariance of a motion's shape, at its documented size, shape (p, q)."""
        return self.problem.sizes.root[:, [k for k, t in enumerate(self.known.terms) if t.motion == motion and _is_shape(t)]]

    def choose(self, sums: InformationSums) -> Chosen:
        """Add the candidate with the largest gain until none gains enough; drop those that are no longer needed.

        Greedy selection alone has two weaknesses. A flexible shape may first gain more than either of two linear changes that together
        explain everything. And if all axes grow equally, no axis alone gains anything, because a laser's wavelength explains the growth
        nearly as well. So selection starts three times: from no change, from linear changes chosen first, and from all linear changes. The
        choice with the largest evidence wins, which may be no change at all.
        """
        weight = np.exp(-self.fit.components.eta)
        gram, rhs = np.tensordot(weight, sums.gram, 1), weight @ sums.rhs
        start = np.zeros(len(rhs))
        start[: self._n] = self.known.coefficients / self.problem.sizes.typical[: self._n]
        rhs = rhs - gram @ start
        none = Chosen((), gram, rhs, *without(gram, rhs, self._open))
        linear = tuple(a for a in self.candidates if not a.several)
        every = self._needed(replace(none, taken=tuple(TakenChange(a, max(LINEAR_SIZES), 0.0, ()) for a in linear)))
        grown = [self._grown(start, self.candidates) for start in (none, self._grown(none, linear), every)]
        best = max([none, *grown], key=lambda c: log_evidence(c.own, c.gradient, self._changed(c.taken)) - self._price * len(c.taken))
        return replace(best, taken=tuple(replace(t, rivals=self._rivals(best, t)) for t in best.taken))

    def _rivals(self, chosen: Chosen, taken: TakenChange) -> tuple[tuple[str, float], ...]:
        """Return the candidates that, in place of a chosen one, explain nearly as much."""
        names = {t.asked.name for t in chosen.taken}
        left = [a for a in self.candidates if a.name not in names]
        others = self._changed([t for t in chosen.taken if t is not taken])
        own, *found = evidence_of(chosen.own, chosen.gradient, others, [taken.asked, *left])
        near = [(e.name, own.gain - e.gain) for e in found if own.gain - e.gain < NEAR]
        return tuple(sorted(near, key=lambda item: item[1]))

    def _grown(self, chosen: Chosen, candidates: Sequence[AskedChange]) -> Chosen:
        while len(chosen.taken) < MOST and (best := self._best(chosen, candidates)) is not None:
            grown = self._needed(replace(chosen, taken=(*chosen.taken, best)))
            if best.asked.name not in {t.asked.name for t in grown.taken}:
                break
            chosen = grown
        return chosen

    def _best(self, chosen: Chosen, candidates: Sequence[AskedChange]) -> TakenChange | None:
        names = {t.asked.name for t in chosen.taken}
        left = [a for a in candidates if a.name not in names]
        if not left:
            return None
        found = evidence_of(chosen.own, chosen.gradient, self._changed(chosen.taken), left)
        k = int(np.argmax([e.gain for e in found]))
        gain = found[k].gain - self._price
        if gain < ENOUGH:
            return None
        return TakenChange(left[k], found[k].size, gain, ())

    def _needed(self, chosen: Chosen) -> Chosen:
        """Update gain and size of every chosen change given the others, and drop the weakest until all gain enough."""
        taken = list(chosen.taken)
        while taken:
            for k, one in enumerate(taken):
                others = self._changed([o for o in taken if o is not one])
                found = evidence_of(chosen.own, chosen.gradient, others, [one.asked])[0]
                taken[k] = replace(one, gain=found.gain - self._price, size=found.size)
            least = min(taken, key=lambda t: t.gain)
            if least.gain >= ENOUGH:
                break
            taken.remove(least)
        return replace(chosen, taken=tuple(taken))

    @property
    def _price(self) -> float:
        return float(np.log(len(self.candidates)))

    def _changed(self, taken: Sequence[TakenChange]) -> F2:
        """Factor of the covariance that the changes ``taken`` add, shape (p, k)."""
        return np.column_stack([self._open[:, :0], *(t.asked.directions * t.size for t in taken)])

    def _beside(self, taken: Sequence[TakenChange]) -> F2:
        """Factor of the covariance of all unknowns, the changes ``taken`` included, shape (p, k)."""
        return np.column_stack([self._open, self._changed(taken)])

    def _free(self, chosen: Chosen, but: str) -> F2:
        """Factor of the covariance of all unknowns if all scales and squareness errors may also change, except candidate ``but``.

        Shape (p, k), as in `_beside`.
        """
        others = [t for t in chosen.taken if t.asked.name != but]
        names = {but, *(t.asked.name for t in others)}
        linear = [TakenChange(a, 0.0, 0.0, ()) for a in self.candidates if not a.several and a.name not in names]
        return self._beside([t if t.asked.several else replace(t, size=max(LINEAR_SIZES)) for t in (*others, *linear)])

    def size(self, chosen: Chosen, asked: AskedChange) -> tuple[float, float]:
        """Return value and standard uncertainty of a change in the units of `Change`; all scales and squareness errors are fitted, too."""
        coefficients, covariance = self._coefficients(chosen, asked)
        if not asked.several:
            direction = self.known.linear({asked.name: 1.0})
            k = int(np.argmax(np.abs(direction)))
            return float(coefficients[k] / direction[k]), float(np.sqrt(covariance[k, k]) / abs(direction[k]))
        rows = self._values(asked.name.split()[0])
        value = float(np.sqrt(np.mean((rows @ coefficients) ** 2)))
        slope = rows.T @ (rows @ coefficients) / (len(rows) * max(value, 1e-300))
        return value, float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))

    def _coefficients(self, chosen: Chosen, asked: AskedChange) -> tuple[F1, F2]:
        """Coefficients (P,) of one change, mm or rad, and their covariance."""
        size = next(t.size for t in chosen.taken if t.asked.name == asked.name)
        factor = asked.directions * (size if asked.several else max(LINEAR_SIZES))
        whole = np.column_stack([factor, self._free(chosen, asked.name)])
        inside = whole.T @ chosen.gram @ whole
        inside[np.diag_indices_from(inside)] += 1.0
        low = scipy.linalg.cho_factor(inside)
        mine = slice(0, factor.shape[1])
        x = scipy.linalg.cho_solve(low, whole.T @ chosen.rhs)[mine]
        covariance = scipy.linalg.cho_solve(low, np.eye(len(inside))[:, mine])[mine]
        typical = self.problem.sizes.typical[: self._n, None]
        turned = factor[: self._n] * typical
        return turned @ x, turned @ covariance @ turned.T

    def _values(self, motion: str) -> F2:
        """Error motion at `POINTS` points of its stroke per unit of each coefficient, shape (POINTS, P)."""
        stroke = self.known.machine.stroke_mm
        axis = AXES.index(motion[2])
        points = np.tile(stroke.mean(axis=1), (POINTS, 1))
        points[:, axis] = np.linspace(float(stroke[axis, 0]), float(stroke[axis, 1]), POINTS)
        mine = np.array([t.motion == motion for t in self.known.terms])
        return np.asarray(term_values(self.known.terms, points, stroke) * mine)

    def hidden(self, chosen: Chosen) -> dict[str, float]:
        """Bound on the change of each scale (m/m) and squareness (rad) that was not chosen: |estimate| + U (k = 2), all fitted together.

        A change whose U exceeds the largest size tried is left out, because these runs cannot show it.
        """
        names = {t.asked.name for t in chosen.taken}
        out = {}
        for asked in self.candidates:
            if not asked.several and asked.name not in names:
                one = TakenChange(asked, max(LINEAR_SIZES), 0.0, ())
                value, u = self.size(replace(chosen, taken=(*chosen.taken, one)), asked)
                if 2.0 * u < max(LINEAR_SIZES):
                    out[asked.name] = abs(value) + 2.0 * u
        return out

    def floor_mm(self) -> float:
        """Rms noise of the readings, mm."""
        return float(np.sqrt(np.mean(self._noise_mm[self._whole] ** 2)))

    @property
    def _noise_mm(self) -> F1:
        return np.asarray(self.problem.sigma * np.exp(0.5 * self.fit.components.eta)[self.problem.readings.kind])

    @property
    def _whole(self) -> NDArray[np.bool_]:
        """Mask of valid readings."""
        return np.asarray(self.fit.weight > 0.5)

    def judged(self, by_half: Sequence[Chosen]) -> tuple[float, float, float]:
        """Judge each half's choice by the other half: return rms residual without and with the choice, mm, and gain in log likelihood.

        The rms is over all readings, with set-ups refitted. The gain is the smaller one of the two halves; all other unknowns are
        integrated out.
        """
        old = self.known.coefficients
        before, after, count, gains = 0.0, 0.0, 0, []
        for odd, (mine, others) in enumerate(zip(by_half, reversed(by_half), strict=True)):
            rows = (self.problem.readings.fold % 2 == odd) & self._whole
            change = sum((self._coefficients(others, t.asked)[0] for t in others.taken), start=np.zeros_like(old))
            before += self._left(rows, old)
            after += self._left(rows, old + change)
            count += int(rows.sum())
            gains.append(self._likelier(mine, change))
        return float(np.sqrt(before / count)), float(np.sqrt(after / count)), min(gains)

    def _likelier(self, mine: Chosen, change: F1) -> float:
        """How much a ``change`` of the coefficients (P,) increases the log likelihood of the runs of ``mine``."""
        moved = self._scaled(change)[:, 0]
        shifted = mine.rhs - mine.gram @ moved
        plain, with_it = (log_evidence(mine.gram, m, self._open) for m in (mine.rhs, shifted))
        return with_it - plain + float(moved @ mine.rhs) - 0.5 * float(moved @ mine.gram @ moved)

    def _left(self, rows: NDArray[np.bool_], coefficients: F1) -> float:
        """Sum of squares of readings minus prediction, mm²; lost motion and set-ups are refitted within their priors."""
        r, n, typical = self.problem.readings, self._n, self.problem.sizes.typical
        noise = self._noise_mm[rows]
        sd = self.fit.prior_sd[n:] / typical[n:]
        at = self.fit.theta / typical
        at[:n] -= coefficients / typical[:n]
        y = (self.fit.residual_mm[rows] + self.problem.sigma[rows] * (r.a[rows] @ at)) / noise
        a = r.a[rows, n:] * sd * (self.problem.sigma[rows] / noise)[:, None]
        x = scipy.linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ y, assume_a="pos")
        return float(np.sum(((y - a @ x) * noise) ** 2))


def _is_shape(term: Term) -> bool:
    """Whether a term belongs to the shape of a motion; scales and squareness errors are candidates of their own."""
    return term.order > 0 and not (term.order == 1 and term.component == term.axis)


@dataclass(frozen=True)
class Change:
    """A changed error motion.

    Attributes
    ----------
    name : str
        ``"EXX"`` ... ``"A0Z"`` for a scale or squareness, ``"EYX shape"`` for the shape of a whole motion (of a positioning motion: without
        its scale).
    value, u : float
        Change and its standard uncertainty, estimated together with all scales and squareness errors. Scale: m/m; squareness: rad; shape:
        rms over the stroke, mm or rad. ``u`` includes the old solution's uncertainty.
    evidence : float
        Gain in log evidence after its price, given all other named changes.
    rivals : tuple of (name, missing evidence)
        Candidates that explain nearly as much in its place: these runs cannot distinguish them.
    halves : int
        Number of halves of the runs, 0 to 2, in which this change was chosen independently.
    """

    name: str
    value: float
    u: float
    evidence: float
    rivals: tuple[tuple[str, float], ...]
    halves: int


@dataclass(frozen=True)
class Changed:
    """All changes found.

    The set-ups are split in two halves, and each half is judged with the changes that the other half chose. ``before_mm``: rms of readings
    minus the old solution; ``after_mm``: rms with the changes; ``judged``: gain in log likelihood, the smaller of both halves. With
    too few set-ups these three are None.
    ``floor_mm``: rms noise. ``hidden``: bound on each change of scale (m/m) or squareness (rad) that was not named but would show.
    """

    changes: tuple[Change, ...]
    before_mm: float | None
    after_mm: float | None
    floor_mm: float
    judged: float | None
    hidden: dict[str, float]


def changed_since(known: KnownField, runs: tuple[RunData, ...]) -> Changed:
    """Name the changes of a machine since it was solved.

    Parameters
    ----------
    known : KnownField
        The old solution, with its covariance.
    runs : tuple of RunData
        Runs measured since then, corrected for the active table and known effects in the same way as the runs of the solution.

    Raises
    ------
    ValueError
        No runs, or an unusable run, which the message names.
    """
    if not runs:
        raise ValueError("changes: no runs")
    problem = build(known.machine, known.terms, runs, Priors(), expected_noise(runs, None, None))
    fit = settle(problem, _silent)
    context = ChangeContext(known, problem, fit)
    whole = context.choose(total(fit.parts))
    by_half = [context.choose(total(half)) for half in _halves(fit.parts, problem)]
    before, after, judged = context.judged(by_half) if by_half else (None, None, None)
    return Changed(_changes(context, whole, by_half), before, after, context.floor_mm(), judged, context.hidden(whole))


def _silent(_: str) -> None:
    return None


def _halves(parts: tuple[InformationSums, ...], problem: CampaignProblem) -> list[tuple[InformationSums, ...]]:
    """Split the runs into two halves of whole set-ups (even and odd folds); empty if a half would have too few set-ups."""
    folds = problem.readings.fold
    setups = [{problem.runs[k].setup for k in np.unique(problem.readings.run[folds % 2 == odd])} for odd in (0, 1)]
    if min(len(s) for s in setups) < FEWEST_SETUPS:
        return []
    return [parts[odd::2] for odd in (0, 1)]


def _changes(context: ChangeContext, whole: Chosen, by_half: list[Chosen]) -> tuple[Change, ...]:
    """Return the changes chosen from all runs together, largest evidence first."""
    out = []
    for taken in whole.taken:
        value, u = context.size(whole, taken.asked)
        halves = sum(taken.asked.name in {t.asked.name for t in half.taken} for half in by_half)
        out.append(Change(taken.asked.name, value, u, taken.gain, taken.rivals, halves))
    return tuple(sorted(out, key=lambda c: -c.evidence))
