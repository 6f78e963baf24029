"""Structure in the variance of the residuals: a spectral line (vibration), and intermittent roughness.

A line has one physical frequency in all runs; every sampling rate aliases it differently, and its phase differs from run to run. Residuals
are rough while an axis creeps (stick-slip), or for some seconds of one run (interference).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.discovery.instrument_noise import Colour
from abbe.models.effects.path import Path
from abbe.models.probability import chi2_above

HERTZ = (2.0, 75.0)
PADDING = 4
LOW_CYCLES, PER_TURN = 6.0, 2.0
"""Aliased frequencies below `LOW_CYCLES` cycles per run plus `PER_TURN` per turn of the bar count as residues of the mean model."""
LOBES_PER_TURN = 12.0
"""Up to this many cycles per turn of the bar, a line may come from the form of balls or machine; runs in this range do not prove a line."""
BAND = 12
"""A vibration whose amplitude changes occupies the frequencies up to this many cycles per run from its own: in a run of 76 s its amplitude
may swell and fade every 6 s."""
REGULAR = 0.02
"""Sampling counts as regular when its steps differ by less than this fraction."""
TOP = 24
GATES_MM_S = (0.7, 0.9, 1.15, 1.45, 1.8, 2.25, 2.8, 3.5, 4.4)
REFINED, WORTH = 2, 7.0
"""Number of gates with the best scores that are fitted; all gates are fitted if the best of them gains more than `WORTH`."""
LEAST_READINGS = 12.0
"""A gate with fewer effective readings is not tried."""
ALIKE = 1.94
"""Divisor for gains from squared second differences, which are correlated from reading to reading even for white noise."""
FEW = 3
"""The gain of this many largest readings is left out, because a reversal that the mean model misses by one reading is not roughness."""
WINDOWS_S = (1.0, 2.0, 4.0)


@dataclass(frozen=True)
class SpectralLine:
    """A spectral line. ``gain``: gain in log likelihood from the runs that prove the line. ``tried``: number of frequencies tried.

    ``p_harmonics``: p-value of the power at two to four times the frequency, which a saw-tooth has and a vibration does not have.
    """

    gain: float
    tried: float
    frequency_hz: float
    amplitude_mm: float
    u_mm: float
    p_harmonics: float = 1.0


@dataclass(frozen=True)
class _Spectrum:
    """Spectrum of one run over aliased frequencies 0 to ``rate_hz``; r: residuals, u_a: the bar's direction cosine along the axis.

    ``size``: |sum r u_a e^-iwt| / sigma; ``energy``: (sum u_a^2) / sigma^2; both are zero at excluded frequencies. ``proves``:
    whether a line at this frequency is too fast to come from the form of balls or machine (`LOBES_PER_TURN`).
    """

    rate_hz: float
    size: F1
    energy: F1
    proves: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def at(self, f: F1) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return the indices in the spectrum to which physical frequencies f, Hz, are aliased."""
        return np.asarray(np.round(np.mod(f / self.rate_hz, 1.0) * len(self.size)).astype(np.intp) % len(self.size))

    def folded(self, i: np.ndarray[tuple[int], np.dtype[np.intp]]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return the indices up to half the sampling rate that have the same power."""
        return np.asarray(np.minimum(i, len(self.size) - i))


def line_of_axis(
    axis: int, paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...], colour: Colour | None
) -> SpectralLine | None:
    """Find the most likely spectral line of an axis' vibration; None if no run could show one.

    Parameters
    ----------
    rest : whitened residuals by run, shape (n,) each, high-passed (`fast`).
    colour : noise with which they were whitened; whitening changes the height of a line.
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
    """Probability that noise alone has as much power at the harmonics of a line of frequency f.

    A harmonic that is aliased into the band of the line (`BAND`) or onto another harmonic does not count: it has the power of the other.
    """
    total, freedom = 0.0, 0
    for s in spectra:
        line, *harmonics = (int(i) for i in s.folded(s.at(f * np.array([1.0, 2.0, 3.0, 4.0]))))
        apart = [i for i in dict.fromkeys(harmonics) if abs(i - line) > BAND * PADDING and s.energy[i] > 0]
        total += float(sum(2.0 * s.size[i] ** 2 / s.energy[i] for i in apart))
        freedom += 2 * len(apart)
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
    """High-pass the residuals of a run, because slow changes would leak into all other frequencies."""
    n = rest.size
    x = np.arange(n) / max(n, 1)
    turns = 2.0 * np.pi * np.outer(x, np.arange(1, min(int(_low_cycles(path)), n // 6) + 1))
    slow, _ = np.linalg.qr(np.column_stack([np.ones(n), x, x * x, np.cos(turns), np.sin(turns)]))
    return np.asarray(rest - slow @ (slow.T @ rest))


def _low_cycles(path: Path) -> float:
    """Number of cycles per run up to which a frequency counts as a residue of the mean model."""
    return LOW_CYCLES + PER_TURN * _turns_of_bar(path)


def _turns_of_bar(path: Path) -> float:
    """Return the number of turns of the bar along a run."""
    return float(np.linalg.norm(np.diff(path.look, axis=0), axis=1).sum()) / (2.0 * np.pi)


def _noise_power(f: F1, colour: Colour) -> F1:
    """Return the noise power at frequencies f (cycles per reading) divided by that of white noise with the same variance."""
    s, m = colour.share, colour.memory
    return np.asarray(1.0 - s + s * (1.0 - m * m) / (1.0 - 2.0 * m * np.cos(2.0 * np.pi * f) + m * m))


def _amplitude(spectra: list[_Spectrum], f: float) -> tuple[float, float, float]:
    """Fit an amplitude common to all runs, with a free phase in each; return gain in log likelihood, amplitude and its uncertainty."""
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


@dataclass(frozen=True)
class Roughness:
    """Stick-slip of one axis, found by a gate: a weight for each reading that falls as the axis moves faster.

    ``gain``: gain in log likelihood. ``tried``: number of gates tried. ``v_c``: gate speed, mm/s. ``size_mm``: half height of a saw-tooth;
    ``u_mm``: its standard uncertainty. ``weight``: square root of the weights, by run.
    """

    gain: float
    tried: float
    v_c: float
    size_mm: float
    u_mm: float
    weight: tuple[F1, ...]


def tooth_variance(paths: Sequence[Path], axis: int, v_c: float) -> F1:
    """Return the variance of a stick-slip in every reading, relative to that of an axis that creeps along the bar, shape (n,).

    A saw-tooth decreases with speed as exp(-(v/v_c)^2) (Stribeck's curve; ``v_c``, mm/s); a run in which the axis does not move has none.
    """
    moving = (np.where(np.ptp(p.at.q_mm[:, axis]) > 0, np.abs(p.at.v_mm_s[:, axis]), np.inf) for p in paths)
    look = np.concatenate([p.look[:, axis] for p in paths])
    return np.asarray(np.square(look) * np.exp(-2.0 * np.square(np.concatenate([*moving]) / v_c)))


def gated_roughness(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> dict[int, Roughness]:
    """Find for each axis the most likely speed below which the readings are rougher; axes that never creep are left out.

    A saw-tooth of half height h has the variance h^2/3 times `tooth_variance`. Scatter along each axis at any speed is fitted too, because
    a vibration is not stick-slip. Deviations that are equal in neighbouring readings are left out: they may be residues of the mean model
    at a reversal.
    """
    noise = np.repeat(np.square(sigma_mm), [p.n for p in paths])
    look = np.concatenate([p.look**2 for p in paths]) / noise[:, None]
    values = np.concatenate(rest)
    read = values != 0.0
    fits = tuple(RoughnessFit.of(square[read], look[read]) for square in (np.concatenate([roughness_of(r) for r in rest]), values**2))
    out: dict[int, Roughness] = {}
    for axis in range(3):
        gates = {v_c: tooth_variance(paths, axis, v_c) / noise for v_c in GATES_MM_S}
        gates = {v_c: g for v_c, g in gates.items() if _readings(g[read]) >= LEAST_READINGS}
        likely = sorted(gates, key=lambda v_c: -fits[1].score(gates[v_c][read]))[:REFINED]
        for v_c in likely:
            (rough, _, _), (raw, variance, u) = (f.gain(gates[v_c][read]) for f in fits)
            gain = min(rough / ALIKE, raw)
            if axis not in out or gain > out[axis].gain:
                by_run = tuple(np.split(np.sqrt(gates[v_c]), np.cumsum([p.n for p in paths])[:-1]))
                out[axis] = Roughness(gain, float(len(GATES_MM_S)), v_c, *height(variance, u), by_run)
        if axis in out and out[axis].gain > WORTH:
            out[axis] = _averaged(out[axis], fits[1], {v_c: g[read] for v_c, g in gates.items()})
    return out


def height(variance: float, u: float) -> tuple[float, float]:
    """Return the half height of a saw-tooth and its standard uncertainty from its variance."""
    size = float(np.sqrt(3.0 * variance))
    return size, 1.5 * u / max(size, 1e-12)


def _averaged(rough: Roughness, fit: RoughnessFit, gates: Mapping[float, F1]) -> Roughness:
    """Average height and speed over all gates, weighted with their likelihoods. If the axis creeps at one speed, the readings show only the
    product of both: then keep the most likely gate, with the uncertainty over all gates.
    """
    found = {v_c: fit.gain(g) for v_c, g in gates.items()}
    gains = np.array([gain for gain, _, _ in found.values()])
    weight = np.exp(gains - gains.max())
    weight /= weight.sum()
    size, own = np.array([height(variance, u) for _, variance, u in found.values()]).T
    mean = float(weight @ size)
    u = float(np.sqrt(weight @ (own**2 + (size - mean) ** 2)))
    if u >= mean:
        return replace(rough, u_mm=u)
    return replace(rough, v_c=float(weight @ np.array([*found])), size_mm=mean, u_mm=u)


def _readings(gate: F1) -> float:
    """Effective number of readings to which a gate gives weight."""
    return float(gate.sum() ** 2 / max(float(gate @ gate), 1e-300))


def roughness_of(rest: F1) -> F1:
    """Squared second differences, scaled to 1 for white noise; the two ends repeat their neighbours' values."""
    if rest.size < 3:
        return np.ones(rest.size)
    second = (rest[1:-1] - 0.5 * (rest[:-2] + rest[2:])) / np.sqrt(1.5)
    return np.pad(second**2, 1, mode="edge")


@dataclass(frozen=True)
class RoughnessFit:
    """Squared residuals, and a fit of the scatter along some axes at any speed, to test gates (`Roughness`) for additional scatter."""

    square: F1
    plain: F2
    start: F1

    @classmethod
    def of(cls, square: F1, look: F2) -> RoughnessFit:
        """Fit scatter to squared residuals, shape (n,), from the relative variance that scatter along each axis adds, shape (n, axes)."""
        plain = look / np.maximum(look.max(axis=0), 1e-300)
        return cls(square, plain, _likelihood(square, plain, np.full(look.shape[1], 0.02)))

    def score(self, gate: F1) -> float:
        """Approximate gain of a gate, without a fit."""
        v = self.start[0] * (1.0 + self.plain @ self.start[1:])
        slope = 0.5 * float(np.sum((self.square / v - 1.0) * gate / v))
        return float(max(slope, 0.0) ** 2 / np.sum((gate / v) ** 2))

    def gain(self, gate: F1) -> tuple[float, float, float]:
        """Fit additional variance within a gate; return gain in log likelihood, the variance and its standard uncertainty.

        The gain of the `FEW` readings with most of it does not count.
        """
        each, variance, u = self.by_reading(gate)
        return max(float(each.sum()) - float(np.sort(each)[-FEW:].sum()), 0.0), variance, u

    def by_reading(self, gate: F1) -> tuple[F1, float, float]:
        """Do the same as `gain`, with the gain of every reading, shape (n,)."""
        top = float(gate.max())
        full = np.column_stack([self.plain, gate / top])
        found = _likelihood(self.square, full, np.append(self.start[1:], 0.5))
        extra = 1.0 + full @ found[1:]
        before, after = self.start[0] * (1.0 + self.plain @ self.start[1:]), found[0] * extra
        each = 0.5 * (np.log(before / after) + self.square / before - self.square / after)
        u = 1.0 / np.sqrt(0.5 * float(np.sum((full[:, -1] / extra) ** 2)) + 1e-300)
        return each, float(found[-1] * found[0] / top), float(u * found[0] / top)


def _likelihood(square: F1, columns: F2, start: F1) -> F1:
    """Return the most likely white variance, then a non-negative additional variance per column, in units of the white one."""
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
    """Find the window with most scatter; return gain, windows tried, index of run, middle, half length (s), extra variance over noise."""
    best: tuple[float, float, int, float, float, float] | None = None
    tried = 0.0
    for k, (p, r) in enumerate(zip(paths, rest, strict=True)):
        if p.n < 20:
            continue
        dt = float(np.median(np.diff(p.at.t_s)))
        level = float(np.median(r**2)) / 0.4549
        cumulative = np.concatenate([[0.0], np.cumsum(r**2 / max(level, 1e-12))])
        for window in WINDOWS_S:
            m = max(round(window / dt), 4)
            if m > p.n // 3:
                continue
            tried += p.n / m * 2.0
            mean = np.maximum((cumulative[m:] - cumulative[:-m]) / m, 1.0)
            gain = 0.5 * m * (mean - 1.0 - np.log(mean))
            i = int(np.argmax(gain))
            if best is None or gain[i] > best[0]:
                best = (float(gain[i]), 0.0, k, float(p.at.t_s[i] + 0.5 * window), 0.5 * window, float(mean[i] - 1.0))
    return None if best is None else (best[0], max(tried, 1.0), *best[2:])
