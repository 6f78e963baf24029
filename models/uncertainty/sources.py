"""Error sources of a campaign's solution: each input and its influence on the solution (GUM 5.1).

The estimate is linear in its inputs, theta = C A^T W y + C P^-1 m: readings y with weights W, prior means m with variances P,
posterior covariance C. So the covariance splits exactly, C = C A^T W A C + C P^-1 C: into the noise of each instrument and the prior of
each unknown (the bar's calibrated length, the set-ups, the typical size of errors). Inputs that the solver does not use are added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import SMOOTH_ORDER, Term, smooth_terms
from abbe.models.machine import AXES
from abbe.models.solvers.components import KINDS
from abbe.models.solvers.joint import JointSolution, kept
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import run_design
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.inputs import StatedInputs


def variances(sources: ErrorSources, per_unit: F2) -> F1:
    """Variance of each of m results, shape (m,), without the scatter of a single approach.

    Parameters
    ----------
    sources : ErrorSources
    per_unit : array, shape (m, len(sources.terms))
        Result per unit of each coefficient, including the orders above the solution's.
    """
    total = np.zeros(len(per_unit))
    for s in sources.sources:
        share = np.sum((per_unit @ s.factor) ** 2, axis=1)
        if s.subtracted is not None:
            share = np.maximum(share - np.sum((per_unit @ s.subtracted) ** 2, axis=1), 0.0)
        total += share
    return total


def joint_factor(sources: ErrorSources, per_unit: F2) -> F2:
    """Factor F of the joint covariance F F^T of m results, shape (m, q), for correlated draws; ``per_unit`` as in `variances`.

    The source ``estimated_sizes`` is clipped so that it never makes a combination of these results more certain.
    """
    turn, small = scipy.linalg.qr(per_unit, mode="economic") if len(per_unit) > per_unit.shape[1] else (None, per_unit)
    total = np.zeros((len(small), len(small)))
    for s in sources.sources:
        plus = small @ s.factor
        share = plus @ plus.T
        if s.subtracted is not None:
            subtracted = small @ s.subtracted
            root = _root(share - subtracted @ subtracted.T)
            share = root @ root.T
        total += share
    found = _root(total)
    return found if turn is None else np.asarray(turn @ found)


def approach_variance_mm2(sources: ErrorSources) -> float:
    """Variance that a single approach of a point adds to each component; 0 unless `StatedInputs.single_approach` is set."""
    return float(sum(s.scatter_mm**2 for s in sources.sources))


def _root(covariance: F2) -> F2:
    """Factor of the covariance with negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


@dataclass(frozen=True)
class Response:
    """Design, weights and covariance of one solution; noise and priors have the sizes that the solver estimated.

    Attributes
    ----------
    design : array, shape (n, p)
        Reading per unit of each unknown, all runs.
    weight : array, shape (n,)
        Weight of each reading, 1/mm^2: one over its variance, reduced for outliers and correlated neighbours; 0 for a rejected reading.
    kind : array of str, shape (n,)
        Instrument of each reading.
    covariance : array, shape (p, p)
        Posterior covariance if these sizes are exact: (A^T W A + P^-1)^-1.
    pull : array, shape (p, p)
        Change of every unknown per standard deviation of each independent part of the prior (`prior_factor`): pull pull^T is the prior's
        share C P^-1 C.
    widening : array, shape (p, p)
        Covariance of the solution minus ``covariance``, because the sizes are uncertain, too. It can be negative in some directions.
    dof : float
        Degrees of freedom of all residuals together.
    """

    design: F2
    weight: F1
    kind: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    covariance: F2
    pull: F2
    widening: F2
    dof: float

    def of_readings(self, error_mm: F1) -> F1:
        """Change of every unknown if each reading has the error ``error_mm`` (n,): C A^T W e, shape (p,)."""
        return np.asarray(self.covariance @ (self.design.T @ (error_mm * self.weight)))

    def noise_factor(self, variance_mm2: F1 | None, mask: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> F2:
        """Factor of the covariance that independent errors of some readings give the unknowns, shape (p, p).

        ``variance_mm2``: variance of each reading, shape (n,); None: one over its weight. ``mask``: the readings with errors.
        """
        size = np.sqrt(self.weight) if variance_mm2 is None else np.sqrt(variance_mm2) * self.weight
        r = scipy.linalg.qr(self.design[mask] * size[mask, None], mode="r")[0][: self.design.shape[1]]
        return np.asarray(self.covariance @ r.T)

    def dof_of(self, kind: str) -> float:
        """Degrees of freedom of the noise estimate of one instrument: its part of `dof`, at least 1.

        Parts are proportional to the sum over the readings of one minus the leverage.
        """
        left = self._left
        total = float(left.sum())
        return max(1.0, self.dof * float(left[self.kind == kind].sum()) / total) if total > 0 else 1.0

    @cached_property
    def _left(self) -> F1:
        """One minus the leverage of each reading, 0 for a rejected one, shape (n,)."""
        leverage = self.weight * np.einsum("np,np->n", self.design @ self.covariance, self.design)
        return np.where(self.weight > 0, np.clip(1.0 - leverage, 0.0, 1.0), 0.0)

    @property
    def gain(self) -> F2:
        """K = C A^T W, shape (p, n): change of every unknown per mm of each reading."""
        return np.asarray(self.covariance @ (self.design * self.weight[:, None]).T)


@kept
def response(solution: JointSolution) -> Response:
    """Design, weights and covariance of a solution, from its own runs, set-up, weights and prior."""
    design = np.concatenate([run_design(solution.machine, solution.terms, run, solution.setup) for run in solution.data])
    kind = np.concatenate([np.full(run.deviation_mm.size, run.kind) for run in solution.data])
    root = prior_factor(solution.prior_root)
    normal = root.T @ solution.information @ root
    np.fill_diagonal(normal, normal.diagonal() + 1.0)
    low = scipy.linalg.cholesky(normal, lower=True)
    inner = scipy.linalg.solve_triangular(low, root.T, lower=True)
    pull = scipy.linalg.cho_solve((low, True), root.T).T  # C R^-T
    covariance = inner.T @ inner
    widening = solution.estimate.covariance - covariance
    for factor in solution.added.values():
        widening = widening - factor @ factor.T
    return Response(design, solution.weight_per_mm2, kind, covariance, pull, widening, solution.estimate.dof)


def prior_factor(root: F2) -> F2:
    """Return the lower triangular factor of root root^T: column j holds the part of unknown j that is independent of all before it."""
    scale = np.linalg.norm(root, axis=1)
    return np.asarray(scale[:, None] * scipy.linalg.qr((root / scale[:, None]).T, mode="r")[0].T)


# Uncertainty from error motions above the solution's order.
#
# A campaign is solved up to some Legendre order. Higher orders are small, but not zero: they disturb the estimate through the readings, and
# the prediction at a point lacks them. With phi the omitted coefficients (prior S of the same family as the solution's), B their design at
# the readings and G at the point, and D the solved terms' design at the point, the prediction is off by (D K B - G) phi. The residuals of
# the campaign constrain phi: its covariance is not S but (S^-1 + B^T (W - W A C A^T W) B)^-1, about the value that the residuals suggest.


@kept
def order_source(solution: JointSolution, orders_above: int) -> tuple[tuple[Term, ...], F2]:
    """Return the P terms of the solution and of the orders above it, and the factor (P, q) of the covariance due to the orders above.

    The prediction leaves out the orders above. The values that the residuals suggest for these orders do not correct the prediction; they
    count in full as uncertainty, as one more column of the factor.
    """
    above = omitted_terms(solution.terms, orders_above)
    terms = (*solution.terms, *above)
    if not above:
        return terms, np.zeros((len(terms), 0))
    n, r = len(solution.terms), response(solution)
    omitted = _design(solution, above)
    weighted = omitted * r.weight[:, None]
    carried = r.covariance @ (r.design.T @ weighted)  # K B
    curvature = omitted.T @ weighted - (weighted.T @ r.design) @ carried
    sd = omitted_prior_sd(solution, above)
    normal = np.eye(len(above)) + 0.5 * np.outer(sd, sd) * (curvature + curvature.T)
    lower = scipy.linalg.cholesky(normal, lower=True)
    root = sd[:, None] * scipy.linalg.solve_triangular(lower, np.eye(len(above)), lower=True).T
    residual = np.concatenate([fit.residual_mm for fit in solution.runs])
    asked = root @ (root.T @ (weighted.T @ residual))
    phi = np.concatenate([root, asked[:, None]], axis=1)
    return terms, np.concatenate([carried[:n] @ phi, -phi])


def chosen_order(solution: JointSolution) -> int:
    """Return the Legendre order that the data support; terms of the solution above it contribute only uncertainty."""
    return solution.order


def omitted_terms(terms: tuple[Term, ...], orders_above: int) -> tuple[Term, ...]:
    """Terms of the ``orders_above`` Legendre orders above the highest one of each error motion, or of the model if it lacks the motion.

    A motion with a rough part gets no further orders. Inside the stroke the next four orders would add 6 % to its variance, but at the
    ends, where every Legendre polynomial is 1 and its own orders are already twice as large as elsewhere, they would double the variance.
    """
    order = {t.motion: t.order for t in sorted(terms, key=lambda t: t.order) if t.order}
    model = max((v for v in order.values() if v <= SMOOTH_ORDER), default=0)
    candidates = smooth_terms(max(order.values(), default=0) + orders_above) if orders_above else ()
    last = [order.get(t.motion, model) for t in candidates]
    return tuple(t for t, k in zip(candidates, last, strict=True) if 0 < t.order - k <= orders_above and k <= SMOOTH_ORDER)


def omitted_prior_sd(solution: JointSolution, above: tuple[Term, ...]) -> F1:
    """Return the prior standard deviation of the omitted terms ``above``, shape (len(above),).

    The solver may have found this machine's errors larger or smaller than the documented priors. So the documented value of an omitted
    order is scaled as the solver scaled the highest solved order of the same motion.
    """
    documented = Priors()
    kept = term_prior_sd(solution.machine, solution.terms, documented)
    last: dict[str, tuple[int, float]] = {}
    for i, t in enumerate(solution.terms):
        if t.order and t.order >= last.get(t.motion, (0, 0.0))[0]:
            last[t.motion] = (t.order, float(solution.prior_sd[i] / kept[i]))
    scale = np.array([last[t.motion][1] if t.motion in last else 1.0 for t in above])
    return np.asarray(term_prior_sd(solution.machine, above, documented) * scale)


def _design(solution: JointSolution, above: tuple[Term, ...]) -> F2:
    rows = [run_design(solution.machine, above, run, solution.setup)[:, : len(above)] for run in solution.data]
    return np.concatenate(rows)


SOURCE_TEXTS = {
    "bar_noise": "sensor noise of the ball-bar (and what a smooth model cannot follow)",
    "laser_noise": "sensor noise of the laser (and what a smooth model cannot follow)",
    "artefact_noise": "repeatability of the probed points (and what a smooth model cannot follow)",
    "repeatability": "repeatability of the machine",
    "bar_length": "calibration of the bar's length",
    "bar_temperature": "temperature of the bar (assumed)",
    "wavelength": "calibration of the laser's wavelength (stated)",
    "setup": "set-up: cup, mirror, zero, drift, pose, form of the artefact, where the data leave them open",
    "scale_temperature": "temperature of the scales (assumed)",
    "model_order": "error motions of orders above the chosen one",
    "scale_drift": "scales that changed during the campaign",
    "table": "an unknown table that was in force (assumed of usual size)",
    "prior": "typical size of errors, where the data leave them open (assumed)",
    "estimated_sizes": "noise and typical sizes are themselves estimated",
}
"""Text of every source of a budget."""

FROM_READINGS = frozenset({"bar_noise", "laser_noise", "artefact_noise", "estimated_sizes"})
"""Sources whose size the campaign's own readings gave: type A evaluation (GUM 4.2)."""


LASER_SCALE = "laser_scale"
"""The solution's unknown for the wavelength, limited by its prior; for a solution without it, `StatedInputs.u_wavelength` is used."""


@dataclass(frozen=True)
class Source:
    """One source of uncertainty.

    Attributes
    ----------
    name : str
        A key of `SOURCE_TEXTS`.
    factor : array, shape (P, q)
        Effect of q independent inputs of unit variance on the coefficients of `ErrorSources.terms`: the source's covariance is
        ``factor factor^T``.
    dof : float
        Degrees of freedom of the variance; inf if it is stated.
    scatter_mm : float
        Additional standard deviation of each component at each point, mm.
    subtracted : array, shape (P, r), optional
        Factor of a covariance to be subtracted, only for ``estimated_sizes``. The difference is clipped so that it never makes a prediction
        more certain (`abbe.models.uncertainty.prediction`).
    """

    name: str
    factor: F2
    dof: float = float("inf")
    scatter_mm: float = 0.0
    subtracted: F2 | None = None

    @property
    def evaluation(self) -> Literal["A", "B"]:
        """Type of evaluation (GUM 4.2, 4.3): A from readings of the campaign or from repeats, B stated or assumed."""
        return "A" if self.name in FROM_READINGS or (self.name == "repeatability" and np.isfinite(self.dof)) else "B"


@dataclass(frozen=True)
class ErrorSources:
    """All sources of one solution.

    ``terms``: the terms of the solution, then those of the orders above it. ``coefficients``: their values, shape (len(terms),), zero for
    the orders above.
    """

    solution: JointSolution
    inputs: StatedInputs
    terms: tuple[Term, ...]
    coefficients: F1
    sources: tuple[Source, ...]

    def source(self, name: str) -> Source:
        """Return a source by name; KeyError if the campaign does not have it."""
        for s in self.sources:
            if s.name == name:
                return s
        raise KeyError(name)


def error_sources(solution: JointSolution, inputs: StatedInputs | None = None) -> ErrorSources:
    """Return the sources of uncertainty of a solution.

    Parameters
    ----------
    solution : JointSolution
    inputs : StatedInputs, optional
        Stated inputs; default: the documented ones.

    Returns
    -------
    ErrorSources
        With all stated inputs zero (`StatedInputs.without_stated_inputs`) the sources add up to ``solution.term_covariance``.
    """
    inputs = inputs or StatedInputs()
    terms, sources = _sources(solution, inputs)
    coefficients = np.concatenate([solution.coefficients, np.zeros(len(terms) - len(solution.terms))])
    return ErrorSources(solution, inputs, terms, coefficients, sources)


@kept
def _sources(solution: JointSolution, inputs: StatedInputs) -> tuple[tuple[Term, ...], tuple[Source, ...]]:
    """Return all terms, and the sources with their factors for these terms."""
    r = response(solution)
    n = len(solution.terms)
    found = [*_noise(r, inputs), *_priors(solution, r), *_calibration(solution, r, inputs), *_temperature(solution, inputs)]
    found += [Source(name, factor) for name, factor in solution.added.items()]
    if inputs.single_approach:
        found.append(Source("repeatability", np.zeros((n, 0)), inputs.repeatability_dof, inputs.repeatability_mm))
    terms, extra = order_source(solution, inputs.orders_above)
    above = len(terms) - n
    parts = [replace(s, factor=_padded(s.factor[:n], above)) for s in found]
    parts.append(Source("model_order", extra))
    plus, subtracted = _widening(r, n)
    wider = Source("estimated_sizes", _padded(plus, above), subtracted=_padded(subtracted, above))
    return terms, (*_merged(parts), wider)


def _padded(factor: F2, above: int) -> F2:
    """Append ``above`` rows of zeros, for the terms of omitted orders."""
    return np.pad(factor, ((0, above), (0, 0)))


def _merged(sources: list[Source]) -> list[Source]:
    """Merge sources of the same name and keep the fewest degrees of freedom."""
    out: dict[str, Source] = {}
    for s in sources:
        have = out.get(s.name)
        if s.factor.shape[1] == 0 and s.scatter_mm == 0.0:
            continue
        if have is None:
            out[s.name] = s
        else:
            factor = np.concatenate([have.factor, s.factor], axis=1)
            out[s.name] = Source(s.name, factor, min(have.dof, s.dof), float(np.hypot(have.scatter_mm, s.scatter_mm)))
    return [Source(s.name, _compressed(s.factor), s.dof, s.scatter_mm) for s in out.values()]


def _compressed(factor: F2) -> F2:
    """Return a factor of the same covariance with no more columns than rows."""
    if factor.shape[1] <= factor.shape[0]:
        return factor
    return np.asarray(scipy.linalg.qr(factor.T, mode="r")[0][: factor.shape[0]].T)


def _noise(r: Response, inputs: StatedInputs) -> list[Source]:
    """Return the noise of each instrument's readings without the machine's repeatability, and this repeatability as a separate source."""
    out = []
    everywhere = np.ones(r.weight.size, dtype=np.bool_)
    variance = 1.0 / np.where(r.weight > 0, r.weight, np.inf)
    share = np.minimum(inputs.repeatability_mm**2, variance)  # at most the readings' own variance
    for kind in KINDS:
        mask = r.kind == kind
        if mask.any():
            left = None if inputs.repeatability_mm == 0 else variance - share
            out.append(Source(f"{kind}_noise", r.noise_factor(left, mask), r.dof_of(kind)))
    if inputs.repeatability_mm > 0:
        out.append(Source("repeatability", r.noise_factor(share, everywhere), inputs.repeatability_dof))
    return out


def _widening(r: Response, n: int) -> tuple[F2, F2]:
    """Split `Response.widening` of the first n unknowns into factors of its positive and of its negative part.

    The widening already allows for the few degrees of freedom of the sizes, so its source gets infinitely many.
    """
    whole = r.widening[:n, :n]
    scale = np.sqrt(np.diag(r.covariance)[:n])
    value, vector = scipy.linalg.eigh(whole / np.outer(scale, scale))
    roots = scale[:, None] * vector * np.sqrt(np.abs(value))
    return roots[:, value > 0], roots[:, value < 0]


def _priors(solution: JointSolution, r: Response) -> list[Source]:
    """Return the priors of all unknowns as sources; a correlated unknown counts with its independent part (`prior_factor`)."""
    order = chosen_order(solution)
    above = {t.name for t in solution.terms if t.order > order}
    terms = {t.name for t in solution.terms}
    names = np.array(["model_order" if n in above else _prior_source(n, n in terms) for n in solution.estimate.names])
    groups = ("bar_length", "wavelength", "setup", "prior", "model_order")
    return [Source(s, r.pull[:, names == s]) for s in groups if (names == s).any()]


def _prior_source(name: str, is_term: bool) -> str:
    if is_term or name.startswith("backlash_"):
        return "prior"
    if name.startswith("bar_length"):
        return "bar_length"
    return "wavelength" if name == LASER_SCALE else "setup"


def _calibration(solution: JointSolution, r: Response, inputs: StatedInputs) -> list[Source]:
    """Return the errors that all readings of an instrument share: the laser's wavelength, the bar's temperature."""
    out = []
    lasers = any(run.kind == "laser" for run in solution.data)
    if lasers and inputs.u_wavelength > 0 and LASER_SCALE not in solution.estimate.names:
        moved = np.concatenate([_travel(run) for run in solution.data])
        out.append(Source("wavelength", inputs.u_wavelength * r.of_readings(moved)[:, None]))
    u_bar = inputs.u_bar_temperature_k * inputs.bar_expansion_per_k
    if u_bar > 0 and any(run.kind == "bar" for run in solution.data):
        length = np.concatenate([np.full(run.deviation_mm.size, run.radius_mm or 0.0) for run in solution.data])
        out.append(Source("bar_temperature", u_bar * r.of_readings(length)[:, None]))
    return out


def _travel(run: RunData) -> F1:
    """Return the distance along the beam from the first record, mm, zero for a ball-bar; a wrong wavelength causes a proportional error."""
    if run.beam is None:
        return np.zeros(run.deviation_mm.size)
    return np.asarray((run.axes_mm - run.axes_mm[0]) @ run.beam)


def _temperature(solution: JointSolution, inputs: StatedInputs) -> list[Source]:
    """Return the uncertain scale temperature as a source: positioning error of each axis, alpha u_T times travel from the stroke's start.

    The term has Legendre order 1, so its value is twice the fraction of the stroke (`abbe.models.geometry.bases.term_values`).
    """
    slope = inputs.u_scale_temperature_k * inputs.scale_expansion_per_k
    if slope == 0.0:
        return []
    names = [t.name for t in solution.terms]
    factor = np.zeros((len(names), 3))
    for a, axis in enumerate(AXES):
        factor[names.index(f"E{axis}{axis}.1"), a] = slope * solution.machine.length_mm[a] / 2.0
    return [Source("scale_temperature", factor)]
