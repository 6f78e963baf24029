"""Residuals of a fit: outliers are down-weighted or rejected and listed; tests per run tell whether the rest is noise.

The tests of the whitened residuals concern their size, sequence of signs, correlation of neighbours, and direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import RunData

LEVEL = 0.01
"""Significance level: a test is flagged if its p-value, corrected for the number of tests (Holm), is below this."""
FEWEST = 10

STILL = 1e-3
"""Positions (mm) or times (s) closer together than this count as the same."""


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """One test of one run's whitened residuals.

    ``name``: "size", "signs", "time", "position X".., "direction X"..; ``p``: p-value; ``p_adjusted``: corrected for the number of tests;
    ``text``: the finding as a sentence, empty unless ``flagged``.
    """

    run: str
    name: str
    statistic: float
    p: float
    p_adjusted: float
    flagged: bool
    text: str


def residual_tests(runs: tuple[RunData, ...], whitened: tuple[F1, ...], weight: tuple[F1, ...]) -> tuple[ResidualTest, ...]:
    """Test the whitened residuals of all runs.

    Parameters
    ----------
    whitened, weight : tuple of arrays, shape (n,) per run
        Residuals divided by their standard deviation, leverage included; robust weights. Readings of weight 0.5 or less are left out.
    """
    found = [t for run, z, w in zip(runs, whitened, weight, strict=True) for t in _of_run(run, z, w > 0.5)]
    return _holm(found)


def _of_run(run: RunData, z: F1, use: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[ResidualTest]:
    z, axes, sign = z[use], run.axes_mm[use], run.sign[use]
    if z.size < FEWEST:
        return []
    out = [_size(run.label, z), _signs(run.label, z), _alike(run.label, "time", z, np.asarray(run.t_s[use]), "s")]
    moving = [a for a in range(3) if np.ptp(axes[:, a]) > 1e-3]
    for a in moving:
        order = np.argsort(axes[:, a], kind="stable")
        out.append(_alike(run.label, f"position {'XYZ'[a]}", z[order], axes[order, a], "mm"))
        out += _direction(run.label, "XYZ"[a], z, sign[:, a])
    return out


def _size(label: str, z: F1) -> ResidualTest:
    chi2 = float(z @ z)
    p = float(scipy.special.gammaincc(0.5 * z.size, 0.5 * chi2))
    text = f"{label}: residuals are {np.sqrt(chi2 / z.size):.1f} times as large as in the other runs of this instrument"
    return ResidualTest(label, "size", chi2, p, p, False, text)


def _signs(label: str, z: F1) -> ResidualTest:
    """Runs test of Wald and Wolfowitz: number of sign changes of the residuals."""
    up = z > np.median(z)
    n1, n2 = int(up.sum()), int((~up).sum())
    count = 1 + int((np.diff(up.astype(int)) != 0).sum())
    mean = 1.0 + 2.0 * n1 * n2 / (n1 + n2)
    variance = (mean - 1.0) * (mean - 2.0) / (n1 + n2 - 1.0)
    score = (count - mean) / np.sqrt(max(variance, 1e-12))
    p = float(2.0 * scipy.special.ndtr(-abs(score)))
    word = "seldom" if score < 0 else "often"
    return ResidualTest(label, "signs", float(score), p, p, False, f"{label}: residuals change sign too {word} for noise")


def autocorrelation(z: F1, lags: int) -> F1:
    """Autocorrelation of lags 1 to ``lags`` about zero, shape (lags,)."""
    power = float(z @ z)
    return np.array([float(z[k:] @ z[:-k]) / power if power > 0 else 0.0 for k in range(1, lags + 1)])


def _alike(label: str, name: str, z: F1, at: F1, unit: str) -> ResidualTest:
    """Ljung-Box test: whether neighbouring residuals are correlated along time or a position."""
    lags = max(1, min(10, z.size // 5))
    r = autocorrelation(z, lags)
    k = np.arange(1, lags + 1)
    q = float(z.size * (z.size + 2.0) * np.sum(r**2 / (z.size - k)))
    p = float(scipy.special.gammaincc(0.5 * lags, 0.5 * q))
    small = np.flatnonzero(r < 2.0 / np.sqrt(z.size))
    length = int(small[0]) if small.size else lags
    span = float(np.median(at[max(length, 1) :] - at[: -max(length, 1)]))
    along = "in time" if name == "time" else f"along {name[-1]}"
    if length == 0:
        text = f"{label}: neighbouring residuals {along} alternate in sign"
    else:
        far = f"over {span:.3g} {unit}" if span > STILL else "at one place"
        text = f"{label}: residuals {along} are correlated {far}: the model misses something there"
    return ResidualTest(label, name, q, p, p, False, text)


def _direction(label: str, axis: str, z: F1, sign: F1) -> list[ResidualTest]:
    """Whether both directions of travel leave the same mean residual."""
    plus, minus = z[sign > 0], z[sign < 0]
    if min(plus.size, minus.size) < 5:
        return []
    gap = float(plus.mean() - minus.mean())
    score = gap / float(np.sqrt(1.0 / plus.size + 1.0 / minus.size))
    p = float(2.0 * scipy.special.ndtr(-abs(score)))
    text = f"{label}: forward and backward travel of {axis} differ by {abs(gap):.1f} standard deviations after correction of lost motion"
    return [ResidualTest(label, f"direction {axis}", float(score), p, p, False, text)]


def _holm(tests: list[ResidualTest]) -> tuple[ResidualTest, ...]:
    order = sorted(range(len(tests)), key=lambda i: tests[i].p)
    adjusted, running = dict[int, float](), 0.0
    for rank, i in enumerate(order):
        running = max(running, min(1.0, tests[i].p * (len(tests) - rank)))
        adjusted[i] = running
    out = []
    for i, t in enumerate(tests):
        bad = adjusted[i] < LEVEL
        out.append(replace(t, p_adjusted=adjusted[i], flagged=bad, text=t.text if bad else ""))
    return tuple(out)


def inflation(z: tuple[F1, ...]) -> float:
    """Ratio of the number of readings to the number of independent readings: 1 + 2 sum of the autocorrelation, at least 1.

    The sum ends before the first lag whose autocorrelation is within the noise. ``z``: whitened residuals of one instrument, an array per
    run.
    """
    sizes = [v.size for v in z if v.size >= FEWEST]
    if not sizes:
        return 1.0
    lags = max(1, min(40, max(sizes) // 4))
    top, power = np.zeros(lags), 0.0
    count = np.zeros(lags)
    for v in z:
        if v.size < FEWEST:
            continue
        power += float(v @ v)
        for k in range(1, min(lags, v.size - 1) + 1):
            top[k - 1] += float(v[k:] @ v[:-k])
            count[k - 1] += v.size - k
    n = float(sum(sizes))
    r = top / power * n / np.maximum(count, 1.0) if power > 0 else top
    noise = 2.0 / np.sqrt(np.maximum(count, 1.0))
    small = np.flatnonzero(r < noise)
    end = int(small[0]) if small.size else lags
    return 1.0 + 2.0 * float(r[:end].sum())


FALSE_ALARM = 0.05
"""Probability that a campaign without outliers has a down-weighted reading."""
REJECT = 1.5
"""From this multiple of the threshold on, a reading has weight 0."""


@dataclass(frozen=True, slots=True)
class Outlier:
    """A down-weighted reading: its run, index among the run's values, size in standard deviations, and weight, 0 to 1."""

    run: str
    index: int
    size: float
    weight: float


def leverage(a: F2, root: F2) -> F1:
    """Leverage, the fraction of each reading's variance that the fit absorbs, shape (n,): squared length of the rows of ``a @ root.T``.

    Parameters
    ----------
    a : array, shape (n, p)
        Whitened design.
    root : array, shape (p, p)
        ``root.T @ root`` is the covariance of the unknowns.
    """
    z = a @ root.T
    return np.asarray(np.einsum("np,np->n", z, z))


def outlier_threshold(n: int) -> float:
    """Size in standard deviations that any of ``n`` normal readings exceeds with probability `FALSE_ALARM`; at least 3.5."""
    return max(3.5, float(-scipy.special.ndtri(0.5 * FALSE_ALARM / max(n, 1))))


def outlier_weights(size: F1, limit: float) -> F1:
    """Redescending weights: 1 below the limit, falling to 0 at `REJECT` times the limit (Hampel's third part), shape (n,).

    Clean readings keep weight 1, so they lose no information and do not bias the estimated noise.
    """
    s: F1 = np.abs(size)
    inside = np.maximum(s, 1e-300)
    return np.asarray(np.where(s <= limit, 1.0, np.clip((REJECT * limit - s) / ((REJECT - 1.0) * inside), 0.0, 1.0)))


def robust_scale(size: F1) -> float:
    """Robust standard deviation (median absolute value over 0.6745), so that outliers do not hide in a larger estimate of noise."""
    return float(np.median(np.abs(size)) / 0.6744897501960817) if size.size else 1.0
