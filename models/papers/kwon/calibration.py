"""Kinematic calibration: estimate the geometric parameters of every leg from commands and CMM points.

Kwon's paper leaves this step open: it supposes that errors of the kinematic parameters cause the position errors (4.2), but fits a surface
to them. Here the 18 parameters are estimated (R, r, l, thb, thp, dz of three legs, `abbe.models.papers.kwon.kinematics`), together with the
unknown placement on the CMM. Each parameter has a stated prior; the result names the parameters that rest on it. If the points scatter more
than stated or contradict the prior, `weigh` widens the uncertainty of the points or of the prior, and the result reports the factors.

"Carried" directions of parameter space are those that the points determine better than the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.rotation import rotation_matrix
from abbe.models.papers.kwon.errors import NotSettled
from abbe.models.papers.kwon.frames import best_fit_errors, best_fit_frame, checked_frame, from_frame, into_frame, rms
from abbe.models.papers.kwon.kinematics import LEGS, PER_LEG, Geometry, forward, inverse, jacobian, parameter_design, parameter_names, poses
from abbe.models.solvers.least_squares import Combination, Identifiability, ParameterEstimate, analyse, project_out, solve_map

CONFLICT = 0.01
"""Probability below which the deviations contradict the stated prior."""
UNSEEN = 1e-9
"""Singular values below this share of the largest count as zero (as in abbe.models.solvers.least_squares)."""
SPATIAL = 3
"""Number of coordinates of a point."""
STRAY = 0.01
"""Probability that any point of a set without outliers is called outlying."""
FRAME_NAMES = ("shift x", "shift y", "shift z", "turn a", "turn b", "turn c")
PARAMETERS = parameter_names()
TOLERANCE_MM, TOLERANCE_RAD = 0.05, 0.5e-3
CARRIED = 0.5
ITERATIONS = 20
SHOWN = 10
SETTLED = 1e-6
"""A step below this share of the standard uncertainty ends the iteration."""


@dataclass(frozen=True, slots=True)
class PriorTest:
    """Whether the stated prior and the points contradict each other.

    Attributes
    ----------
    chi2 : float
        Sum of squares of the estimated deviations in the carried directions, each in units of the standard deviation expected from the
        stated prior and the noise.
    dof : int
        Number of carried directions. The prior of the others cannot be tested.
    p : float
        Probability of a larger chi2 if the true deviations came from the stated prior; 1 without carried directions.
    """

    chi2: float
    dof: int
    p: float

    @property
    def conflict(self) -> bool:
        """Whether p is below 0.01."""
        return self.p < CONFLICT


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of points and prior.

    Attributes
    ----------
    variance_factor : float
        Factor, 1 or more, on the variance of the points: the part of the misfit that no parameter can explain, over its degrees of freedom.
    prior_factor : float
        Common factor, 1 or more, on all prior standard deviations, since the points cannot test each of them alone. It brings ``test.chi2``
        down to dof or, if chi2 is at least twice the dof, to dof - 2 (dof / 2 if dof is below 4). That makes the factor larger, because a
        factor estimated from few directions is often too small.
    carried : int
        Number of carried directions, with both factors.
    test : PriorTest
        Test of the prior as stated, with the noise already scaled.
    """

    variance_factor: float
    prior_factor: float
    carried: int
    test: PriorTest


def weigh(design: F2, observed: F1, prior_sd: F1) -> Weights:
    """Estimate the weights from whitened, linear observations ``observed = design @ (theta, placement) + noise``.

    With the placement projected out and theta in units of its prior, every singular direction gives one number with the variance
    ``variance_factor + (prior_factor x singular value)^2``; the rest of the observations is pure noise.

    Parameters
    ----------
    design : array, shape (m, p + q)
        Design in units of the noise; the last q columns (placement) have no prior.
    observed : array, shape (m,)
    prior_sd : array, shape (p,)
    """
    own, free = design[:, : prior_sd.size] * prior_sd, design[:, prior_sd.size :]
    target = project_out(observed[:, None], free)[:, 0]
    u, s, _ = np.linalg.svd(project_out(own, free), full_matrices=False)
    determined = s > UNSEEN * s[0]
    u, s = u[:, determined], s[determined]
    along = u.T @ target
    left = target - u @ along
    dof = observed.size - int(np.linalg.matrix_rank(free)) - s.size if free.size else observed.size - s.size
    variance = max(1.0, float(left @ left) / dof) if dof > 0 else 1.0
    carried = s**2 > variance
    y2, s2 = along[carried] ** 2, s[carried] ** 2
    chi2, k = float((y2 / (variance + s2)).sum()), int(carried.sum())
    test = PriorTest(chi2, k, float(scipy.special.chdtrc(k, chi2)) if k else 1.0)
    factor = _prior_factor(y2, s2, variance)
    return Weights(variance, factor, int(((factor * s) ** 2 > variance).sum()), test)


def outlying_points(residual: F2) -> tuple[int, ...]:
    """Return the rows with outlying residuals; 99 of 100 sets of good points have none.

    Parameters
    ----------
    residual : array, shape (n, 3)
        Residuals in units of the stated uncertainty. If their median length is larger than expected, this length sets the scale.
    """
    length2 = (residual**2).sum(axis=1)
    scale = max(1.0, float(np.median(length2) / scipy.special.chdtri(SPATIAL, 0.5)))
    limit = float(scipy.special.chdtri(SPATIAL, STRAY / max(length2.size, 1)))
    return tuple(int(i) for i in np.flatnonzero(length2 > limit * scale))


def _prior_factor(y2: F1, s2: F1, variance: float) -> float:
    """Return the smallest prior factor, 1 or more, for which the sum of y^2 / (variance + factor^2 s^2) meets the target of `Weights`."""
    if y2.size == 0:
        return 1.0
    size, at_one = float(y2.size), float((y2 / (variance + s2)).sum())
    if at_one <= size:
        return 1.0
    # Changes gradually, so that an iteration cannot oscillate between two targets.
    target = size - min(2.0, 0.5 * size) * min(at_one / size - 1.0, 1.0)

    def excess(factor2: float) -> float:
        return float((y2 / (variance + factor2 * s2)).sum()) - target

    # s^2 is above the variance here: twice the factor that s^2 alone would need is always enough.
    return float(np.sqrt(scipy.optimize.brentq(excess, 1.0, 2.0 * at_one / target, xtol=1e-12, rtol=1e-12)))


# Commands and their CMM points, and the dependence of such points on parameters and placement.


@dataclass(frozen=True)
class PlaneReadings:
    """Commands and measured points; repeated visits are repeated rows.

    Parameters
    ----------
    lambda_mm : array, shape (n, 3)
        Commands of the drives.
    measured_mm : array, shape (n, 3)
        Ball centres in CMM coordinates.
    u_point_mm : float
        Standard uncertainty of one coordinate of one measured point.
    u_lambda_mm : float
        Standard uncertainty with which a drive reaches its command, independent from row to row (repeatability of the stage).

    Raises
    ------
    ValueError
        Shapes differ, u_point_mm is not positive or u_lambda_mm is negative.
    """

    lambda_mm: F2
    measured_mm: F2
    u_point_mm: float
    u_lambda_mm: float = 0.0

    def __post_init__(self) -> None:
        """Check shapes and uncertainties."""
        lam, measured = poses("lambda_mm", self.lambda_mm), poses("measured_mm", self.measured_mm)
        if lam.shape != measured.shape:
            raise ValueError(f"readings: {lam.shape[0]} commands do not fit {measured.shape[0]} measured points")
        if not (0.0 < self.u_point_mm < np.inf and 0.0 <= self.u_lambda_mm < np.inf):
            raise ValueError("readings: u_point_mm must be positive, u_lambda_mm must not be negative, and both must be finite")
        object.__setattr__(self, "lambda_mm", lam)
        object.__setattr__(self, "measured_mm", measured)


def point_design(geometry: Geometry, lambda_mm: F2, pivot_mm: F1 | None) -> F3:
    """Return the derivatives of the ball centre by the 18 parameters and, with a pivot, by shifts and turns of the placement.

    Base axes; shape (n, 3, 18), or (n, 3, 24) with a pivot.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm : array, shape (n, 3)
    pivot_mm : array, shape (3,), or None
        Base coordinates of the point through which the axes of the turns run; None if the placement is known.
    """
    p = forward(geometry, lambda_mm)
    design = parameter_design(geometry, lambda_mm, p)
    if pivot_mm is None:
        return design
    rigid = np.zeros((p.shape[0], 3, len(FRAME_NAMES)))
    rigid[:, :, :3] = np.eye(3)
    for k in range(3):
        rigid[:, :, 3 + k] = np.cross(np.eye(3)[k], p - pivot_mm)
    return np.concatenate([design, rigid], axis=2)


def whitened(geometry: Geometry, readings: PlaneReadings, frame: F2, pivot_mm: F1 | None) -> tuple[F2, F1]:
    """Return the design matrix (3n, 18 or 24) and the misfit (3n,) of the readings in units of their standard uncertainty.

    Each point has the covariance u_point^2 I + u_lambda^2 J J', J = dP/dlambda.
    """
    p = forward(geometry, readings.lambda_mm)
    j = jacobian(geometry, readings.lambda_mm, p)
    covariance = readings.u_point_mm**2 * np.eye(3) + readings.u_lambda_mm**2 * (j @ np.swapaxes(j, 1, 2))
    root = np.linalg.cholesky(covariance)
    design = np.linalg.solve(root, point_design(geometry, readings.lambda_mm, pivot_mm))
    misfit = np.linalg.solve(root, (into_frame(frame, readings.measured_mm) - p)[..., None])
    return design.reshape(-1, design.shape[2]), misfit.ravel()


def moved_frame(frame: F2, move: F1, pivot_mm: F1) -> F2:
    """Return the placement after a shift and a turn (mm, rad, base axes) about a pivot in base coordinates, shape (4, 4)."""
    step = np.eye(4)
    step[:3, :3] = rotation_matrix(move[None, 3:])[0]
    step[:3, 3] = pivot_mm + move[:3] - step[:3, :3] @ pivot_mm
    return frame @ step


@dataclass(frozen=True)
class KwonCalibration:
    """Result of `calibrate`.

    Attributes
    ----------
    geometry : Geometry
        Nominal plus estimated deviations.
    frame : array, shape (4, 4)
        From the base frame to the CMM: estimated, or as given.
    pivot_mm : array (3,) or None
        Point of the base frame about which the turns of ``frame`` are uncertain; None when the frame was given.
    estimate : ParameterEstimate
        Deviations from nominal (mm, rad) with covariance, named PARAMETERS. If the frame was unknown, FRAME_NAMES follow: increments about
        ``frame``, which are zero. Residuals and chi2 are in units of the stated uncertainty. The covariance includes ``variance_factor``
        and ``prior_factor``, and EVERY uncertainty is conditional on the prior.
    identifiability : Identifiability
        Rank of the 18 parameters in units of their priors, frame projected out; ``hidden``: combinations that leave no trace in the points.
    carried : int
        Number of carried directions.
    residual_mm : array, shape (n, 3)
        Measured minus modelled, CMM axes.
    prior_test : PriorTest
        Whether the points contradict the prior as it was stated.
    prior_factor : float
        Factor, 1 or more, by which all prior standard deviations were widened to explain the deviations in the carried directions. For the
        other directions no data can check the factor.
    outlying : tuple of int
        Rows of points that stand out from the others. They are not left out.
    """

    geometry: Geometry
    frame: F2
    pivot_mm: F1 | None
    estimate: ParameterEstimate
    identifiability: Identifiability
    carried: int
    residual_mm: F2
    prior_test: PriorTest
    prior_factor: float
    outlying: tuple[int, ...]

    @property
    def on_prior(self) -> tuple[str, ...]:
        """Parameters that the prior determines better than the points."""
        return tuple(name for name, share in zip(self.estimate.names, self.estimate.data_share, strict=True) if share < CARRIED)

    @property
    def statement(self) -> str:
        """Basis of the uncertainties, as text."""
        return "; ".join([*self._identified(), *self._warnings(), "every stated uncertainty is conditional on the prior"])

    def _identified(self) -> list[str]:
        n, identified = len(PARAMETERS), self.identifiability
        parts = [
            f"the points determine {identified.rank} of {n} combinations of parameters, and {self.carried} of them better than the prior",
            f"single values that rest on the prior: {', '.join(self.on_prior) or 'none'}",
        ]
        hidden = ", ".join(_combination(h) for h in identified.hidden)
        return [*parts, f"combinations that leave no trace and rest on the prior alone: {hidden}"] if hidden else parts

    def _warnings(self) -> list[str]:
        test, factor = self.prior_test, self.estimate.variance_factor
        warnings = []
        if test.conflict:
            warnings.append(
                f"the points CONTRADICT the prior (chi2 {test.chi2:.4g} with {test.dof} degrees of freedom, p = {test.p:.2g}): "
                "the machine deviates more than the prior allows"
            )
        if self.prior_factor > 1.0:
            warnings.append(f"all prior standard deviations were multiplied by {self.prior_factor:.3g} to explain these deviations")
        if factor > 1.0:
            times = f"{np.sqrt(factor):.3g}"
            warnings.append(f"the points scatter {times} times as much as stated, so their uncertainty was multiplied by {times}")
        if self.outlying:
            rows = ", ".join(str(i) for i in self.outlying[:SHOWN])
            more = f" and {len(self.outlying) - SHOWN} more" if len(self.outlying) > SHOWN else ""
            warnings.append(f"outlying point rows, not left out: {rows}{more}")
        return warnings

    def predict_mm(self, lambda_mm: F2) -> F2:
        """Return the ball centres for commands, in CMM coordinates, shape (n, 3), mm."""
        return from_frame(self.frame, forward(self.geometry, lambda_mm))

    def u_predict_mm(self, lambda_mm: F2) -> F2:
        """Return the standard uncertainty of `predict_mm` along the CMM axes, mm, shape (n, 3), from parameters and frame."""
        design = self.frame[:3, :3] @ point_design(self.geometry, poses("lambda_mm", lambda_mm), self.pivot_mm)
        return np.asarray(np.sqrt(np.einsum("ncp,pq,ncq->nc", design, self.estimate.covariance, design)))

    def corrected_lambda_mm(self, p_mm: F2) -> F2:
        """Return the commands that bring the real machine to positions in base coordinates, shape (n, 3); errors as in `inverse`."""
        return inverse(self.geometry, p_mm)


@dataclass(frozen=True, slots=True)
class ErrorLeft:
    """Length of the position errors (rms and maximum, mm) with the nominal and the calibrated geometry, rigid motion removed."""

    before_rms_mm: float
    before_max_mm: float
    after_rms_mm: float
    after_max_mm: float


def default_prior() -> F1:
    """Return prior standard deviations of R1 .. dz3 for ordinary manufacture and assembly, 0.05 mm and 0.5 mrad, shape (18,)."""
    return np.array([TOLERANCE_RAD if name.startswith("th") else TOLERANCE_MM for name in PARAMETERS])


def calibrate(nominal: Geometry, readings: PlaneReadings, prior_sd: F1 | None = None, frame: F2 | None = None) -> KwonCalibration:
    """Estimate the most probable parameters for normal priors about nominal, by Gauss-Newton on the exact forward solution.

    `weigh` widens noise and prior if the points demand it. ``prior_test`` and ``statement`` of the result report a contradiction between
    points and prior (p < 0.01).

    Parameters
    ----------
    nominal : Geometry
    readings : PlaneReadings
    prior_sd : array, shape (18,), optional
        Positive prior standard deviations of the deviations from nominal, in the order of PARAMETERS; default `default_prior`. A prior is
        always needed, because some combinations leave no trace in positions (R with r for theta_p = theta_b; dz with the frame's height).
    frame : array, shape (4, 4), optional
        Known placement, from the base frame to the CMM. Default: estimated, without a prior.

    Raises
    ------
    NotSettled
        The iteration does not converge.
    PoseError, CollinearPoints
        A command has no position (with the nominal geometry or during the iteration), or the points lie on a line and do not determine the
        placement.
    ValueError
        A prior is not positive, or the frame is not a rigid motion.
    """
    prior = default_prior() if prior_sd is None else np.asarray(prior_sd, dtype=np.float64)
    if prior.shape != (len(PARAMETERS),) or not (np.isfinite(prior).all() and (prior > 0.0).all()):
        raise ValueError(f"calibration: expected {len(PARAMETERS)} finite positive prior standard deviations, got shape {prior.shape}")
    nominal_p = forward(nominal, readings.lambda_mm)
    current_frame = best_fit_frame(nominal_p, readings.measured_mm) if frame is None else checked_frame("calibration: frame", frame)
    pivot = nominal_p.mean(axis=0) if frame is None else None
    theta = np.zeros(prior.size)
    for _ in range(ITERATIONS):
        estimate, weights = _step(_with(nominal, theta), readings, current_frame, pivot, (theta, prior))
        move = estimate.theta[prior.size :]
        step = np.concatenate([estimate.theta[: prior.size] - theta, move])
        theta = estimate.theta[: prior.size]
        current_frame = current_frame if pivot is None else moved_frame(current_frame, move, pivot)
        if (np.abs(step) <= SETTLED * np.sqrt(np.diag(estimate.covariance))).all():
            return _result(_with(nominal, theta), readings, current_frame, pivot, (estimate, prior, weights))
    raise NotSettled(f"calibration: no convergence after {ITERATIONS} steps; the points do not fit the nominal machine")


def error_left(nominal: Geometry, calibrated: Geometry, lambda_mm: F2, measured_mm: F2) -> ErrorLeft:
    """Return the position errors before and after calibration, at points that the calibration did not use.

    Parameters
    ----------
    nominal, calibrated : Geometry
        Each is placed by its own best fit to the measured points.
    lambda_mm, measured_mm : arrays, shape (n, 3)
        Commands and CMM points.
    """
    before = best_fit_errors(forward(nominal, lambda_mm), measured_mm)
    after = best_fit_errors(forward(calibrated, lambda_mm), measured_mm)
    return ErrorLeft(rms(before), _largest(before), rms(after), _largest(after))


def _with(nominal: Geometry, theta: F1) -> Geometry:
    return nominal.with_errors(dict(zip(PER_LEG, theta.reshape(len(PER_LEG), LEGS), strict=True)))


def _step(
    geometry: Geometry, readings: PlaneReadings, frame: F2, pivot: F1 | None, known: tuple[F1, F1]
) -> tuple[ParameterEstimate, Weights]:
    """Return a linearised fit about the present geometry and frame, weighted by `weigh`."""
    theta, prior = known
    design, misfit = whitened(geometry, readings, frame, pivot)
    free = design.shape[1] - prior.size
    names = PARAMETERS + (FRAME_NAMES if free else ())
    observed = misfit + design[:, : prior.size] @ theta
    weights = weigh(design, observed, prior)
    sd = np.concatenate([weights.prior_factor * prior, np.full(free, np.inf)])
    fit = solve_map(names, design, observed, np.full(misfit.size, np.sqrt(weights.variance_factor)), sd)
    # The noise is scaled already; `solve_map` would scale the prior too.
    covariance, chi2 = fit.covariance / fit.variance_factor, fit.chi2 * weights.variance_factor
    return replace(fit, covariance=covariance, chi2=chi2, variance_factor=weights.variance_factor), weights


def _result(
    geometry: Geometry, readings: PlaneReadings, frame: F2, pivot: F1 | None, fit: tuple[ParameterEstimate, F1, Weights]
) -> KwonCalibration:
    estimate, prior, weights = fit
    design, misfit = whitened(geometry, readings, frame, pivot)
    # The triangle of a QR decomposition has the same singular values and the same null space as all the rows.
    observed = np.asarray(np.linalg.qr(project_out(design[:, : prior.size], design[:, prior.size :]), mode="r"))
    residual = readings.measured_mm - from_frame(frame, forward(geometry, readings.lambda_mm))
    rank, stray = analyse(PARAMETERS, observed, typical=prior), outlying_points(misfit.reshape(-1, 3))
    found = (weights.carried, residual, weights.test, weights.prior_factor, stray)
    return KwonCalibration(geometry, frame, pivot, estimate, rank, *found)


def _combination(hidden: Combination) -> str:
    """Return the parameters of a hidden combination as text."""
    return " with ".join(hidden.members)


def _largest(errors_mm: F2) -> float:
    return float(np.linalg.norm(errors_mm, axis=1).max())
