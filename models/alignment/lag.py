"""Lag of a signal behind the machine: the time by which the expected signal is shifted to match the readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

COARSE = 201
ROUNDS = 12
SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class Lag:
    """Lag of a signal, s, positive if it is late, and its standard uncertainty ``u_s``. ``determined``: the readings suffice to find it."""

    lag_s: float
    u_s: float
    determined: bool


def fit_lag(t_s: F1, signal: F1, expected_s: F1, expected: F1, *, columns: F2 | None = None, search_s: float = 0.5) -> Lag:
    """Fit the lag of a signal behind the expected one by least squares: signal(t) = expected(t - lag) + columns @ unknowns.

    A coarse search finds the minimum and Gauss-Newton refines it. The uncertainty includes the autocorrelation of the residuals
    (Newey-West), so that drift and vibration do not make it too small.

    Parameters
    ----------
    t_s, signal : array, shape (n,)
        Times and values of the signal.
    expected_s, expected : array, shape (m,)
        Times and values of the signal without lag; interpolated linearly.
    columns : array, shape (n, k), optional
        Further components of the signal; default: a constant.
    search_s : float
        Largest lag in either direction.

    Raises
    ------
    ValueError
        Fewer than 10 values, or arrays of different lengths.
    """
    if t_s.size < 10 or signal.shape != t_s.shape or expected.shape != expected_s.shape:
        raise ValueError("lag: ten values or more are needed, each with its time")
    free = np.ones((t_s.size, 1)) if columns is None else columns
    basis = np.linalg.qr(free)[0]

    def without(v: F1) -> F1:
        return np.asarray(v - basis @ (basis.T @ v))

    def left(lag: float) -> F1:
        return without(signal - np.interp(t_s - lag, expected_s, expected))

    tries = np.linspace(-search_s, search_s, COARSE)
    lag = float(tries[int(np.argmin([float(left(v) @ left(v)) for v in tries]))])
    width = float(np.median(np.diff(expected_s)))
    slope, power = np.zeros(t_s.size), 0.0
    for _ in range(ROUNDS):
        rise = np.interp(t_s - lag + width, expected_s, expected) - np.interp(t_s - lag - width, expected_s, expected)
        slope, rest = without(rise / (2 * width)), left(lag)
        power = float(slope @ slope)
        if power <= SLACK * max(float(rest @ rest) / search_s**2, 1e-300):
            return Lag(lag, np.inf, determined=False)
        change = -float(slope @ rest) / power
        lag = float(np.clip(lag + change, -search_s, search_s))
        if abs(change) < 1e-9:
            break
    u = _newey_west(slope * left(lag)) / power
    return Lag(lag, u, determined=bool(u < 0.5 * search_s and abs(lag) < search_s))


def _newey_west(score: F1) -> float:
    """Return the standard deviation of the sum of an autocorrelated score (Newey-West)."""
    n = score.size
    reach = min(n // 4, int(4 * (n / 100.0) ** (2.0 / 9.0)) + 20)
    total = float(score @ score)
    for k in range(1, reach + 1):
        total += 2.0 * (1.0 - k / (reach + 1)) * float(score[k:] @ score[:-k])
    return float(np.sqrt(max(total, float(score @ score) * 0.1)))


def lag_between_ways(t_s: F1, out: F1, back: F1, *, columns: F2 | None = None, search_s: float = 0.5, smooth_s: float = 2.0) -> Lag:
    """Fit the lag of readings taken out and back along one path at one speed, which shifts the two patterns by twice the lag.

    Parameters
    ----------
    t_s : array, shape (n,)
        Times of the readings on the way out, evenly spaced.
    out, back : array, shape (n,)
        Readings on the way out, and on the way back at the same positions.
    columns : array, shape (n, k), optional
        Other differences between the way out and the way back, e.g. lost motion (direction of the bar times the change of sign of each
        axis). A constant is always included.
    search_s : float
        The lag counts as determined if its uncertainty is below half of this value.
    smooth_s : float
        Window of the smoothing cubic that gives the slope of the pattern; noise in the slope would hide the lag.

    Raises
    ------
    ValueError
        The path is shorter than three windows.
    """
    step = float(np.median(np.diff(t_s)))
    width = max(2, round(smooth_s / step / 2)) * 2 + 1
    if t_s.size < 3 * width:
        raise ValueError(f"lag: the path has {t_s.size} readings, a smoothing window of {smooth_s:g} s needs {3 * width}")
    slope_all = np.asarray(scipy.signal.savgol_filter(0.5 * (out + back), width, 3, deriv=1, delta=step))
    inner = slice(width, t_s.size - width)  # at the ends the window is incomplete
    slope = slope_all[inner]
    free = np.ones((t_s.size, 1)) if columns is None else np.column_stack([np.ones(t_s.size), columns])
    basis = np.linalg.qr(free[inner])[0]
    half = 0.5 * (out - back)[inner]
    slope, half = slope - basis @ (basis.T @ slope), half - basis @ (basis.T @ half)
    power = float(slope @ slope)
    if power <= 1e-30:
        return Lag(0.0, np.inf, determined=False)
    lag = -float(slope @ half) / power
    u = _newey_west(slope * (half + lag * slope)) / power
    return Lag(lag, u, determined=bool(u < 0.5 * search_s))
