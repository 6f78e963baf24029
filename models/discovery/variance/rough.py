"""Intermittent roughness: while an axis creeps (stick-slip), or for some seconds of one run (interference)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Path

GATES_MM_S = (0.7, 0.9, 1.15, 1.45, 1.8, 2.25, 2.8, 3.5, 4.4)
REFINED = 2
"""Gates with the best scores that are fitted."""
LEAST_READINGS = 12.0
"""A gate that fewer readings pass proves nothing."""
ALIKE = 1.94
"""Divisor for squared second differences, which are correlated from reading to reading for white noise."""
FEW = 3
"""The gain of this many readings does not count: a reversal that the mean misses by a reading is no roughness."""
WINDOWS_S = (1.0, 2.0, 4.0)


@dataclass(frozen=True)
class Roughness:
    """Gain in log likelihood, gates tried, gate, size of the saw-tooth (half its height) with its uncertainty, weight by run."""

    gain: float
    tried: float
    v_c: float
    size_mm: float
    u_mm: float
    weight: tuple[F1, ...]


def gated_roughness(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> dict[int, Roughness]:
    """Most likely stick-slip speed of each axis, below which the readings are rougher; without axes that creep in no run.

    A saw-tooth of half height h fades with speed as exp(-(v/v_c)^2) (Stribeck's curve) and has the variance h^2/3. Scatter along each axis
    at any speed is fitted too (a vibration is not stick-slip). Deviations that are constant from reading to reading do not count: they may
    be residues of the mean at a reversal.
    """
    look = np.concatenate([p.look**2 / s**2 for p, s in zip(paths, sigma_mm, strict=True)])
    values = np.concatenate(rest)
    read = values != 0.0
    fits = tuple(_RoughnessFit.of(square[read], look[read]) for square in (np.concatenate([_rough(r) for r in rest]), values**2))
    out: dict[int, Roughness] = {}
    for axis in range(3):
        speed = np.concatenate([np.where(np.ptp(p.at.q_mm[:, axis]) > 0, np.abs(p.at.v_mm_s[:, axis]), np.inf) for p in paths])
        gates = {v_c: look[:, axis] * np.exp(-2.0 * np.square(speed / v_c)) for v_c in GATES_MM_S}
        gates = {v_c: g for v_c, g in gates.items() if _readings(g[read]) >= LEAST_READINGS}
        likely = sorted(gates, key=lambda v_c: -fits[1].score(gates[v_c][read]))[:REFINED]
        for v_c in likely:
            (rough, _, _), (raw, variance, u) = (f.gain(gates[v_c][read]) for f in fits)
            gain = min(rough / ALIKE, raw)
            if axis not in out or gain > out[axis].gain:
                size = float(np.sqrt(3.0 * variance))
                by_run = tuple(np.split(np.sqrt(gates[v_c]), np.cumsum([p.n for p in paths])[:-1]))
                out[axis] = Roughness(gain, float(len(GATES_MM_S)), v_c, size, 1.5 * u / max(size, 1e-12), by_run)
    return out


def _readings(gate: F1) -> float:
    """Effective number of readings in a gate."""
    return float(gate.sum() ** 2 / max(float(gate @ gate), 1e-300))


def _rough(rest: F1) -> F1:
    """Square of the second differences, scaled to 1 for white noise; ends take their neighbours'."""
    if rest.size < 3:
        return np.ones(rest.size)
    second = (rest[1:-1] - 0.5 * (rest[:-2] + rest[2:])) / np.sqrt(1.5)
    return np.pad(second**2, 1, mode="edge")


@dataclass(frozen=True)
class _RoughnessFit:
    """Squared residuals with scatter along the axes fitted: what more scatter within a gate gains."""

    square: F1
    plain: F2
    start: F1

    @classmethod
    def of(cls, square: F1, look: F2) -> _RoughnessFit:
        plain = look / np.maximum(look.max(axis=0), 1e-300)
        return cls(square, plain, _likelihood(square, plain, np.full(3, 0.02)))

    def score(self, gate: F1) -> float:
        """Approximate gain of a gate, without a fit."""
        v = self.start[0] * (1.0 + self.plain @ self.start[1:])
        slope = 0.5 * float(np.sum((self.square / v - 1.0) * gate / v))
        return float(max(slope, 0.0) ** 2 / np.sum((gate / v) ** 2))

    def gain(self, gate: F1) -> tuple[float, float, float]:
        """Log likelihood gained by extra variance within a gate, the variance, its uncertainty."""
        top = float(gate.max())
        full = np.column_stack([self.plain, gate / top])
        found = _likelihood(self.square, full, np.append(self.start[1:], 0.5))
        extra = 1.0 + full @ found[1:]
        before, after = self.start[0] * (1.0 + self.plain @ self.start[1:]), found[0] * extra
        each = 0.5 * (np.log(before / after) + self.square / before - self.square / after)
        few = float(np.sort(each)[-FEW:].sum())
        u = 1.0 / np.sqrt(0.5 * float(np.sum((full[:, -1] / extra) ** 2)) + 1e-300)
        return max(float(each.sum()) - few, 0.0), float(found[-1] * found[0] / top), float(u * found[0] / top)


def _likelihood(square: F1, columns: F2, start: F1) -> F1:
    """Most likely white scatter and non-negative extra variances per column (in units of the white one)."""
    n = square.size

    def cost(extra: F1) -> tuple[float, F1]:
        v = 1.0 + columns @ extra
        level = float(np.mean(square / v))
        slope = 0.5 * ((1.0 / v) @ columns - (square / v**2 / level) @ columns)
        return 0.5 * (float(np.log(v).sum()) + n * np.log(level)), slope

    found = scipy.optimize.minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1e4)] * columns.shape[1])
    level = float(np.mean(square / (1.0 + columns @ found.x)))
    return np.concatenate([[level], found.x])


def loud_windows(paths: tuple[Path, ...], rest: tuple[F1, ...]) -> tuple[float, float, int, float, float, float] | None:
    """The loudest stretch of a run: gain, stretches tried, run, middle, half length, extra variance in sigmas squared."""
    best: tuple[float, float, int, float, float, float] | None = None
    tried = 0.0
    for k, (p, r) in enumerate(zip(paths, rest, strict=True)):
        if p.n < 20:
            continue
        dt = float(np.median(np.diff(p.at.t_s)))
        level = float(np.median(r**2)) / 0.4549
        held = np.concatenate([[0.0], np.cumsum(r**2 / max(level, 1e-12))])
        for window in WINDOWS_S:
            m = max(round(window / dt), 4)
            if m > p.n // 3:
                continue
            tried += p.n / m * 2.0
            mean = np.maximum((held[m:] - held[:-m]) / m, 1.0)
            gain = 0.5 * m * (mean - 1.0 - np.log(mean))
            i = int(np.argmax(gain))
            if best is None or gain[i] > best[0]:
                best = (float(gain[i]), 0.0, k, float(p.at.t_s[i] + 0.5 * window), 0.5 * window, float(mean[i] - 1.0))
    return None if best is None else (best[0], max(tried, 1.0), *best[2:])
