"""Sequential step diagonals in the form of Wang's paper, eq (4) to (13).

`wang_eq7` is the published formula, which uses two diagonals per direction; `wang_four` is the least-squares form with all four. Both take
the mirrors as perfectly square to the beams; `abbe.models.solvers.joint` treats the tilts as unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.paths import DIAGONALS

ORDER = ("ppp", "npp", "pnp", "ppn")


def checked_increments(inc_mm: F1, what: str = "increments") -> F1:
    """Return the three increments (or travels), mm, as an array after a check.

    Raises
    ------
    ValueError
        They are not three finite numbers above zero.
    """
    inc = np.asarray(inc_mm, dtype=np.float64)
    if inc.shape != (3,) or not np.isfinite(inc).all() or not (inc > 0).all():
        raise ValueError(f"step diagonal: {what} X, Y, Z must be three positive numbers, got {inc_mm!r}")
    return inc


def increments(readings_mm: dict[str, F1], order: str = "XYZ") -> dict[str, F2]:
    """Normalised step readings q_s(a, j): sign of the axis times reading step, intervals counted from the axis' small end.

    The paper omits this normalisation: where a diagonal runs along an axis downwards, sign and sequence of its intervals are reversed.

    Parameters
    ----------
    readings_mm : dict of arrays (3 n + 1,)
        Outward readings of each diagonal, mm: displayed minus nominal displacement since the first record, positive = farther.
    order : str
        Step order, X, Y and Z once each.

    Returns
    -------
    dict of arrays (3 axes, n)
        Under the same names, mm.

    Raises
    ------
    ValueError
        Unknown ``order``, no diagonal, a diagonal other than ppp, npp, pnp, ppn, or records that are not 3 n + 1 with n of 1 or more.
    """
    if sorted(order) != ["X", "Y", "Z"]:
        raise ValueError(f"step diagonal: order {order!r} must name X, Y and Z once each")
    if not readings_mm:
        raise ValueError("step diagonal: no diagonal was given")
    out = {}
    for name, values in readings_mm.items():
        if name not in DIAGONALS:
            raise ValueError(f"step diagonal {name!r}: must be one of {', '.join(DIAGONALS)}")
        records = np.asarray(values, dtype=np.float64)
        if records.ndim != 1 or records.size < 4 or records.size % 3 != 1:
            raise ValueError(f"step diagonal {name}: records of shape {records.shape} are not (3 n + 1,) with n of 1 or more")
        step = np.diff(records)
        q = np.empty((3, step.size // 3))
        for k, letter in enumerate(order):
            a = "XYZ".index(letter)
            sign = DIAGONALS[name][a]
            series = sign * step[k::3]
            q[a] = series if sign > 0 else series[::-1]
        out[name] = q
    return out


def project_eq6(e_mm: F3, inc_mm: F1) -> dict[str, F2]:
    """Diagonal readings for given displacement errors, eq (4) to (6), normalised like `increments`: shape (3 axes, n) each, mm.

    Parameters
    ----------
    e_mm : array, shape (3, 3, n)
        E[i, a, j]: displacement error in direction i of interval j of axis a.
    inc_mm : array, shape (3,)
        Increments X, Y, Z.

    Raises
    ------
    ValueError
        Increments not positive.
    """
    inc_mm = checked_increments(inc_mm)
    n = inc_mm / np.linalg.norm(inc_mm)
    return {name: np.einsum("i,iaj->aj", np.array(DIAGONALS[name]) * n, e_mm) for name in ORDER}


def wang_eq7(q: dict[str, F2], inc_mm: F1) -> F3:
    """Displacement errors by Wang's printed formulas (7) and (8).

    The print has lost the coefficients of (4) to (8); they are derived anew here. Angular errors and mirror tilt enter as false errors
    (`abbe.models.papers.wang.squareness`, `abbe.models.papers.wang.model.tilt_bias_eq7`).

    Parameters
    ----------
    q : dict of arrays (3 axes, n)
        Normalised step readings of ppp, npp, pnp, ppn by `increments`, mm.
    inc_mm : array, shape (3,)
        Increments X, Y, Z, mm, positive.

    Returns
    -------
    array, shape (3, 3, n + 1), mm
        E[i, a, k]: error in direction i after k steps of axis a, from the axis' small end; actual minus nominal, machine coordinates.

    Raises
    ------
    ValueError
        Increments not positive, a diagonal missing, or their shapes differ.
    """
    inc_mm = checked_increments(inc_mm)
    _all_four(q)
    r = float(np.linalg.norm(inc_mm))
    p = q["ppp"]
    raw = np.stack([(p - q[ORDER[i + 1]]) * r / (2 * inc_mm[i]) for i in range(3)])
    return _cumulate(raw)


def wang_four(q: dict[str, F2], inc_mm: F1) -> F3:
    """`wang_eq7` by least squares over all four diagonals, with half the variance of (7); not in the paper.

    Parameters, result (shape (3, 3, n + 1), mm) and errors are those of `wang_eq7`. Uncertainty from noise: `u_wang_four`.
    """
    inc_mm = checked_increments(inc_mm)
    _all_four(q)
    r = float(np.linalg.norm(inc_mm))
    signs = np.array([DIAGONALS[s] for s in ORDER], dtype=np.float64)
    raw = np.stack([sum(signs[k, i] * q[s] for k, s in enumerate(ORDER)) * r / (4 * inc_mm[i]) for i in range(3)])
    return _cumulate(raw)


def u_wang_four(inc_mm: F1, n: int, u_reading_mm: float, u_scale: float = 0.0) -> F3:
    """Standard uncertainty of `wang_four` from reading noise and wavelength alone, shape (3, 3, n + 1), mm.

    One interval has R / (2 X) sigma_q with sigma_q = sqrt(2) sigma of a reading. The intervals of an axis share no reading, so k of them
    have sqrt(k) times as much. ``u_scale``, the relative uncertainty of the laser's wavelength, adds to E[a, a] only. Mirror tilts, angular
    errors and drift are biases of the method and NOT included.

    Raises
    ------
    ValueError
        Increments not positive.
    """
    inc_mm = checked_increments(inc_mm)
    r = float(np.linalg.norm(inc_mm))
    steps = np.arange(n + 1)
    out = np.empty((3, 3, n + 1))
    for i in range(3):
        noise = r / (2 * inc_mm[i]) * np.sqrt(2.0 * steps) * u_reading_mm
        out[i] = noise
        out[i, i] = np.hypot(noise, u_scale * inc_mm[i] * steps)
    return out


def demeaned(q: dict[str, F2]) -> dict[str, F2]:
    """Step readings less the mean of each series (axis and diagonal): Wang's remedy for mirror tilt (IV.C).

    This removes the tilt and with it all twelve slopes: the result of `wang_eq7` then has no scale and no squareness. The paper does not
    say so. ``q`` and the result: dict of arrays (3 axes, n), mm, normalised by `increments`.
    """
    return {name: np.asarray(values - values.mean(axis=1, keepdims=True)) for name, values in q.items()}


def closure_mm(q: dict[str, F2]) -> F2:
    """Closure ppp - npp - pnp - ppn per axis and interval, from the redundant fourth diagonal; not in the paper.

    The closure is zero for pure translations and shows mirror tilt; of angular errors it shows only the effect of one step.

    Parameters
    ----------
    q : dict of arrays (3 axes, n)
        Normalised step readings by `increments`, mm.

    Returns
    -------
    array, shape (3 axes, n), mm, signed as written.

    Raises
    ------
    ValueError
        A diagonal is missing, or their shapes differ.
    """
    _all_four(q)
    return np.asarray(q["ppp"] - q["npp"] - q["pnp"] - q["ppn"])


def _all_four(values: Mapping[str, F2 | float]) -> None:
    if missing := [name for name in ORDER if name not in values]:
        raise ValueError(f"step diagonal: {', '.join(missing)} missing; all four diagonals are needed")
    if len(shapes := {np.shape(values[name]) for name in ORDER}) > 1:
        raise ValueError(f"step diagonal: the four diagonals have different shapes {sorted(shapes)}; measure all with the same steps")


@dataclass(frozen=True, slots=True)
class SquarenessContrast:
    """Squareness errors, rad, obtuse positive, from the diagonals' end values; free of scale errors, but not of angular errors.

    ``u_xy``, ``u_xz``, ``u_yz``: standard uncertainties from the noise of the readings alone, rad.
    """

    theta_xy: float
    theta_xz: float
    theta_yz: float
    u_xy: float
    u_xz: float
    u_yz: float


def squareness_contrast(totals_mm: dict[str, float], length_mm: F1, u_total_mm: float = 0.0) -> SquarenessContrast:
    """Squareness from minimum-variance contrasts of the diagonals' end values, instead of Wang's (13).

    The result is free of SCALE errors only. Angular errors act as squareness: a yaw of X that grows by 50 µrad over its travel changes
    theta_xy by half of it, 25 µrad. The uncertainties include only the readings' noise. Erratum: (13) is valid only without scale errors.

    Parameters
    ----------
    totals_mm : dict of float
        Deviation at the end of ppp, npp, pnp, ppn, mm, displayed minus nominal.
    length_mm : array, shape (3,)
        Total travels X, Y, Z (not the increments), mm.
    u_total_mm : float
        Standard uncertainty of one total.

    Returns
    -------
    SquarenessContrast
        Obtuse positive as in (9) and (11); (12) and (13) are acute positive, i.e. the negative.

    Raises
    ------
    ValueError
        A diagonal is missing, travels are not three positive numbers, or the uncertainty is negative.
    """
    length_mm = checked_increments(length_mm, "travels")
    _all_four(totals_mm)
    if not u_total_mm >= 0:
        raise ValueError(f"squareness: the uncertainty of a total must be 0 or more, got {u_total_mm}")
    r = float(np.linalg.norm(length_mm))
    p, n, q, s = (totals_mm[k] for k in ORDER)
    x, y, z = (float(v) for v in length_mm)
    u = u_total_mm * r / 2
    return SquarenessContrast(
        -(p - n - q + s) * r / (4 * x * y),
        -(p - n + q - s) * r / (4 * x * z),
        -(p + n - q - s) * r / (4 * y * z),
        u / (x * y),
        u / (x * z),
        u / (y * z),
    )


def _cumulate(raw: F3) -> F3:
    return np.concatenate([np.zeros((3, 3, 1)), np.cumsum(raw, axis=2)], axis=2)
