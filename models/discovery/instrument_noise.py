"""Noise of the instruments: a white part plus a correlated part ("memory"), in the same proportion for all readings of an instrument."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

SHARE, MEMORY = 0.1, 0.75
"""Share of the variance with memory, and its correlation from reading to reading; typical of ball-bars and interferometers in a workshop
(long-run variance 1.6 times that of one reading)."""
CLEARLY = 0.85
"""The noise from differences of neighbours is used if it is less than this fraction of the residuals' standard deviation."""
FINE, QUIET, SHORTEST = 4, 0.25, 24
"""Order of the differences of neighbours that tell the noise whatever the model misses (a wave of eight readings adds 0.5 %); share of an
instrument's runs that may be quieter than its noise, because effects reach the other runs; and readings that a run must have."""
LOW = 1.2
"""Relative error of the noise of one run of n readings over 1/sqrt(n), at the share `QUIET` of noise alone: 0.67 times 1.17 (of a median)
times 1.5 (differences share readings)."""
LONE = 7.0
"""A reading farther from its neighbours than this many standard deviations does not count."""


@dataclass(frozen=True)
class Colour:
    """Noise of one instrument. ``share``: correlated part of its variance; ``memory``: correlation of this part from reading to reading."""

    sd_mm: float
    share: float = SHARE
    memory: float = MEMORY

    def filter(self) -> tuple[float, float, float]:
        """Return (m, c, v) of the ARMA(1, 1) process with the autocovariance of this noise: (1 - m B) noise = (1 + c B) innovation.

        B shifts by one reading. v is the variance of an innovation if that of a reading is 1; the autocovariance is then 1, s m, s m^2, ...
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
    out = np.empty_like(columns)
    start = 0
    for n, kind in zip(lengths, kinds, strict=True):
        m, c, v = colours[kind].filter()
        part = columns[start : start + n]
        scale = 1.0 / np.sqrt(v)
        out[start : start + n] = scipy.signal.lfilter([scale, -m * scale], [1.0, c], part, axis=0)
        out[start] *= np.sqrt(v)
        start += n
    return out


def robust_sd(values: F1) -> float:
    """Robust standard deviation of values about zero: median absolute value over 0.6745; NaN without values."""
    return float(np.median(np.abs(values)) / 0.6745) if values.size else float("nan")


def level(
    residual: F1, lengths: Sequence[int], kinds: Sequence[str], use: F1, leverage: F1, resolution_mm: Mapping[str, float]
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
        out[kind] = Colour(max(sd, resolution_mm[kind] / np.sqrt(12.0)))
    return out


def fine(residual: F1, lengths: Sequence[int], kinds: Sequence[str], use: F1, leverage: F1) -> dict[str, Colour]:
    """Estimate the noise of each instrument from differences of neighbours alone, which hold hardly any effect; arguments as in `level`.

    An effect that is sharp or dense in one run is not in all others, so the noise is that of the instrument's quiet runs (`QUIET`).
    Instruments without runs of `SHORTEST` readings are left out.
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


def lone(residual: F1, lengths: Sequence[int], kinds: Sequence[str]) -> F1:
    """Weights, shape (n,): 0 for single laser readings far from their neighbours (`LONE`; a beam cut for a moment), else 1."""
    out = np.ones(residual.size)
    start = 0
    for n, kind in zip(lengths, kinds, strict=True):
        if kind == "laser" and n > 8:
            part = residual[start : start + n]
            off = part - scipy.ndimage.median_filter(part, 5, mode="nearest")
            far = np.abs(off) > LONE * robust_sd(off)
            if far.mean() <= 0.1:
                out[start : start + n][far] = 0.0
        start += n
    return out
