"""Variance components, estimated from the readings.

The components are the noise of the instruments and the typical size of each class of errors. A campaign is compressed to normal equations
of the unknowns, per fold and instrument (`InformationSums`), so later work depends on the number of unknowns (a few hundred), not on the
number of readings.

The method is the marginal likelihood of a linear normal model (restricted maximum likelihood with weak hyperpriors), maximised by Fisher
scoring on the logarithms: Patterson and Thompson 1971, Harville 1977; MacKay 1992 "evidence". The uncertainty of the components widens the
prior of the error motions (`cautious`). The result is deterministic.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.solvers.priors import ENDS_SHARES, LENGTHS, SMALLEST_BEND, SizeModel, with_shapes

I1 = NDArray[np.int64]
KINDS = ("bar", "laser", "artefact")
"""Instruments whose noise is estimated separately."""
NOISE_SD = 2.0
"""Weak hyperprior of an instrument's log noise variance about the expected one: a factor of e in the standard deviation."""
LEAST_ETA: F1 = np.array([0.0 if kind == "artefact" else -8.0 for kind in KINDS])
"""Least log ratio of noise variance to expected noise variance, by instrument. A factor of 55 in the standard deviation is below any
resolution; without a limit, readings without noise would drive the ratio to minus infinity and the normal equations beyond double
precision. The noise of an artefact's points is never below their stated repeatability: with a free form, few poses would fit any scatter,
even the scatter from the touch's resolution.
"""
CLEAR = 1.5
"""Gain in log evidence that makes a choice clear: odds of 4 to 1."""
STEPS = 25
TOLERANCE = 0.02
"""Gain in log evidence below which the estimation of the components stops."""
LARGEST_STEP = 1.5
HALVINGS = 6


@dataclass(frozen=True)
class PlannedReadings:
    """Whitened, scaled readings of all runs, stacked.

    Attributes
    ----------
    a : array, shape (n, p)
        Design; every row divided by its expected noise, every column multiplied by the unknown's reference size.
    y : array, shape (n,)
        Readings minus the prediction at the expansion point, divided by their expected noise.
    run, fold, kind : arrays of int, shape (n,)
        Index of each row's run, fold (set-ups that are held out together) and instrument in `KINDS`.
    """

    a: F2
    y: F1
    run: I1
    fold: I1
    kind: I1


@dataclass(frozen=True)
class InformationSums:
    """Normal equations per kind of instrument: A^T W A (k, p, p), A^T W y (k, p), y^T W y (k,), sum of weights (k,)."""

    gram: F3
    rhs: F2
    square: F1
    count: F1

    def minus(self, other: InformationSums) -> InformationSums:
        """The sums without a part of the readings."""
        return InformationSums(self.gram - other.gram, self.rhs - other.rhs, self.square - other.square, self.count - other.count)

    def turned(self, root: F2, blocks: tuple[NDArray[np.intp], ...]) -> InformationSums:
        """The sums for new unknowns, where old = ``root`` @ new; ``root`` is the unit matrix outside ``blocks``."""
        gram = self.gram.copy()
        own = [root[np.ix_(at, at)] for at in blocks]
        for one in (gram[k] for k in np.flatnonzero(self.count > 0)):
            for at, turn in zip(blocks, own, strict=True):
                one[:, at] = one[:, at] @ turn
            for at, turn in zip(blocks, own, strict=True):
                one[at] = turn.T @ one[at]
        return InformationSums(gram, self.rhs @ root, self.square, self.count)

    def decimated(self, factor: F1) -> InformationSums:
        """The sums divided by ``factor``, shape (k,): correlated neighbours count as fewer readings."""
        f: F1 = 1.0 / factor
        return InformationSums(self.gram * f[:, None, None], self.rhs * f[:, None], self.square * f, self.count * f)


@dataclass(frozen=True)
class Grams:
    """A^T A of every (fold, kind) with all weights 1, computed once: shape (folds, kinds, p, p)."""

    parts: NDArray[np.float64]


def grams(r: PlannedReadings) -> Grams:
    """Gram matrices of all folds and kinds of instrument."""
    folds, p = int(r.fold.max()) + 1, r.a.shape[1]
    out = np.zeros((folds, len(KINDS), p, p))
    for f in range(folds):
        for k in range(len(KINDS)):
            rows = r.a[(r.fold == f) & (r.kind == k)]
            if rows.size:
                used = np.flatnonzero(rows.any(axis=0))  # most set-up unknowns belong to other folds
                part = rows[:, used]
                out[f, k][np.ix_(used, used)] = part.T @ part
    return Grams(out)


def sums(r: PlannedReadings, g: Grams, weight: F1) -> tuple[InformationSums, ...]:
    """Normal equations of every fold for given weights of the readings (1 full, 0 not used), shape (n,)."""
    found = []
    for f in range(g.parts.shape[0]):
        gram, rhs, square, count = g.parts[f].copy(), [], [], []
        for k in range(len(KINDS)):
            at = (r.fold == f) & (r.kind == k)
            w, y = weight[at], r.y[at]
            downweighted = np.flatnonzero(at & (weight < 1.0))
            if downweighted.size:
                out = r.a[downweighted]
                gram[k] -= (out * (1.0 - weight[downweighted])[:, None]).T @ out
            rhs.append((w * y) @ r.a[at])
            square.append(float(w @ y**2))
            count.append(float(w.sum()))
        found.append(InformationSums(gram, np.array(rhs), np.array(square), np.array(count)))
    return tuple(found)


def total(parts: tuple[InformationSums, ...]) -> InformationSums:
    """Return the sums over all folds."""
    first, *rest = parts
    gram = first.gram.copy()
    for s in rest:  # one after the other: together they would take as much memory again
        gram += s.gram
    return InformationSums(
        gram, sum((s.rhs for s in rest), first.rhs), sum((s.square for s in rest), first.square), sum((s.count for s in rest), first.count)
    )


@dataclass(frozen=True)
class Components:
    """Log ratios of estimated to expected variances: of error sizes (``psi`` of `SizeModel`), and of noise (``eta``, per instrument)."""

    psi: F1
    eta: F1

    def half(self, model: SizeModel) -> F1:
        """Factor on every unknown's documented prior standard deviation, shape (p,)."""
        return np.asarray(np.exp(0.5 * model.design @ self.psi))


@dataclass(frozen=True)
class ComponentPosterior:
    """Solution for given components, in units of each unknown's prior standard deviation.

    ``x`` (p,) most probable values; ``low`` (p, p) lower triangular factor of their information; ``log_evidence`` of the readings
    (constants left out).
    """

    x: F1
    low: F2
    log_evidence: float

    @cached_property
    def cov(self) -> F2:
        """Covariance of the unknowns, shape (p, p)."""
        inverse, _ = scipy.linalg.lapack.dpotri(self.low, lower=1)  # its lower half only; the rest is the zeros of the factor
        cov: F2 = inverse + inverse.T
        np.fill_diagonal(cov, inverse.diagonal())
        return cov


def blend(sums: InformationSums, c: Components, half: F1) -> tuple[F2, F1, float]:
    """Information, moment and sum of squares over all instruments in units of the prior: (p, p), (p,), scalar."""
    w, gram = np.exp(-c.eta), np.zeros_like(sums.gram[0])
    for k in np.flatnonzero(sums.count > 0):  # in place: these products are a fifth of all the work
        gram += w[k] * sums.gram[k]
    gram *= half[:, None]
    gram *= half
    return gram, (w @ sums.rhs) * half, float(w @ sums.square)


def posterior(sums: InformationSums, c: Components, model: SizeModel) -> ComponentPosterior:
    """Most probable unknowns, their covariance and the evidence."""
    gram, rhs, square = blend(sums, c, c.half(model))
    np.fill_diagonal(gram, gram.diagonal() + 1.0)
    low = scipy.linalg.cholesky(gram, lower=True, overwrite_a=True, check_finite=False)
    z = scipy.linalg.solve_triangular(low, rhs, lower=True, check_finite=False)
    x = scipy.linalg.solve_triangular(low, z, lower=True, trans=1, check_finite=False)
    log_det = 2.0 * float(np.log(low.diagonal()).sum())
    return ComponentPosterior(x, low, -0.5 * (float(sums.count @ c.eta) + log_det + square - float(z @ z)))


def slope(sums: InformationSums, c: Components, model: SizeModel, p: ComponentPosterior) -> tuple[F1, F2]:
    """Gradient of the log evidence and its expected information with respect to (psi, eta)."""
    half = c.half(model)
    h, kinds = model.design.shape[1], np.flatnonzero(sums.count > 0)
    w: F1 = np.exp(-c.eta)
    hat = -p.cov
    np.fill_diagonal(hat, hat.diagonal() + 1.0)
    gradient = np.zeros(h + c.eta.size)
    gradient[:h] = 0.5 * (p.x**2 + p.cov.diagonal() - 1.0) @ model.design
    info = np.zeros((gradient.size, gradient.size))
    info[:h, :h] = 0.5 * model.design.T @ (hat * hat) @ model.design
    shares = _information_shares(sums, w, half, p.cov, hat)
    for k in kinds:
        own = p.x * half
        left = w[k] * (sums.square[k] - 2.0 * float(sums.rhs[k] @ own) + float(own @ sums.gram[k] @ own))
        trace = float(shares[k].trace())
        gradient[h + k] = 0.5 * (left + trace - float(sums.count[k]))
        info[h + k, :h] = info[:h, h + k] = 0.5 * np.einsum("ij,ij->i", p.cov, shares[k]) @ model.design
        for m in kinds:
            info[h + k, h + m] = 0.5 * float(np.einsum("ij,ji->", shares[k], shares[m]))
        info[h + k, h + k] += 0.5 * (float(sums.count[k]) - 2.0 * trace)
    return gradient, info


def _information_shares(sums: InformationSums, w: F1, half: F1, cov: F2, hat: F2) -> list[F2]:
    """Covariance times the information of each instrument; ``hat`` is the sum of these products, so the last one is the remainder."""
    used = np.flatnonzero(sums.count > 0)
    out = [np.zeros_like(cov) for _ in w]
    rest = hat
    for k in used[:-1]:
        out[k] = cov @ (sums.gram[k] * (w[k] * half[:, None] * half))
        rest = rest - out[k]
    out[used[-1]] = rest
    return out


@dataclass(frozen=True)
class FittedComponents:
    """Most probable components, their covariance (psi first, then eta), and log evidence plus log hyperprior."""

    components: Components
    spread: F2
    value: float


def estimate(sums: InformationSums, model: SizeModel, start: Components) -> FittedComponents:
    """Find the most probable components from a start; ``sums`` are those of the independent unknowns (`InformationSums.turned`)."""
    weight = np.concatenate([model.sd, np.full(start.eta.size, NOISE_SD)]) ** -2.0

    def objective(c: Components) -> tuple[float, ComponentPosterior]:
        p = posterior(sums, c, model)
        return p.log_evidence - 0.5 * float(weight @ np.concatenate([c.psi, c.eta]) ** 2), p

    c = _moved(start, np.zeros(weight.size), model)
    value, p = objective(c)
    info = np.diag(weight)
    for _ in range(STEPS):
        gradient, info = slope(sums, c, model, p)
        gradient -= weight * np.concatenate([c.psi, c.eta])
        info = _positive(info + np.diag(weight), float(weight.min()))
        step = _inward(gradient, info, c, model)
        step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        trial = _moved(c, step, model)
        better, found = objective(trial)
        for _ in range(HALVINGS):  # expected information may overshoot
            if better >= value - 1e-9:
                break
            step *= 0.5
            trial = _moved(c, step, model)
            better, found = objective(trial)
        gain, c, value, p = better - value, trial, better, found
        if gain < TOLERANCE:
            break
    return FittedComponents(c, np.asarray(scipy.linalg.inv(info)), value)


def _inward(gradient: F1, info: F2, c: Components, model: SizeModel) -> F1:
    """Scoring step of the numbers that may move; a number at a bound stays there if its gradient pushes it against the bound."""
    now, (low, high) = np.concatenate([c.psi, c.eta]), _bounds(c, model)
    free = np.flatnonzero(~(((now <= low) & (gradient < 0)) | ((now >= high) & (gradient > 0))))
    step = np.zeros(now.size)
    step[free] = scipy.linalg.solve(info[np.ix_(free, free)], gradient[free], assume_a="pos")
    return step


def _bounds(c: Components, model: SizeModel) -> tuple[F1, F1]:
    return np.concatenate([model.low, LEAST_ETA[: c.eta.size]]), np.concatenate([model.high, np.full(c.eta.size, np.inf)])


def _positive(info: F2, least: float) -> F2:
    """Raise eigenvalues to at least ``least``; smaller ones come only from rounding (readings without noise)."""
    with suppress(np.linalg.LinAlgError):  # nearly always; it takes a twentieth of the time of the eigenvalues
        scipy.linalg.cholesky(info - least * np.eye(len(info)))
        return info
    values, vectors = scipy.linalg.eigh(info)
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)


def _moved(c: Components, step: F1, model: SizeModel) -> Components:
    """The components after a step, kept inside their bounds."""
    new = np.clip(np.concatenate([c.psi, c.eta]) + step, *_bounds(c, model))
    return Components(new[: c.psi.size], new[c.psi.size :])


def fit_shapes(sums: InformationSums, model: SizeModel, start: Components) -> tuple[SizeModel, FittedComponents]:
    """`estimate`, including the correlation length of the error motions and the share of their variance at the ends of the strokes.

    The smaller one of `ENDS_SHARES` is taken only if the log evidence gains `CLEAR`: without readings near the ends, too small a share
    costs more than too large a share. ``sums`` are those of the unknowns in units of their typical size.
    """
    usual, least = ENDS_SHARES
    best = _fit_length(sums, with_shapes(model, model.length, usual), start)
    if not model.blocks:
        return best
    other = _fit_length(sums, with_shapes(model, best[0].length, least), best[1].components)
    return other if other[1].value > best[1].value + CLEAR else best


def _fit_length(sums: InformationSums, model: SizeModel, start: Components) -> tuple[SizeModel, FittedComponents]:
    """`estimate` by hill climbing over `LENGTHS` from the model's own length."""
    at = LENGTHS.index(model.length)
    found = {at: estimate(sums.turned(model.root, model.turned), model, start)}
    models = {at: model}
    if not model.blocks:
        return model, found[at]
    for way in (1, -1):
        while 0 <= at + way < len(LENGTHS):
            new = at + way
            if new not in found:
                models[new] = with_shapes(model, LENGTHS[new], model.ends)
                found[new] = estimate(sums.turned(models[new].root, model.turned), models[new], found[at].components)
            if found[new].value <= found[at].value:
                break
            at = new
    return models[at], found[at]


ROUGH_CAUTION = 0.2
"""Share of the widening by `cautious` that U of a rough machine includes. Its rough parts absorb what the shapes of the smooth prior do
not follow; with the whole widening U is 20 to 30 % too wide (docs/explanation/coverage.md). The map itself uses the whole widening."""


def cautious(model: SizeModel, found: FittedComponents, share: float = 1.0) -> tuple[SizeModel, Components]:
    """Return a prior of the error motions that is wider than the most probable one, so that uncertainties are not too small.

    The prior is wider in two ways, neither of which matters with many readings. ``share``: share of the first way that is applied.

    - The variance of a motion or slope is its posterior mean (log-normal: exp(psi + v/2)), not its most probable value. For two motions
      that the readings hardly separate, the most probable sizes are too small. Without information the limit is the documented variance; on
      a machine whose own size is estimated (artefacts) as m times the usual one, the limit of the standard deviation is m^2 times the
      documented one. The larger a machine's errors, the less the documented sizes tell about motions that its readings do not show.
    - The prior of every shape has at least `SMALLEST_BEND` of the documented size: no guideway is known to be smooth to nanometres.
    """
    rough = np.array([name.startswith("smoothness ") for name in model.names])
    sd = np.sqrt(found.spread.diagonal()[: rough.size])
    psi = found.components.psi
    psi = psi + np.where(np.array(model.names) == "slope", share * np.clip(-psi, 0.0, 0.5 * sd**2), 0.0)
    c = Components(np.clip(psi, model.low, model.high), found.components.eta)
    sizes = model.design * ~rough
    unsure = np.einsum("ij,jk,ik->i", sizes, found.spread[: rough.size, : rough.size], sizes)
    factor = np.ones(model.typical.size)
    documented = max(float(np.exp(c.psi[model.names.index("machine")])), 1.0) if "machine" in model.names else 1.0
    for at in model.blocks:
        scale = np.minimum(np.exp(0.25 * share * unsure[at]), np.maximum(documented / c.half(model)[at], 1.0))
        prior_size = np.linalg.norm(model.root[:, at], axis=0) * c.half(model)[at] * scale
        factor[at] = scale * np.hypot(prior_size, SMALLEST_BEND) / prior_size
    return replace(model, root=model.root * factor), c
