"""Ball-bar helix solution with the six linear parameters and the set-up unknowns (Yang and Kim eq (4)-(9)).

The paper fits six parameters and takes the mounting as perfect; 10 um of cup offset then looks like about 100 urad. The default here is
the ten-parameter fit: scales EXX.1 EYY.1 EZZ.1 (mm/mm), squareness C0Y B0Z A0Z (rad), cup offset (mm), bar length error (mm). One helix
cannot separate a common scale from the bar's length; the stated uncertainty of the bar's length, as prior, does. All figures of one helix
hold only for its own sphere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.least_squares import Identifiability, ParameterEstimate, analyse, solve_map
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors, bar_length_sd

Unknowns = Literal["six", "nine", "ten"]
LINEAR = ("EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z")
SETUP = ("offset_x", "offset_y", "offset_z", "bar_length")
CONDITION_LIMIT = 45.0
"""Limit of the condition number. By the angle law a full hemisphere (nine or ten unknowns, 63 to 1000 points) has 28 to 32 with three
turns, 58 to 68 with two, over 1900 with one. By the area law two turns have about 30 and cause no warning; only the recipe's minimum of
three turns excludes them.
"""
LOST = ("backlash_X", "backlash_Y", "backlash_Z")


@dataclass(frozen=True)
class HelixSolution:
    """Estimate of a helix fit, with the rank of its readings without priors.

    Attributes
    ----------
    estimate : ParameterEstimate
        Six parameters (mm/mm, rad; ISO signs, workpiece coordinates), set-up (mm), and with `fit_run` lost motion (mm).
    identifiability : Identifiability
        Rank and null space of the readings without any prior; the columns of the design are scaled to unit length.
    unknowns : "six" | "nine" | "ten"
        "six": parameters of the machine; "nine": also the cup offset; "ten": also the bar length.
    """

    estimate: ParameterEstimate
    identifiability: Identifiability
    unknowns: Unknowns

    @property
    def condition(self) -> float:
        """Condition number: largest over smallest singular value counted in the rank; inf if the rank is zero."""
        return self.identifiability.condition

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line if the condition number exceeds `CONDITION_LIMIT`: small noise then makes large errors of the parameters."""
        if self.condition <= CONDITION_LIMIT:
            return ()
        return (
            f"the fit is badly conditioned: condition number {self.condition:.0f}, the limit is {CONDITION_LIMIT:.0f}. Set-up, scales and "
            "squareness can hardly be distinguished; measure a helix of at least 3 turns over the whole hemisphere",
        )


def linear_field(points_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Deviation per unit of the six linear parameters at workpiece points, shape (n, 3, 6)."""
    x, y, z = points_mm.T
    out = np.zeros((points_mm.shape[0], 3, 6))
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = x, y, z
    out[:, 0, 3] = -y
    out[:, 0, 4] = z
    out[:, 1, 5] = -z
    return out


def helix_design(points_mm: F2, centre_mm: F1, unknowns: Unknowns = "ten") -> F2:
    """Linearised change of the bar's reading per unit of each unknown, shape (n, 6 | 9 | 10)."""
    d = points_mm - centre_mm
    n = d / np.linalg.norm(d, axis=1, keepdims=True)
    columns = [np.einsum("ni,nik->nk", n, linear_field(d))]
    if unknowns != "six":
        columns.append(-n)
    if unknowns == "ten":
        columns.append(np.ones((len(n), 1)))
    return np.concatenate(columns, axis=1)


def fit_helix(
    points_mm: F2,
    deviation_mm: F1,
    centre_mm: F1,
    radius_mm: float,
    *,
    sigma_mm: float,
    unknowns: Unknowns = "ten",
    u_length_mm: float = 0.0015,
) -> HelixSolution:
    """Fit six scale and squareness parameters to helices about one centre, in the paper's form, without lost motion (with it: `fit_run`).

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Commanded workpiece coordinates (Yang's machine reads Z of its cross slide: z = -z(slide)).
    deviation_mm : array, shape (n,)
        Bar length minus radius.
    centre_mm, radius_mm : array (3,), float
        Nominal cup position and bar length.
    sigma_mm : float
        Standard uncertainty of one reading.
    unknowns : "six" | "nine" | "ten"
        ``six`` is the paper's fit (perfect mounting), ``nine`` adds the cup offset, ``ten`` the bar length (default).
    u_length_mm : float
        Standard uncertainty of the calibrated bar length: prior of ``bar_length``.

    Raises
    ------
    ValueError
        Fewer readings than unknowns, shapes disagree, or ``unknowns`` is not one of the three.

    Returns
    -------
    HelixSolution
        Its ``warnings`` name a badly conditioned fit, e.g. of fewer than three turns.
    """
    counts = {"six": 6, "nine": 9, "ten": 10}
    if unknowns not in counts:
        raise ValueError(f"helix: unknowns {unknowns!r} must be 'six', 'nine' or 'ten'")
    if np.ndim(points_mm) != 2 or np.shape(points_mm) != (np.size(deviation_mm), 3) or np.ndim(deviation_mm) != 1:
        raise ValueError(f"helix: points of shape {np.shape(points_mm)} do not fit readings of shape {np.shape(deviation_mm)}")
    count = counts[unknowns]
    names = (LINEAR + SETUP)[:count]
    prior = np.array([np.inf] * 9 + [u_length_mm])[:count]
    task = _HelixTask(names, points_mm - centre_mm, radius_mm, helix_design(points_mm, centre_mm, unknowns), prior)
    return HelixSolution(_fit(task, deviation_mm, np.full(len(deviation_mm), sigma_mm)), analyse(names, task.a), unknowns)


def fit_run(run: RunData, *, sigma_mm: float, priors: Priors | None = None) -> HelixSolution:
    """Ten-parameter solution of one ball-bar run with the run's own bar length uncertainty, and lost motion as nuisance.

    Scales and squareness describe the machine ABOUT THIS SPHERE ONLY (local least-squares slopes), not over its volume. In a helix run in
    one direction, different lost motions of X and Y look like squareness (2 um at 165 mm: about 10 urad of C0Y), so the three lost motions
    are unknowns within their prior. Errors that the model cannot follow widen all uncertainties (`_demanded_variance`).

    Parameters
    ----------
    run : RunData
        A ball-bar run, averaged or not.
    sigma_mm : float
        Standard uncertainty of one raw reading.

    Raises
    ------
    ValueError
        Not a ball-bar run, or fewer readings than unknowns.
    """
    if run.centre_mm is None or run.radius_mm is None:
        raise ValueError(f"run {run.label}: only a ball-bar run can be solved as a helix")
    priors = priors or Priors()
    ten = helix_design(run.axes_mm, run.centre_mm)
    d = run.axes_mm - run.centre_mm
    lost = -0.5 * run.sign * d / np.linalg.norm(d, axis=1, keepdims=True)
    length = bar_length_sd(run.u_length_mm, run.length_calibrated, priors)
    prior = np.array([np.inf] * 9 + [length] + [priors.backlash_mm] * 3)
    task = _HelixTask(LINEAR + SETUP + LOST, d, run.radius_mm, np.concatenate([ten, lost], axis=1), prior)
    estimate = _fit(task, run.deviation_mm, sigma_mm / np.sqrt(run.weight_n))
    return HelixSolution(estimate, analyse(LINEAR + SETUP, ten), "ten")


@dataclass(frozen=True)
class _HelixTask:
    """A helix fit: names of the unknowns, points relative to the nominal cup, bar length, design and prior standard deviations."""

    names: tuple[str, ...]
    d_mm: F2
    radius_mm: float
    a: F2
    prior_sd: F1


def _fit(task: _HelixTask, deviation_mm: F1, sigma: F1) -> ParameterEstimate:
    """Fit the exact bar length by Gauss-Newton and widen the covariance by the misfit."""
    if len(deviation_mm) < len(task.names):
        raise ValueError(f"helix: {len(deviation_mm)} readings are too few for {len(task.names)} unknowns")
    linear = task.names == LINEAR  # the paper's fit is linear; with a cup offset the reading is not
    theta, y = np.zeros(len(task.names)), deviation_mm
    estimate: ParameterEstimate | None = None
    for _ in range(1 if linear else 4):
        y = deviation_mm - _exact(task, theta) + task.a @ theta
        estimate = solve_map(task.names, task.a, y, sigma, task.prior_sd)
        theta = estimate.theta
    assert estimate is not None
    wider = _demanded_variance(estimate)
    if wider > 1.0:  # a refit, so that the priors keep their own width
        estimate = solve_map(task.names, task.a, y, sigma * np.sqrt(wider), task.prior_sd)
    return estimate


def _demanded_variance(estimate: ParameterEstimate) -> float:
    """Factor on the stated variance to explain the misfit, because errors that the linear model cannot follow are not white noise.

    Neighbouring residuals of a real machine are correlated (r at lag one), so n readings are worth n (1 - r) / (1 + r). The integrated
    autocorrelation covers less, because the fit has removed the slow part from the residuals. A curvature that cup offset and slopes absorb
    together leaves no residual and is not covered; on a hemisphere about Z this concerns A0Z and B0Z (tests/models/solvers/test_helix.py).
    """
    left = estimate.residual - estimate.residual.mean()
    power = float(left @ left)
    r = float(np.clip(left[1:] @ left[:-1] / power, 0.0, 0.999)) if power > 0 else 0.0
    return float(estimate.chi2 / estimate.dof * (1 + r) / (1 - r))


def _exact(task: _HelixTask, theta: F1) -> F1:
    """Bar reading for given parameters, mm, exact except for the lost motion, which stays linear."""
    offset = theta[6:9] if theta.size > 6 else np.zeros(3)
    length = theta[9] if theta.size > 9 else 0.0
    tip = task.d_mm + linear_field(task.d_mm) @ theta[:6] - offset
    return np.asarray(np.linalg.norm(tip, axis=1) - task.radius_mm + length + task.a[:, 10:] @ theta[10:])
