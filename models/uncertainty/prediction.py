"""Predicted volumetric error with its uncertainty at any point and for any tool, by the law of propagation (GUM 5).

The uncertainty decides what may be compensated (`compensable_mask`). `unobserved_mm` estimates the error that no reading shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import term_motions
from abbe.models.geometry.chain import design
from abbe.models.geometry.field import Lines, field_mm, grid_lines
from abbe.models.geometry.volume import RigidFree, rigid_at, rigid_fit, unit_deviation
from abbe.models.machine import with_tool
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.coverage import PROBABILITY, coverage_factor, effective_dof, vector_factor
from abbe.models.uncertainty.on_grid import SHORTEST, grid_covariances
from abbe.models.uncertainty.sources import SOURCE_TEXTS, ErrorSources

NO_TRACE_SIGMA = 0.3
"""A change of the terms leaves no trace if, at typical size, it moves all readings together by less than this many standard deviations."""


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """One source: rms length of the error vector that it causes, mm, and its share of the total variance, 0 to 1."""

    name: str
    text: str
    u_mm: float
    share: float


@dataclass(frozen=True)
class Budget:
    """Uncertainty budget of one or more points: lines, largest first, and their total.

    ``u_mm``: rms length of the error of the predicted vector, the root sum of squares of the lines. ``expanded_mm``: largest expanded
    uncertainty of a component at these points, with its coverage factor.
    """

    lines: tuple[BudgetLine, ...]
    u_mm: float
    expanded_mm: float
    coverage_factor: float
    probability: float

    def line(self, name: str) -> BudgetLine:
        """Return the line of a source by name; KeyError if there is none."""
        for line in self.lines:
            if line.name == name:
                return line
        raise KeyError(name)

    def text(self) -> str:
        """Return the budget as a text table in micrometres."""
        rows = [f"{'source':<72}{'u, um':>8}{'share':>8}"]
        rows += [f"{line.text:<72}{1e3 * line.u_mm:8.3f}{line.share:8.1%}" for line in self.lines]
        rows.append(f"{'together':<72}{1e3 * self.u_mm:8.3f}{1.0:8.1%}")
        rows.append(f"largest expanded uncertainty of a component: {1e3 * self.expanded_mm:.3f} um (k = {self.coverage_factor:.2f})")
        return "\n".join(rows)


def budget_over(prediction: Prediction) -> Budget:
    """Budget of the mean variance over all predicted points, that is, of the rms uncertainty. Points should be a grid over the volume."""
    return _budget(prediction, np.arange(len(prediction.points_mm)))


def worst_point(prediction: Prediction) -> int:
    """Index of the point with the largest uncertainty of the vector."""
    return int(np.argmax(prediction.u_vector_mm))


def _budget(prediction: Prediction, points: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Budget:
    variance: F1 = prediction.variance_mm2[:, points].sum(axis=2).mean(axis=1)
    total = float(variance.sum())
    order = np.argsort(-variance, kind="stable")
    lines = tuple(
        BudgetLine(
            prediction.names[i],
            SOURCE_TEXTS[prediction.names[i]],
            float(np.sqrt(variance[i])),
            float(variance[i] / total) if total else 0.0,
        )
        for i in order
    )
    expanded, k = prediction.expanded_mm[points], prediction.coverage_factor[points]
    widest = np.unravel_index(int(np.argmax(expanded)), expanded.shape)
    return Budget(lines, float(np.sqrt(total)), float(expanded[widest]), float(k[widest]), prediction.probability)


CHUNK_POINTS = 2000
"""Points processed at once: their design (3 x 300 numbers a point) stays below 15 MB."""


@dataclass(frozen=True)
class Prediction:
    """Predicted deviation (mean of both directions of motion) at m points, tool relative to workpiece.

    Attributes
    ----------
    points_mm, deviation_mm : array, shape (m, 3)
    covariance_mm2 : array, shape (m, 3, 3)
    names : tuple of str
        The sources (`abbe.models.uncertainty.sources.SOURCE_TEXTS`).
    variance_mm2 : array, shape (sources, m, 3)
        Contribution of each source to the variance of each component; they sum to the diagonal of ``covariance_mm2``.
    dof : array, shape (m, 3)
        Effective degrees of freedom (Welch-Satterthwaite).
    probability : float
        Coverage probability of the expanded uncertainties.
    """

    points_mm: F2
    deviation_mm: F2
    covariance_mm2: F3
    names: tuple[str, ...]
    variance_mm2: F3
    dof: F2
    probability: float

    @property
    def u_mm(self) -> F2:
        """Standard uncertainty of each component, shape (m, 3)."""
        return np.asarray(np.sqrt(np.einsum("mii->mi", self.covariance_mm2)))

    @property
    def u_vector_mm(self) -> F1:
        """Rms length of the prediction's error vector, shape (m,): root of the sum of the three variances."""
        return np.asarray(np.sqrt(np.einsum("mii->m", self.covariance_mm2)))

    @property
    def coverage_factor(self) -> F2:
        """k of each component, from its degrees of freedom, shape (m, 3)."""
        return coverage_factor(self.dof, self.probability)

    @property
    def expanded_mm(self) -> F2:
        """Expanded uncertainty U = k u of each component, shape (m, 3)."""
        return np.asarray(self.coverage_factor * self.u_mm)

    @property
    def expanded_vector_mm(self) -> F1:
        """Longest half-axis of the ellipsoid that holds the whole vector with the coverage probability, shape (m,).

        Many degrees of freedom are assumed. The result is then larger than the expanded uncertainty of any component.
        """
        widest = np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance_mm2)[:, -1], 0.0))
        return np.asarray(vector_factor(3, self.probability) * widest)

    def along(self, direction: F2) -> tuple[F1, F1]:
        """Deviation along unit vectors, shape (3,) or (m, 3), and its standard uncertainty, mm, shape (m,) each."""
        d = np.broadcast_to(direction, self.deviation_mm.shape)
        u = np.sqrt(np.einsum("mi,mij,mj->m", d, self.covariance_mm2, d))
        return np.einsum("mi,mi->m", d, self.deviation_mm), u


def predict_deviation(
    sources: ErrorSources,
    points_mm: F2,
    *,
    tool_mm: F1 | None = None,
    frame: RigidFree | None = None,
    probability: float = PROBABILITY,
) -> Prediction:
    """Deviation and uncertainty at commanded positions.

    Parameters
    ----------
    sources : ErrorSources
        Error sources of the campaign's solution (`abbe.models.uncertainty.sources.error_sources`).
    points_mm : array, shape (m, 3)
    tool_mm : array, shape (3,), optional
        Vector from the spindle reference to the functional point; None: the machine's own tool.
    frame : RigidFree, optional
        None: the machine's own frame, where positioning and angles are zero at the start of the strokes (docs/explanation/conventions.md).
        To compare maps with each other or with a measured part, use a rigid-free frame.
    probability : float

    Raises
    ------
    ValueError
        Points of another shape, or not finite.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"prediction: points_mm must be finite numbers of shape (m, 3), got shape {points.shape}")
    lines = grid_lines(points)
    if lines is not None and min(line.size for line in lines) >= SHORTEST:
        deviation, covariance, variance = _on_grid(sources, points, lines, tool_mm, frame)
    else:
        deviation, covariance, variance = _one_by_one(sources, points, tool_mm, frame)
    dof = np.array([s.dof for s in sources.sources])
    effective = effective_dof(variance.reshape(len(dof), -1), dof).reshape(deviation.shape)
    return Prediction(points, deviation, covariance, tuple(s.name for s in sources.sources), variance, effective, probability)


def propagated_covariance(per_unit: F3, factor: F2) -> F3:
    """Covariance of vectors that depend linearly on coefficients with covariance ``factor factor^T`` (GUM eq 13), shape (m, 3, 3).

    Parameters
    ----------
    per_unit : array, shape (m, 3, p)
        Vector per unit of each coefficient.
    factor : array, shape (p, q)
    """
    m, k, p = per_unit.shape
    influence = (per_unit.reshape(m * k, p) @ factor).reshape(m, k, -1)
    return np.asarray(influence @ np.swapaxes(influence, 1, 2))


def _one_by_one(sources: ErrorSources, points: F2, tool_mm: F1 | None, frame: RigidFree | None) -> tuple[F2, F3, F3]:
    parts = []
    for i in range(0, max(len(points), 1), CHUNK_POINTS):
        d = unit_deviation(sources.solution.machine, sources.terms, points[i : i + CHUNK_POINTS], tool_mm, frame)
        propagated = np.stack([propagated_covariance(d, factor) for factor in _factors(sources)])
        parts.append((d @ sources.coefficients, *_together(sources, propagated)))
    deviation, covariance = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    return deviation, covariance, np.concatenate([p[2] for p in parts], axis=1)


def _on_grid(sources: ErrorSources, points: F2, lines: Lines, tool_mm: F1 | None, frame: RigidFree | None) -> tuple[F2, F3, F3]:
    """Return deviation, covariance and variance by source on a full grid, from tables of its lines (`abbe.models.uncertainty.on_grid`)."""
    machine, terms, coefficients = with_tool(sources.solution.machine, tool_mm), sources.terms, sources.coefficients
    deviation = field_mm(machine, lambda at: term_motions(terms, coefficients, at, machine.stroke_mm), points)
    if frame is not None:
        at_reference = design(machine, terms, frame.reference_mm) @ coefficients
        deviation -= rigid_at(points, frame.reference_mm) @ rigid_fit(frame, at_reference)[:, 0]
    covariance: F3 = np.empty((len(points), 3, 3))
    variance: F3 = np.empty((len(sources.sources), len(points), 3))

    def take(rows: slice, propagated: F4) -> None:
        covariance[rows], variance[:, rows] = _together(sources, propagated)

    grid_covariances(machine, terms, lines, frame, _factors(sources), take)
    return deviation, covariance, variance


def _factors(sources: ErrorSources) -> list[F2]:
    """The factor of every source, then the factors that are subtracted from some sources."""
    return [s.factor for s in sources.sources] + [s.subtracted for s in sources.sources if s.subtracted is not None]


def _together(sources: ErrorSources, propagated: F4) -> tuple[F3, F3]:
    """Sum over all sources: covariance of m points, shape (m, 3, 3), and variance by source, shape (sources, m, 3).

    ``propagated``: covariance of the points due to each of the `_factors`.
    """
    count = len(sources.sources)
    subtracted = iter(propagated[count:])
    covariance = np.zeros(propagated.shape[1:])
    variance = np.zeros((count, *propagated.shape[1:3]))
    for k, source in enumerate(sources.sources):
        share = propagated[k] + source.scatter_mm**2 * np.eye(3)
        if source.subtracted is not None:
            share = _not_negative(share - next(subtracted))
        covariance += share
        variance[k] = np.einsum("mii->mi", share)
    return covariance, variance


def _not_negative(covariance: F3) -> F3:
    """Set negative eigenvalues to zero, shape (m, 3, 3), so that a source never makes a prediction more certain."""
    (a, b, c), (_, d, e), (_, _, f) = np.moveaxis(covariance, 0, 2)
    minor = a * d - b * b
    sure = (a > 0.0) & (minor > 0.0) & (minor * f + 2.0 * b * c * e - a * e * e - d * c * c > 0.0)  # Sylvester: all eigenvalues are
    value, vector = np.linalg.eigh(covariance[~sure])
    out: F3 = covariance.copy()
    out[~sure] = (vector * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(vector, 1, 2)
    return out


def unobserved_directions(solution: JointSolution) -> F2:
    """Return q combinations of the smooth terms, of typical size, that leave no trace in any reading, shape (terms, q), mm and rad.

    Lost motion and set-up unknowns are first marginalised with their priors.
    """
    n = len(solution.terms)
    typical = term_prior_sd(solution.machine, solution.terms, Priors())
    own, other = solution.information[:n, :n], solution.information[n:, n:]
    across = solution.information[:n, n:]
    taken = scipy.linalg.solve(other + np.diag(solution.prior_sd[n:] ** -2.0), across.T, assume_a="pos")
    left = (own - across @ taken) * np.outer(typical, typical)
    values, vectors = scipy.linalg.eigh(0.5 * (left + left.T))
    return np.asarray(typical[:, None] * vectors[:, values < NO_TRACE_SIGMA**2])


def unobserved_mm(
    solution: JointSolution, points_mm: F2, frame: RigidFree, tool_mm: F1 | None = None, *, projection: F2 | None = None
) -> F1:
    """Return the rms length of the deviation that no reading shows, if errors have typical sizes, at points (m, 3), mm, shape (m,).

    ``projection``: matrix of the coefficients, shape (terms, terms), if only a part of the map is used (`abbe.models.uncertainty.scales`).
    """
    hidden = unobserved_directions(solution)
    hidden = hidden if projection is None else projection @ hidden
    if not hidden.shape[1]:
        return np.zeros(len(points_mm))
    moved = unit_deviation(solution.machine, solution.terms, points_mm, tool_mm, frame) @ hidden
    return np.asarray(np.sqrt(np.einsum("mcq,mcq->m", moved, moved)))


@dataclass(frozen=True)
class CompensableMask:
    """Components and points whose predicted deviation may be compensated (`compensable_mask`).

    Attributes
    ----------
    components : array of bool, shape (m, 3)
    points : array of bool, shape (m,)
    coverage_factor : array, shape (m,)
        Coverage factor k used for each point.
    """

    components: NDArray[np.bool_]
    points: NDArray[np.bool_]
    coverage_factor: F1

    @property
    def share(self) -> float:
        """Fraction of the points that may be compensated, 0 to 1."""
        return float(self.points.mean())

    def text(self) -> str:
        """Return one sentence on the points that are not compensated."""
        left = int((~self.points).sum())
        if left == 0:
            return "The deviation is larger than its uncertainty everywhere."
        k = np.median(self.coverage_factor)
        return f"At {left} of {self.points.size} points the uncertainty (k = {k:.2f}) exceeds the error; these are not compensated."


def compensable_mask(prediction: Prediction, *, k: float | None = None, smallest_mm: float = 0.0) -> CompensableMask:
    """Points and components of a predicted deviation that may be compensated: where the uncertainty does not exceed the error.

    A component of the deviation may be compensated where its size exceeds its expanded uncertainty, |d| > U = k u; with k of 95 % its sign
    is then known. A point may be compensated where the deviation's length exceeds the expanded uncertainty along the deviation itself,
    |d| > k sqrt(e^T C e), e = d / |d|. A smaller error may have the other sign, and a correction would then double it.

    Parameters
    ----------
    prediction : Prediction
        Prediction in the frame of the correction. For a map this is the rigid-free frame (`abbe.models.geometry.volume`); otherwise a
        displacement of the whole workpiece would be included, which is not an error.
    k : float, optional
        Coverage factor; default: that of the prediction's own probability and degrees of freedom.
    smallest_mm : float
        Deviations below this are not worth a correction, however well they are known (the control's resolution).

    Raises
    ------
    ValueError
        k is not positive or ``smallest_mm`` negative.
    """
    if (k is not None and not k > 0) or smallest_mm < 0:
        raise ValueError("compensable mask: k must be positive and smallest_mm 0 or more")
    d = prediction.deviation_mm
    per_component = prediction.coverage_factor if k is None else np.full(d.shape, k)
    components = (np.abs(d) > per_component * prediction.u_mm) & (np.abs(d) > smallest_mm)
    length = np.linalg.norm(d, axis=1)
    along = d / np.where(length > 0, length, 1.0)[:, None]
    _, u = prediction.along(along)
    per_point = _along_factor(prediction, along) if k is None else np.full(len(d), k)
    points = (length > per_point * u) & (length > smallest_mm)
    return CompensableMask(components, points, per_point)


def _along_factor(prediction: Prediction, along: NDArray[np.float64]) -> F1:
    """Coverage factor along each deviation, for the fewest degrees of freedom of its components that are not zero."""
    dof = np.where(np.abs(along) > 1e-9, prediction.dof, np.inf).min(axis=1)
    return coverage_factor(dof, prediction.probability or PROBABILITY)
