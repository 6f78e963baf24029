"""Noise of the instruments: a white part plus a correlated part ("memory"), in the same proportion for all readings of an instrument."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Path

SHARE, MEMORY = 0.1, 0.75
"""Correlated share of the noise variance, and its correlation from reading to reading: usual values of ball-bars and interferometers in a
workshop, with which the long-run variance is 1.6 times that of one reading."""
SHARES, MEMORIES = (0.1, 0.3, 0.5, 0.7, 0.85, 0.95), (0.5, 0.75, 0.9, 0.96, 0.985)
"""Shares and correlations tried for noise with more correlation than usual, such as 1/f noise."""
REMEMBERS, MOST, LOUDEST = 60.0, 0.8, 4.0
SAME_MM, AGAIN = 1.0, 0.2
"""Runs that are never farther apart than `SAME_MM` follow the same path. If their residuals correlate by `AGAIN` on average, these are not
noise."""
CLEARLY = 0.85
"""The noise from differences of neighbours is used if it is below this fraction of the residuals' standard deviation."""
FINE, QUIET, SHORTEST = 4, 0.25, 24
"""`FINE`: order of the differences of neighbours, which show the noise even if the model is incomplete (a missing wave of eight readings
adds 0.5 %). `QUIET`: share of an instrument's runs that no effect disturbs. `SHORTEST`: readings that a run must have."""
CROWD, TURN_MM, CREEP_MM_S = 0.35, 3.0, 4.5
"""`CROWD`: if a larger share of eleven neighbours is off, these readings are a disturbance, not single wrong readings. `TURN_MM`: travel
after a reversal within which a spike ends. `CREEP_MM_S`: speed below which an axis may stick and slip."""
LOW = 1.2
"""Relative bias of the noise found by `fine`, in units of 1/sqrt(n) for n readings: even without effects, the run at the share `QUIET` has
less noise than the average run. Product of 0.67 (quartile), 1.17 (median) and 1.5 (differences share readings)."""
LONE = 7.0
"""A reading farther from its neighbours than this many standard deviations is left out."""


@dataclass(frozen=True)
class Colour:
    """Noise of one instrument. ``share``: correlated part of its variance; ``memory``: correlation of this part from reading to reading.

    ``gain``: gain in log likelihood of the readings with these two values over the usual ones; 0 for the usual ones.
    """

    sd_mm: float
    share: float = SHARE
    memory: float = MEMORY
    gain: float = 0.0

    def filter(self) -> tuple[float, float, float]:
        """Return (m, c, v) of the ARMA(1, 1) process with the autocovariance of this noise: (1 - m B) noise = (1 + c B) innovation.

        B shifts by one reading. v is the variance of the innovation for readings of variance 1; their autocovariance is 1, s m, s m^2, ...
        with share s and memory m.
        """
        s, m = self.share, self.memory
        g0 = 1.0 + m * m - 2.0 * m * (s * m)
        g1 = s * m * (1.0 + m * m) - m - s * m**3
        if abs(g1) < 1e-12:
            return m, 0.0, g0
        half = g0 / (2.0 * g1)
        c = half - np.sign(half) * np.sqrt(half * half - 1.0)
        return m, float(c), float(g1 / c)


def unscaled(columns: F2, lengths: Sequence[int], kinds: Sequence[str], colours: Mapping[str, Colour]) -> F2:
    """Whiten columns (n, k) of stacked runs (``lengths``, ``kinds``) as if the noise were 1 mm; the caller divides by the actual noise."""
    filters = {kind: colours[kind].filter() for kind in set(kinds)}
    m, c, v = np.repeat([filters[kind] for kind in kinds], lengths, axis=0).T
    start = np.cumsum(lengths) - lengths
    m[start], c[start] = 0.0, 0.0  # every run begins anew
    out = np.divide(columns, np.sqrt(v)[:, None], order="F")
    out[1:] -= m[1:, None] * out[:-1]
    out = recursive(out, c)
    out[start] *= np.sqrt(v[start])[:, None]
    return out


def recursive(columns: F2, back: F1) -> F2:
    """Return y, shape (n, k), with y[t] = columns[t] - back[t] y[t - 1], by LAPACK: `scipy.signal` takes 0.4 s to load."""
    if not columns.size:
        return columns
    band = np.ones((2, len(columns)), order="F")
    band[1, :-1] = back[1:]
    return np.asarray(scipy.linalg.lapack.dtbtrs(band, columns, uplo="L", diag="U", overwrite_b=True)[0])


def remembered(residual: F1, lengths: Sequence[int], kinds: Sequence[str], colours: Mapping[str, Colour]) -> dict[str, Colour]:
    """Estimate the autocorrelation of each instrument's noise from residuals (as in `level`); without clear evidence keep the usual colour.

    Clear evidence: the log likelihood gains `REMEMBERS` over all runs and improves in `MOST` of them, because a single event is not noise.
    """
    out: dict[str, Colour] = {}
    ends = np.cumsum(lengths)
    for kind, colour in colours.items():
        runs = [
            _as_read(residual[end - n : end], colour) for n, k, end in zip(lengths, kinds, ends, strict=True) if k == kind and n >= SHORTEST
        ]
        out[kind] = colour
        if not runs:
            continue
        usual = np.array([_likelihood(r, Colour(1.0)) for r in runs])
        tried = {(s, m): np.array([_likelihood(r, Colour(1.0, s, m)) for r in runs]) for s in SHARES for m in MEMORIES}
        (share, memory), best = max(tried.items(), key=lambda t: float(t[1].sum()))
        gain = float((best - usual).sum())
        if gain > REMEMBERS and np.mean(best > usual) > MOST:
            out[kind] = Colour(colour.sd_mm, share, memory, gain)
    return out


def comes_back(paths: Sequence[Path], residual: Sequence[F1], kind: str) -> bool:
    """Whether residuals of an instrument are alike in runs along the same path; such residuals are not noise.

    The limit is a mean correlation of `AGAIN`. Without two runs along one path the answer is True. ``residual``: one array (n,) per run.
    """
    runs = [(p, r) for p, r in zip(paths, residual, strict=True) if p.kind == kind and p.n >= SHORTEST]
    alike = [
        float(np.corrcoef(one, other)[0, 1])
        for (p, one), (q, other) in combinations(runs, 2)
        if p.n == q.n and np.abs(p.at.q_mm - q.at.q_mm).max() < SAME_MM
    ]
    return not alike or float(np.mean(alike)) > AGAIN


def _as_read(whitened: F1, colour: Colour) -> F1:
    """Undo `unscaled` for one run."""
    m, c, v = colour.filter()
    first = np.sqrt(v) * whitened
    first[0] = whitened[0]
    first[1:] += c * first[:-1]
    return recursive(first[:, None], np.full(len(first), -m))[:, 0]


def _likelihood(read: F1, colour: Colour) -> float:
    """Log likelihood of the readings of a run with noise of this colour and its best level; outliers count as `LOUDEST` deviations."""
    white = unscaled(read[:, None], [read.size], [""], {"": colour})[:, 0]
    white = np.minimum(np.abs(white), LOUDEST * max(robust_sd(white), 1e-12))
    v = colour.filter()[2]
    return float(-0.5 * read.size * np.log(np.mean(white**2) + 1e-24) - 0.5 * (read.size - 1) * np.log(v))


def robust_sd(values: F1) -> float:
    """Robust standard deviation of values about zero: median absolute value over 0.6745; NaN without values."""
    return float(np.median(np.abs(values)) / 0.6745) if values.size else float("nan")


def level(
    residual: F1,
    lengths: Sequence[int],
    kinds: Sequence[str],
    use: F1,
    leverage: F1,
    resolution_mm: Mapping[str, float],
    colours: Mapping[str, Colour] | None = None,
) -> dict[str, Colour]:
    """Estimate the noise of each instrument from residuals that are whitened but not divided by the noise, mm (`unscaled`).

    Differences of neighbours, insensitive to smooth effects not yet in the model, are used if they give clearly less noise (`CLEARLY`).
    """
    out: dict[str, Colour] = {}
    for kind in dict.fromkeys(kinds):
        singles, pairs = [], []
        start = 0
        for n, k in zip(lengths, kinds, strict=True):
            part = slice(start, start + n)
            start += n
            if k == kind:
                keep = use[part] > 0
                scaled = residual[part] / np.sqrt(np.maximum(1.0 - leverage[part], 0.1))
                singles.append(scaled[keep])
                pairs.append(np.diff(scaled)[keep[1:] & keep[:-1]] / np.sqrt(2.0))
        sd, smooth = robust_sd(np.concatenate(singles)), robust_sd(np.concatenate(pairs))
        sd = smooth if smooth < CLEARLY * sd else sd
        out[kind] = replace((colours or {}).get(kind, Colour(0.0)), sd_mm=max(sd, resolution_mm[kind] / np.sqrt(12.0)))
    return out


def fine(residual: F1, lengths: Sequence[int], kinds: Sequence[str], use: F1, leverage: F1) -> dict[str, Colour]:
    """Estimate the noise of each instrument only from differences of neighbours, which contain hardly any effect; arguments as in `level`.

    The noise is taken from the instrument's quiet runs (`QUIET`): an effect may be sharp or dense in some runs, but not in all. Instruments
    without runs of `SHORTEST` readings are left out.
    """
    found: dict[str, list[float]] = {}
    start = 0
    for n, kind in zip(lengths, kinds, strict=True):
        part = slice(start, start + n)
        start += n
        keep = use[part] > 0
        if keep.sum() >= SHORTEST:
            scaled = (residual[part] / np.sqrt(np.maximum(1.0 - leverage[part], 0.1)))[keep]
            low = 1.0 - LOW / np.sqrt(keep.sum())
            found.setdefault(kind, []).append(robust_sd(np.diff(scaled, FINE)) / float(low * np.sqrt(comb(2 * FINE, FINE))))
    return {kind: Colour(float(np.quantile(sds, QUIET))) for kind, sds in found.items()}


def lone(residual: F1, lengths: Sequence[int], kinds: Sequence[str], turns: F1, resolution_mm: Mapping[str, float]) -> F1:
    """Weights, shape (n,): 0 for single readings far from their neighbours (`LONE`; a beam cut or a cup bumped for a moment), else 1.

    Ball-bar readings keep weight 1 if many near each other are off (`CROWD`), or if they lie next to a reversal (``turns`` is 1 there) and
    readings elsewhere are off less often.
    """
    out = np.ones(residual.size)
    start = 0
    for n, kind in zip(lengths, kinds, strict=True):
        at = slice(start, start + n)
        start += n
        if n <= 8:
            continue
        off = residual[at] - scipy.ndimage.median_filter(residual[at], 5, mode="nearest")
        least = max(LONE * robust_sd(off), 3.0 * resolution_mm[kind])
        far = np.abs(off) > least
        if kind == "bar":
            high = np.abs(residual[at]) > max(0.5 * least, 0.5 * LONE * robust_sd(residual[at]))
            far &= scipy.ndimage.uniform_filter1d(high.astype(np.float64), 11, mode="nearest") < CROWD
            near = turns[at] > 0
            if far[near].sum() > 2.0 * near.sum() * (far[~near].sum() + 1.0) / max(int((~near).sum()), 1):
                far &= ~near
        if far.mean() <= 0.1:
            out[at][far] = 0.0
    return out


def beside_turns(paths: Sequence[Path]) -> F1:
    """Return 1 for readings next to a reversal of an axis, else 0, stacked over the runs, shape (n,).

    These are readings within `TURN_MM` after the reversal, the last before it, and those while an axis creeps towards it (`CREEP_MM_S`).
    """
    out = []
    for p in paths:
        speed = np.abs(p.at.v_mm_s)
        slow = (speed < CREEP_MM_S) & (speed.max(axis=0, initial=0.0) >= CREEP_MM_S)
        near = (p.at.since_mm.min(axis=1) < TURN_MM) | slow.any(axis=1)
        out.append(np.asarray(near | np.append(near[1:], False), dtype=np.float64))
    return np.concatenate(out)
