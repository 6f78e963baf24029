"""Few readings that are off: a mixture of noise and of something wider against noise alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1

RATES = np.array([0.01, 0.015, 0.02, 0.03, 0.045, 0.065])
SIZES = np.geomspace(1.5, 60.0, 24)
"""How far a reading that is off is off typically, in sigmas, to either side."""
SPREAD = 0.4
"""How much that differs from one to the next (standard deviation, share of it)."""
SCALES = np.linspace(0.75, 1.1, 15)
"""Noise of the good readings over the rms of all: free, or a wrong noise would look like outliers."""


@dataclass(frozen=True)
class Contaminated:
    """Gain in log likelihood, share of readings that are off, by how much typically (sigmas) and its uncertainty."""

    gain: float
    rate: float
    size: float
    u_size: float


def contaminated(rest: F1) -> Contaminated:
    """Best mixture of noise and outliers for whitened residuals, shape (n,); the noise's size is fitted with and without."""
    n = rest.size
    core = np.sort(np.abs(rest))[: max(int(0.9 * n), 1)]
    robust = float(np.median(core) / 0.6745 * 1.06)
    plain = -0.5 * n * (np.log(np.mean(rest**2)) + 1.0)
    best = Contaminated(0.0, 0.0, 0.0, 0.0)
    square = rest**2
    by_size = np.full(len(SIZES), -np.inf)
    for scale in robust * SCALES:
        good = np.exp(-0.5 * square / scale**2) / scale
        for j, size in enumerate(SIZES):
            wide = np.hypot(scale, SPREAD * size)
            bad = 0.5 * (np.exp(-0.5 * ((rest - size) / wide) ** 2) + np.exp(-0.5 * ((rest + size) / wide) ** 2)) / wide
            for rate in RATES:
                gain = float(np.log((1.0 - rate) * good + rate * bad + 1e-300).sum()) - plain
                by_size[j] = max(by_size[j], gain)
                if gain > best.gain:
                    best = Contaminated(gain, float(rate), float(size), 0.0)
    if best.gain == 0.0:
        return best
    weight = np.exp(by_size - by_size.max())
    mean = float(weight @ SIZES / weight.sum())
    u = float(np.sqrt(weight @ (SIZES - mean) ** 2 / weight.sum()))
    return Contaminated(best.gain, best.rate, best.size, max(u, 0.05 * best.size))
