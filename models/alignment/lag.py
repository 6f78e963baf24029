"""Lag of a signal behind the machine: the time by which the expected signal is shifted to match the readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
