"""Starts of the search for unnamed structures: the few positions, times and periods at which the residuals stand out.

A step may occur at any time and a wave may have any period. These are thousands of starts, too many to project the present simulation out
of each column. Only the norm of a column needs this projection; its inner product with the (already projected) residual does not. So a scan
with approximate norms finds the best starts, which then compete with their exact columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.effects.path import Path

PERIODS_S = (18.0, 110.0)
PITCHES_MM = (6.0, 60.0)
BURST_S = (0.35, 0.8, 1.8)
BURST_HZ = (0.15, 8.0)
CELL_MM = 14.0
"""Distance between the tried centres of bumps."""
PLACES = 64
"""Centres processed at once; each has hundreds of readings near it."""


@dataclass(frozen=True)
class ScanResult:
    """Runs to be scanned: paths, whitened residuals ``rest``, one array (n,) per run, and the noise of one reading of each run."""

    paths: tuple[Path, ...]
    rest: tuple[F1, ...]
    sigma_mm: tuple[float, ...]

    def only(self, which: list[int]) -> ScanResult:
        """Return the runs with the indices ``which``, in this order."""
        return ScanResult(tuple(self.paths[k] for k in which), tuple(self.rest[k] for k in which), tuple(self.sigma_mm[k] for k in which))

    def stacked(self) -> tuple[F1, F2, F1]:
        """Return for all readings: time, s; direction of bar or beam divided by the noise, shape (n, 3), 1/mm; whitened residual."""
        look = np.concatenate([p.look / s for p, s in zip(self.paths, self.sigma_mm, strict=True)])
        return np.concatenate([p.at.t_s for p in self.paths]), look, np.concatenate(self.rest)


def best(score: F1, count: int, apart: int) -> list[int]:
    """Return the indices of the highest positive values, highest first, more than ``apart`` from each other."""
    left = score.copy()
    out: list[int] = []
    while len(out) < count and np.isfinite(left).any() and left.max() > 0:
        i = int(np.argmax(left))
        out.append(i)
        left[max(i - apart, 0) : i + apart + 1] = -np.inf
    return out


def step_instants(scanned: ScanResult, count: int) -> dict[str, tuple[float, ...]]:
    """Return the best times of a step, s, by axis; key ``""``: times of a step in any direction.

    A step lasts until the end of a ball-bar set-up or of a laser run, because each laser run sets its zero anew.
    """
    groups: dict[str, list[int]] = {}
    for k, p in enumerate(scanned.paths):
        groups.setdefault(f"bar {p.setup}" if p.kind == "bar" else f"laser {p.label}", []).append(k)
    instants, gains = [], []
    for group in groups.values():
        order = sorted(group, key=lambda k: scanned.paths[k].at.t_s[0])
        t, look, rest = scanned.only(order).stacked()
        moved = np.cumsum((look * rest[:, None])[::-1], axis=0)[::-1][1:]
        size = np.cumsum((look * look)[::-1], axis=0)[::-1]
        whole, size = size[0] + 1e-12, size[1:]
        length = size * (1.0 - size / whole)
        gain = np.where(length > 1e-3 * whole, moved**2 / np.maximum(length, 1e-12), 0.0)
        instants.append(0.5 * (t[1:] + t[:-1]))
        gains.append(gain)
    t0, gain = np.concatenate(instants), np.concatenate(gains)
    columns = {"X": gain[:, 0], "Y": gain[:, 1], "Z": gain[:, 2], "": gain.sum(axis=1)}
    return {key: tuple(float(t0[i]) for i in best(score, count, 15)) for key, score in columns.items()}


def periods(scanned: ScanResult, count: int) -> dict[str, tuple[float, ...]]:
    """Return the best periods of a wave in time, s, by axis and by instrument ("bar", "laser")."""
    t, look, rest = scanned.stacked()
    per_mm = np.concatenate([np.full(p.n, 1.0 / s) for p, s in zip(scanned.paths, scanned.sigma_mm, strict=True)])
    bar = np.concatenate([np.full(p.n, p.kind == "bar") for p in scanned.paths])
    columns = np.column_stack([look, np.where(bar, per_mm, 0.0), np.where(bar, 0.0, per_mm)])
    step_hz = 0.4 / max(float(np.ptp(t)), PERIODS_S[1])
    f, power = _wave_gain(1.0 / PERIODS_S[1], 1.0 / PERIODS_S[0], step_hz, t, columns, rest, 1.0)
    return {k: tuple(float(1.0 / f[i]) for i in best(power[j], count, 2)) for j, k in enumerate(("X", "Y", "Z", "bar", "laser"))}


def pitches(scanned: ScanResult, count: int) -> dict[str, tuple[float, ...]]:
    """Return the best pitches, mm, of a wave along one axis in the direction of another, by error motion (``"EYX"``)."""
    q = np.concatenate([p.at.q_mm for p in scanned.paths])
    _, look, rest = scanned.stacked()
    out = {}
    for a, axis in enumerate("XYZ"):
        across = [d for d in range(3) if d != a]
        step = 0.4 / max(float(np.ptp(q[:, a])), PITCHES_MM[1])
        f, power = _wave_gain(1.0 / PITCHES_MM[1], 1.0 / PITCHES_MM[0], step, q[:, a], look[:, across], rest, 0.5)
        for j, d in enumerate(across):
            out[f"E{'XYZ'[d]}{axis}"] = tuple(float(1.0 / f[i]) for i in best(power[j], count, 2))
    return out


def _wave_gain(low: float, high: float, step: float, x: F1, columns: F2, rest: F1, bin_size: float) -> tuple[F1, F2]:
    """Return frequencies, and the reduction of chi-square by a wave in ``x`` of each frequency, shape (columns, frequencies).

    The method is a Fourier transform of the readings binned in ``x``, with norms of unprojected columns.
    """
    length = np.sum(columns**2, axis=0) / 2.0 + 1e-12
    cell = ((x - x.min()) / bin_size).astype(np.intp)
    size = scipy.fft.next_fast_len(max(int(np.ceil(1.0 / (step * bin_size))), int(cell.max()) + 1), real=True)
    binned = np.stack([np.bincount(cell, c * rest, size) for c in columns.T])
    f = np.arange(size // 2 + 1) / (size * bin_size)
    inside = (f >= low) & (f <= high)
    power = np.abs(scipy.fft.rfft(binned, axis=1)[:, inside]) ** 2 / length[:, None]
    return f[inside], power


def bursts(scanned: ScanResult, count: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Return times (s), widths (s) and frequencies (Hz) of the strongest short oscillations within single ball-bar runs."""
    found: list[tuple[float, float, float, float]] = []
    for p, rest in zip(scanned.paths, scanned.rest, strict=True):
        if p.kind != "bar" or p.n < 20:
            continue
        dt = float(np.median(np.diff(p.at.t_s)))
        for width in BURST_S:
            if width < dt:
                continue
            lag = np.arange(-int(3 * width / dt), int(3 * width / dt) + 1) * dt
            window = np.exp(-0.5 * (lag / width) ** 2)
            f = np.arange(BURST_HZ[0], min(BURST_HZ[1], 0.45 / dt), 0.2 / width)
            if not f.size or len(lag) > p.n:
                continue
            swing = np.exp(2j * np.pi * f[:, None] * lag)
            power = np.abs(_convolved(rest, window * swing)) ** 2
            power /= 0.5 * float(np.sum(window**2))
            k, i = np.unravel_index(int(np.argmax(power)), power.shape)
            found.append((float(power[k, i]), float(p.at.t_s[i]), width, float(f[k])))
    top = sorted(found, reverse=True)[:count]
    return tuple(tuple(dict.fromkeys(round(v[j], 6) for v in top)) for j in (1, 2, 3))  # type: ignore[return-value]


def _convolved(rest: F1, kernels: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Convolve readings (n,) with kernels (m, k), k odd, about their middles, shape (m, n); `scipy.signal` takes long to load."""
    n, k = rest.size, kernels.shape[1]
    size = scipy.fft.next_fast_len(n + k - 1)
    full = scipy.fft.ifft(scipy.fft.fft(rest, size) * scipy.fft.fft(kernels, size), overwrite_x=True)
    return np.asarray(full[:, k // 2 : k // 2 + n])


def bumps(scanned: ScanResult, widths_mm: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return times (s) at which a path passes the positions where a bump would explain most."""
    q = np.concatenate([p.at.q_mm for p in scanned.paths])
    t, look, rest = scanned.stacked()
    _, cells = np.unique(np.round(q / CELL_MM).astype(int), axis=0, return_index=True)
    tree = scipy.spatial.cKDTree(q)
    total = np.concatenate([_bump_gains(q[cells[i : i + PLACES]], tree, look, rest, widths_mm) for i in range(0, len(cells), PLACES)])
    chosen: list[int] = []
    for i in np.argsort(-total):
        if all(np.linalg.norm(q[cells[i]] - q[cells[j]]) > 1.5 * max(widths_mm) for j in chosen):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return tuple(float(t[cells[i]]) for i in chosen)


def _bump_gains(places: F2, tree: scipy.spatial.cKDTree, look: F2, rest: F1, widths_mm: tuple[float, ...]) -> F1:
    """Reduction of chi-square by a bump at each position, for the best of the widths, shape (places,)."""
    near = scipy.spatial.cKDTree(places).sparse_distance_matrix(tree, 2.5 * max(widths_mm), output_type="coo_matrix")
    total = np.zeros(len(places))
    for width in widths_mm:
        g = np.exp(-0.5 * (near.data / width) ** 2)
        pull = np.zeros((len(places), 3))
        shape = np.zeros((len(places), 3, 3))
        for a in range(3):
            pull[:, a] = np.bincount(near.row, g * (look[:, a] * rest)[near.col], len(places))
            for b in range(a, 3):
                shape[:, a, b] = shape[:, b, a] = np.bincount(near.row, g * g * (look[:, a] * look[:, b])[near.col], len(places))
        shape += 0.1 * np.trace(shape, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-9 * np.eye(3)
        total = np.maximum(total, np.einsum("na,na->n", pull, np.linalg.solve(shape, pull[:, :, None])[:, :, 0]))
    return total
