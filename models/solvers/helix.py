"""Ball-bar helix solution with the six linear parameters and the set-up unknowns (Yang and Kim eq (4)-(9); math.md 4.2 to 4.5).

The paper fits six parameters and takes the mounting as perfect: 10 um of cup offset then fakes about 100 urad (math.md 4.5). The default
here is the ten-parameter fit: scales EXX.1 EYY.1 EZZ.1 (mm/mm), squareness C0Y B0Z A0Z (rad), cup offset (mm), bar length error (mm).
One helix cannot tell a common scale from the bar's length: the bar's stated length uncertainty is the prior that closes the gap, and the
solution says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.arrays import F1, F2
from models.solvers.identifiability import Identifiability, analyse
from models.solvers.least_squares import Estimate, solve_map

Unknowns = Literal["six", "nine", "ten"]
LINEAR = ("EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z")
SETUP = ("offset_x", "offset_y", "offset_z", "bar_length")


@dataclass(frozen=True)
class HelixSolution:
    """Estimate, what it was seen from, and the rank of the data alone."""

    estimate: Estimate
    identifiability: Identifiability
    unknowns: Unknowns


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
    """Linearised change of the bar length per unit of each unknown, shape (n, 6 | 9 | 10)."""
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
    """Six scale and squareness parameters from helices about one centre.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Commanded workpiece coordinates (Yang's machine reads Z of its cross slide: z = -z(slide), math.md 4.1).
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
        Fewer readings than unknowns, or shapes disagree.
    """
    count = {"six": 6, "nine": 9, "ten": 10}[unknowns]
    if len(deviation_mm) < count:
        raise ValueError(f"helix: {len(deviation_mm)} readings cannot carry {count} unknowns")
    names = (LINEAR + SETUP)[:count]
    a = helix_design(points_mm, centre_mm, unknowns)
    prior = np.full(count, np.inf)
    if unknowns == "ten":
        prior[9] = u_length_mm
    sigma = np.full(len(deviation_mm), sigma_mm)
    theta, y = np.zeros(count), deviation_mm
    d = points_mm - centre_mm
    estimate: Estimate | None = None
    for _ in range(1 if unknowns == "six" else 4):  # the paper's fit is linear; a cup offset bends the sphere
        y = deviation_mm - _exact(d, radius_mm, theta) + a @ theta
        estimate = solve_map(names, a, y, sigma, prior)
        theta = estimate.theta
    assert estimate is not None
    wider = _demanded_variance(estimate)
    if wider > 1.0:  # a refit, so that the bar length's prior keeps its own width
        estimate = solve_map(names, a, y, sigma * np.sqrt(wider), prior)
    return HelixSolution(estimate, analyse(names, a), unknowns)


def _demanded_variance(estimate: Estimate) -> float:
    """How much more variance than stated the misfit demands: what six linear parameters cannot follow is no white noise.

    Neighbouring residuals of a real machine are alike, so n readings are worth n (1 - r) / (1 + r), r their correlation at lag one.
    """
    left = estimate.residual - estimate.residual.mean()
    power = float(left @ left)
    r = float(np.clip(left[1:] @ left[:-1] / power, 0.0, 0.999)) if power > 0 else 0.0
    return float(estimate.chi2 / estimate.dof * (1 + r) / (1 - r))


def _exact(d: F2, radius_mm: float, theta: F1) -> F1:
    """Bar length minus radius for given parameters, without linearisation."""
    offset = theta[6:9] if theta.size > 6 else np.zeros(3)
    length = theta[9] if theta.size > 9 else 0.0
    tip = d + linear_field(d) @ theta[:6] - offset
    return np.asarray(np.linalg.norm(tip, axis=1) - radius_mm + length)
