"""A spectral line of all runs at one physical frequency, aliased differently by every sampling rate, with a phase per run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1
from abbe.models.discovery.noise import Colour
from abbe.models.effects.path import Path
from abbe.models.probability import chi2_above

HERTZ = (2.0, 75.0)
PADDING = 4
LOW_CYCLES, PER_TURN = 6.0, 2.0
"""Aliased frequencies with fewer cycles per run, and per turn of the bar, belong to the residues of the mean."""
LOBES_PER_TURN = 12.0
"""Up to this many cycles per turn of the bar a line may be form of the balls or the machine: such runs do not prove a line."""
REGULAR = 0.02
"""Sampling counts as regular when its steps differ by less than this share."""
TOP = 24


@dataclass(frozen=True)
class SpectralLine:
    """Gain in log likelihood (of the runs that prove it), how many frequencies were tried, frequency, amplitude with its uncertainty.

    ``p_harmonics``: p-value of the power at twice to four times the frequency, which a saw-tooth has and a vibration has not.
    """

    gain: float
    tried: float
    frequency_hz: float
    amplitude_mm: float
    u_mm: float
    p_harmonics: float = 1.0


@dataclass(frozen=True)
class _Spectrum:
    """Of one run: |sum r u_a e^-iwt| / sigma and (sum u_a^2) / sigma^2 by folded frequency 0 .. rate; zero where it does not count.

    ``proves``: where a line cannot be a form that the bar meets at every turn.
    """

    rate_hz: float
    size: F1
    energy: F1
    proves: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def at(self, f: F1) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Index of physical frequencies."""
        return np.asarray(np.round(np.mod(f / self.rate_hz, 1.0) * len(self.size)).astype(np.intp) % len(self.size))


def line_of_axis(
    axis: int, paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...], colour: Colour | None
) -> SpectralLine | None:
    """The most likely line of an axis' vibration; None where no run could show one.

    Parameters
    ----------
    rest : whitened residuals by run, shape (n,) each, high-passed (`fast`).
    colour : of the noise that they were whitened with, which weakens or raises a line.
    """
    spectra = [s for p, r, m in zip(paths, rest, sigma_mm, strict=True) if (s := _spectrum(axis, p, r, m, colour)) is not None]
    if not spectra:
        return None
    longest = max(len(s.size) / s.rate_hz for s in spectra) / PADDING
    f = np.arange(HERTZ[0], HERTZ[1], 1.0 / (3.0 * longest))
    total = np.zeros(len(f))
    for s in spectra:
        total += (s.size**2)[s.at(f)]
    best: SpectralLine | None = None
    for i in np.argsort(-total)[:TOP]:
        gain, amplitude, u = _amplitude(spectra, f[i])
        if best is None or gain > best.gain:
            best = SpectralLine(gain, float((HERTZ[1] - HERTZ[0]) * longest), float(f[i]), amplitude, u)
    if best is None:
        return None
    proof = [s for s in spectra if s.proves[s.at(np.array([best.frequency_hz]))[0]]]
    gain = min(best.gain, _amplitude(proof, best.frequency_hz)[0]) if proof else 0.0
    return replace(best, gain=gain, p_harmonics=_harmonics(spectra, best.frequency_hz))


def _harmonics(spectra: list[_Spectrum], f: float) -> float:
    """Chance that noise alone has as much power at the harmonics of a line."""
    total, freedom = 0.0, 0
    for s in spectra:
        for i in s.at(f * np.array([2.0, 3.0, 4.0])):
            if s.energy[i] > 0:
                total += float(2.0 * s.size[i] ** 2 / s.energy[i])
                freedom += 2
    return float(chi2_above(total, freedom)) if freedom else 1.0


def _spectrum(axis: int, path: Path, rest: F1, sigma_mm: float, colour: Colour | None) -> _Spectrum | None:
    steps = np.diff(path.at.t_s)
    if path.n < 40 or np.ptp(steps) > REGULAR * np.median(steps) + 3e-4 or not np.any(path.look[:, axis] ** 2 > 1e-3):
        return None
    rate = (path.n - 1) / float(path.at.t_s[-1] - path.at.t_s[0])
    look = path.look[:, axis] / sigma_mm
    size = np.abs(np.fft.fft(rest * look, PADDING * path.n))
    folded: F1 = np.fft.fftfreq(len(size)).astype(np.float64)
    through = np.ones(len(size)) if colour is None else 1.0 / _noise_power(folded, colour)
    cycles = np.abs(folded) * path.n
    counts = cycles >= _low_cycles(path) + 1.0
    energy = float(look @ look) * through
    return _Spectrum(rate, size * np.sqrt(through) * counts, energy * counts, cycles > LOBES_PER_TURN * _turns_of_bar(path))


def fast(path: Path, rest: F1) -> F1:
    """High-passed residuals of a run: leakage of slow changes would raise every other frequency."""
    n = rest.size
    x = np.arange(n) / max(n, 1)
    turns = 2.0 * np.pi * np.outer(x, np.arange(1, min(int(_low_cycles(path)), n // 6) + 1))
    slow, _ = np.linalg.qr(np.column_stack([np.ones(n), x, x * x, np.cos(turns), np.sin(turns)]))
    return np.asarray(rest - slow @ (slow.T @ rest))


def _low_cycles(path: Path) -> float:
    """Cycles per run up to which a frequency belongs to the mean: a few per turn of the bar."""
    return LOW_CYCLES + PER_TURN * _turns_of_bar(path)


def _turns_of_bar(path: Path) -> float:
    """How far the bar turns along a run, turns."""
    return float(np.linalg.norm(np.diff(path.look, axis=0), axis=1).sum()) / (2.0 * np.pi)


def _noise_power(f: F1, colour: Colour) -> F1:
    """Power of the noise per frequency (cycles per reading) over that of white noise of its size."""
    s, m = colour.share, colour.memory
    return np.asarray(1.0 - s + s * (1.0 - m * m) / (1.0 - 2.0 * m * np.cos(2.0 * np.pi * f) + m * m))


def _amplitude(spectra: list[_Spectrum], f: float) -> tuple[float, float, float]:
    """Most likely common amplitude of a line with a free phase in every run: gain, amplitude, its uncertainty."""
    at = [int(s.at(np.array([f]))[0]) for s in spectra]
    z = np.array([s.size[i] for s, i in zip(spectra, at, strict=True)])
    e = np.array([s.energy[i] for s, i in zip(spectra, at, strict=True)])
    if not e.sum() > 0:
        return 0.0, 0.0, 0.0
    top = 4.0 * np.sqrt(np.sum(z**2)) / np.sqrt(np.sum(e**2) + 1e-300)
    a = np.linspace(0.0, max(top, 1e-9), 200)
    bessel = np.log(scipy.special.i0e(np.outer(a, z))) + np.outer(a, z)
    like = (bessel - 0.25 * np.outer(a**2, e)).sum(axis=1)
    k = int(np.argmax(like))
    weight = np.exp(like - like[k])
    mean = float(weight @ a / weight.sum())
    return float(like[k]), float(a[k]), float(np.sqrt(weight @ (a - mean) ** 2 / weight.sum()))
