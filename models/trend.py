"""Trend of a series of check results ("figures"): whether it drifts, since when, and when it will reach its limit.

Figures come at any times, each with a standard uncertainty. Only the ratios of these uncertainties matter: mean and scale are estimated
from the series itself (Hawkins' self-starting chart). The difference between a figure and the mean of all earlier ones follows Student's t
and is transformed to a standard normal variable. While nothing changes, these variables are independent, so that the false-alarm rates
of CUSUM (ISO 7870-4) and EWMA (ISO 7870-6) hold from the third figure on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.probability import f_limit, normal_below, normal_limit, t_above

CUSUM_K = 0.5
"""Reference value of the CUSUM: half the smallest shift worth finding, in standard deviations of a check."""
CUSUM_H = 5.0
"""Decision limit of the CUSUM: one false alarm in 465 checks on average (`average_run_length`)."""
CUSUM_MOST = 2 * CUSUM_H
"""Cap on the CUSUM, so that its alarm ends about ten checks after a drift was cured."""
EWMA_WEIGHT = 0.2
EWMA_L = 2.962
"""Width of the EWMA's limits, in its standard deviations: one false alarm in 500 checks on average (Lucas and Saccucci 1990)."""
MIN_CHECKS = 8
"""Number of checks needed to judge whether a series drifts."""
MIN_FIT = 6
"""Number of checks needed to forecast when the limit is reached."""
SIGNIFICANCE = 0.01
"""Significance level that a slope needs before `forecast` extrapolates it."""
Z_MAX = 8.0
MOST_CHECKS = 400
"""Number of the latest checks that a forecast uses; older checks say little about the days ahead."""
MOST_KNOTS = 200
FARTHEST = 20.0
"""Longest forecast, as a multiple of the time that the series covers."""
JUMP_SIGMAS = 5.0
JUMP_SHARE = 0.25
"""Smallest jump that is reported: in standard uncertainties, and as a share of the limit."""


@dataclass(frozen=True)
class Forecast:
    """Days from the last check until the limit is reached, with a 95 % interval; NaN and a ``reason`` if unknown.

    ``slope`` and ``slope_u``: change per day and its standard uncertainty, in the figure's unit.
    """

    days: float
    low: float
    high: float
    reason: str
    slope: float = np.nan
    slope_u: float = np.nan


@dataclass(frozen=True)
class Trend:
    """Verdict on a series and its control charts.

    ``state``: ``in control``, ``drifting`` or ``too few checks``. ``direction``: +1 up, -1 down, 0 none. ``since``: index of the first
    check of the drift. ``found``: index of the check at which the CUSUM crossed its limit. ``z``: standardised deviations, NaN for the
    first two checks. ``ewma`` and ``ewma_limit``: EWMA of ``z`` and its two-sided limit. ``high`` and ``low``: upper and lower CUSUM.
    """

    state: str
    direction: int
    since: int | None
    found: int | None
    z: F1
    ewma: F1
    ewma_limit: F1
    high: F1
    low: F1
    forecast: Forecast


def standardised(values: F1, u: F1) -> F1:
    """Return the deviation of each figure from the mean of all earlier ones as a standard normal variable; NaN for the first two.

    Parameters
    ----------
    values, u : array (n,)
        Figures and their standard uncertainties, in order of time. Only the ratios of ``u`` matter.

    Raises
    ------
    ValueError
        An uncertainty is not positive, or shapes differ.
    """
    z = np.full(len(values), np.nan)
    if values.shape != u.shape or not bool(np.all(u > 0)):
        raise ValueError("trend: each figure needs one positive standard uncertainty")
    if len(values) < 3:
        return z
    weight = 1.0 / u**2
    total = np.cumsum(weight)
    mean = np.cumsum(weight * values) / total
    r = (values[1:] - mean[:-1]) / np.sqrt(u[1:] ** 2 + 1.0 / total[:-1])
    dof = np.arange(1, len(r))
    scale = np.sqrt(np.cumsum(r**2)[:-1] / dof)
    z[2:] = _normal(r[1:], scale, dof.astype(np.float64))
    return z


def _normal(r: F1, scale: F1, dof: F1) -> F1:
    """Transform Student variables ``r / scale`` to standard normal ones of the same probability."""
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(scale > 0, np.abs(r) / scale, np.where(r == 0, 0.0, np.inf))
    found = np.minimum(normal_limit(t_above(size, dof)), Z_MAX)
    return np.asarray(np.copysign(found, r), dtype=np.float64)


def ewma(z: F1, weight: float = EWMA_WEIGHT, width: float = EWMA_L) -> tuple[F1, F1]:
    """Return the exponentially weighted moving average of standard normal variables and its limit; NaN values are skipped."""
    mean, limit = np.full(len(z), np.nan), np.full(len(z), np.nan)
    last, variance = 0.0, 0.0
    for k in np.flatnonzero(np.isfinite(z)):
        last = weight * float(z[k]) + (1 - weight) * last
        variance = weight**2 + (1 - weight) ** 2 * variance
        mean[k], limit[k] = last, width * np.sqrt(variance)
    return mean, limit


def cusum(z: F1, k: float = CUSUM_K) -> tuple[F1, F1]:
    """Return the upper and lower cumulative sum of standard normal variables; NaN values are skipped."""
    high, low = np.zeros(len(z)), np.zeros(len(z))
    up = down = 0.0
    for n, one in enumerate(np.where(np.isfinite(z), z, np.nan).tolist()):
        if one == one:
            up, down = min(max(0.0, up + one - k), CUSUM_MOST), min(max(0.0, down - one - k), CUSUM_MOST)
        high[n], low[n] = up, down
    return high, low


def average_run_length(shift: float = 0.0, k: float = CUSUM_K, h: float = CUSUM_H, states: int = 400) -> float:
    """Return the mean number of checks until a two-sided CUSUM alarms if the mean is off by ``shift`` standard deviations.

    The method is a Markov chain with ``states`` states (Brook and Evans 1972).
    """
    one = [_one_sided(sign * shift, k, h, states) for sign in (1, -1)]
    return 1.0 / sum(1.0 / length for length in one)


def _one_sided(shift: float, k: float, h: float, states: int) -> float:
    width = 2 * h / (2 * states - 1)
    middle = np.arange(states) * width
    step = middle[None, :] - middle[:, None] + k - shift
    move = normal_below(step + width / 2) - normal_below(step - width / 2)
    move[:, 0] = normal_below(step[:, 0] + width / 2)
    return float(np.linalg.solve(np.eye(states) - move, np.ones(states))[0])


def trend(days: F1, values: F1, u: F1, limit: float | None = None) -> Trend:
    """Judge whether a series of figures drifts, and forecast when it reaches its limit.

    Parameters
    ----------
    days : array (n,)
        Times in days, not decreasing.
    values, u : array (n,)
        Figures and their standard uncertainties, in one unit.
    limit : float, optional
        Upper limit of the figure, in its unit; without it there is no forecast.

    Raises
    ------
    ValueError
        Shapes differ, times decrease, or an uncertainty is not positive.
    """
    if days.shape != values.shape or bool(np.any(np.diff(days) < 0)):
        raise ValueError("trend: give one time for each figure, in order of time")
    z = standardised(values, u)
    high, low = cusum(z)
    enough = len(values) >= MIN_CHECKS
    first = next(iter(np.flatnonzero(np.maximum(high, low) > CUSUM_H).tolist()), None)
    if first is not None and (since := _since(high if high[first] > CUSUM_H else low, first)) >= MIN_CHECKS:
        # Compare the checks after the alarm with the mean before the drift; otherwise the drift would become the new mean.
        z = _against_before(values, u, z, since, first)
        high, low = cusum(z)
    direction = 0 if not enough else 1 if high[-1] > CUSUM_H else -1 if low[-1] > CUSUM_H else 0
    began = found = None
    if direction:
        side = high if direction > 0 else low
        began = _since(side, len(side) - 1)
        found = began + int(np.flatnonzero(side[began:] > CUSUM_H)[0])
    state = "drifting" if direction else "in control" if enough else "too few checks"
    mean, bound = ewma(z)
    ahead = forecast(days[-MOST_CHECKS:], values[-MOST_CHECKS:], u[-MOST_CHECKS:], limit)
    return Trend(state, direction, began, found, z, mean, bound, high, low, ahead)


def mean_of(values: F1, u: F1) -> tuple[float, float]:
    """Return the weighted mean of figures and its standard uncertainty."""
    weight = 1.0 / u**2
    return float(weight @ values / weight.sum()), float(1.0 / np.sqrt(weight.sum()))


def jumps(change: float, u_change: float, limit: float) -> bool:
    """Return whether a figure grew by more than its uncertainty explains.

    This test serves series of fewer than `MIN_CHECKS` checks, whose spread is unknown. Unlike the charts, it takes the stated uncertainties
    at face value; `JUMP_SIGMAS` and `JUMP_SHARE` allow for contributions that are missing in these uncertainties.
    """
    return change > JUMP_SIGMAS * u_change and change > JUMP_SHARE * limit


def _since(side: F1, found: int) -> int:
    """Return the index after the last zero of a CUSUM up to index ``found``, where the change most probably began."""
    zero = np.flatnonzero(side[: found + 1] == 0)
    return int(zero[-1]) + 1 if len(zero) else 0


def _against_before(values: F1, u: F1, z: F1, since: int, found: int) -> F1:
    """Return ``z`` with the checks after index ``found`` compared with those before index ``since``."""
    weight = 1.0 / u[:since] ** 2
    mean = float(np.sum(weight * values[:since]) / np.sum(weight))
    scale = np.sqrt(float(np.sum(weight * (values[:since] - mean) ** 2)) / (since - 1))
    r = (values[found + 1 :] - mean) / np.sqrt(u[found + 1 :] ** 2 + 1.0 / np.sum(weight))
    again = z.copy()
    again[found + 1 :] = _normal(r, np.full(len(r), scale), np.full(len(r), since - 1.0))
    return again


def forecast(days: F1, values: F1, u: F1, limit: float | None, level: float = 0.95) -> Forecast:
    """Forecast when the figure reaches its limit, by a model that is constant up to an onset and rises linearly from there.

    Weighted least squares give level, slope and day of the onset; an onset at the first check makes a straight line. The residuals give
    the scale. The interval contains every day on which the limit may be reached without a significantly worse fit (likelihood ratio, F with
    1 and n - 3 degrees of freedom), but does not cover a later change of the machine's behaviour.
    """
    n = len(values)
    if limit is None:
        return Forecast(np.nan, np.nan, np.nan, "there is no limit")
    if n < MIN_FIT:
        return Forecast(np.nan, np.nan, np.nan, f"not known: {n} checks are too few")
    if days[-1] <= days[0]:
        return Forecast(np.nan, np.nan, np.nan, "not known: all checks were made at the same time")
    sums = _Sums.of(days - days[-1], values - limit, 1.0 / u**2)
    left = sums.left()
    best = int(np.argmin(left))
    scale2 = max(float(left[best]), 1e-12 * sums.yy) / (n - 3)
    slope = float(sums.slope()[best])
    slope_and_u = (slope, float(np.sqrt(scale2 * sums.w / (sums.w * sums.rr[best] - sums.r[best] ** 2))))
    flat = sums.yy - sums.y**2 / sums.w
    if (flat - left[best]) / (2 * scale2) <= f_limit(SIGNIFICANCE, 2, n - 3):
        return Forecast(np.nan, np.nan, np.nan, "not known: the slope is not significant", *slope_and_u)
    if slope < 0:
        return Forecast(np.nan, np.nan, np.nan, "moves away from the limit", *slope_and_u)
    reached = max(float(sums.knots[best] - sums.level()[best] / slope), 0.0)
    span = float(days[-1] - days[0])
    # Beside the day itself the grid is as fine as the narrowest interval that rounding leaves.
    near = reached * (1.0 + np.concatenate([-np.geomspace(1e-6, 0.1, 120), np.geomspace(1e-6, 0.1, 120)]))
    ahead = np.unique(np.concatenate([[0.0, reached], near, span * np.geomspace(1e-3, FARTHEST, 600)]))
    inside = np.flatnonzero(sums.squares_if(ahead) - left[best] <= scale2 * f_limit(1 - level, 1, n - 3))
    if reached == 0.0 and not len(inside):
        return Forecast(0.0, 0.0, 0.0, "", *slope_and_u)
    if reached > span * FARTHEST or not len(inside) or inside[-1] == len(ahead) - 1:
        return Forecast(np.nan, np.nan, np.nan, "not known: it may take very long", *slope_and_u)
    return Forecast(reached, float(ahead[max(inside[0] - 1, 0)]), float(ahead[inside[-1] + 1]), "", *slope_and_u)


@dataclass(frozen=True)
class _Sums:
    """Weighted sums for fits of a level plus a ramp that starts at one of several days (``knots``), to figures minus their limit."""

    knots: F1
    w: float
    y: float
    yy: float
    r: F1
    rr: F1
    yr: F1

    @staticmethod
    def of(days: F1, y: F1, w: F1) -> _Sums:
        last = days[-3]  # a later onset would rest on two checks only
        candidates = np.concatenate([days[days <= last], (days[1:] + days[:-1])[days[1:] <= last] / 2])
        knots = np.unique(np.concatenate([[days[0]], candidates]))
        knots = knots[np.unique(np.linspace(0, len(knots) - 1, min(len(knots), MOST_KNOTS)).round().astype(int))]
        ramp = np.maximum(days[None, :] - knots[:, None], 0.0)
        return _Sums(knots, float(w.sum()), float(w @ y), float(w @ y**2), ramp @ w, ramp**2 @ w, ramp @ (w * y))

    def slope(self) -> F1:
        return np.asarray((self.w * self.yr - self.r * self.y) / (self.w * self.rr - self.r**2), dtype=np.float64)

    def level(self) -> F1:
        return np.asarray((self.y - self.slope() * self.r) / self.w, dtype=np.float64)

    def left(self) -> F1:
        """Return the weighted residual sum of squares for each knot."""
        return np.asarray(self.yy - self.level() * self.y - self.slope() * self.yr, dtype=np.float64)

    def squares_if(self, reached: F1) -> F1:
        """Return, for each day, the smallest residual sum of squares over all knots if the limit is reached on that day."""
        away = reached - self.knots[:, None]
        level2 = (self.y * away - self.yr[:, None]) ** 2 / ((self.w * away - 2 * self.r[:, None]) * away + self.rr[:, None])
        return np.asarray(self.yy - level2.max(axis=0), dtype=np.float64)
