"""Roughness of a machine: the size of each motion's rough part, and periods such as the lead of a screw.

Periods are searched in the residuals of a solution, one translational motion at a time. A period is claimed only if its gain is far above
the gain that the best of as many periods reaches by chance, and if no other period explains the readings about as well (readings at steps
of one length cannot distinguish a period from its aliases).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import ROUGH_ORDER, SMOOTH_ORDER, motion_names, term_values
from abbe.models.machine import AXES
from abbe.models.solvers.joint import JointSolution, kept
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import run_design
from abbe.models.solvers.priors import Priors

SHORTEST_MM, LONGEST_MM = 4.0, 26.0
"""Range of the periods that are searched: leads of screws. Longer periods can hardly be separated from the other roughness."""
LEAST_GAIN = 45.0
"""Least gain in chi squared of a period (two more parameters); the best of 10,000 periods reaches about 30 by chance."""
RIVAL = 0.5
"""The best period is ambiguous if another period gains more than this share of its gain."""
CHANCE = 30.0
"""Gain that the best of all periods reaches by chance."""
MOST_PERIODS = 4
GROSS = 5.0
"""A residual beyond this many medians of its run is not part of a wave."""
POINTS_PER_PERIOD = 4
"""A table follows a period with this many points in each."""


@dataclass(frozen=True, slots=True)
class Period:
    """A periodic error of one translational motion: amplitude (half of peak to valley) and period with standard uncertainties, mm."""

    motion: str
    amplitude_mm: float
    u_amplitude_mm: float
    period_mm: float
    u_period_mm: float

    def text(self) -> str:
        """One sentence for people: the period and its remedy."""
        return (
            f"{self.motion}: {self.amplitude_mm * 1e3:.2f} ± {2 * self.u_amplitude_mm * 1e3:.2f} µm with a period of "
            f"{self.period_mm:.2f} ± {2 * self.u_period_mm:.2f} mm, as of a screw's lead; only a table with points every "
            f"{self.period_mm / POINTS_PER_PERIOD:.1f} mm or less follows it"
        )


@dataclass(frozen=True, slots=True)
class RoughMotion:
    """Rough part of one translational motion: rms over the stroke with standard uncertainty, and the shortest length that it shows, mm."""

    motion: str
    rms_mm: float
    u_rms_mm: float
    length_mm: float

    def text(self) -> str:
        """One sentence for people."""
        return (
            f"{self.motion}: rough by {self.rms_mm * 1e3:.1f} ± {2 * self.u_rms_mm * 1e3:.1f} µm (rms) at lengths from "
            f"{self.length_mm:.0f} mm: kinks, joints or wear; a table follows it with points at half this length"
        )


@kept
def rough_motions(solution: JointSolution) -> tuple[RoughMotion, ...]:
    """Return the motions whose rough part exceeds twice its uncertainty, largest first; none for a solution without rough parts."""
    out = []
    for name in dict.fromkeys(t.motion for t in solution.terms if t.order > SMOOTH_ORDER):
        mine = [i for i, t in enumerate(solution.terms) if t.motion == name and t.order > SMOOTH_ORDER]
        terms = tuple(solution.terms[i] for i in mine)
        axis = terms[0].axis
        x = np.tile(solution.machine.centre_mm, (4 * ROUGH_ORDER, 1))
        low, high = (float(v) for v in solution.machine.stroke_mm[axis])
        x[:, axis] = np.linspace(low, high, len(x))
        values = term_values(terms, x, solution.machine.stroke_mm)
        shape = values @ solution.coefficients[mine]
        covariance = values @ solution.term_covariance[np.ix_(mine, mine)] @ values.T
        rms = float(np.sqrt(np.mean(shape**2)))
        u = float(np.sqrt(shape @ covariance @ shape) / (len(x) * max(rms, 1e-12)))
        if rms > 2.0 * np.sqrt(np.mean(covariance.diagonal())):
            out.append(RoughMotion(name, rms, u, 2.0 * float(solution.machine.length_mm[axis]) / ROUGH_ORDER))
    return tuple(sorted(out, key=lambda m: -m.rms_mm))


def rough_lines(solution: JointSolution) -> tuple[str, ...]:
    """Roughness as sentences: periods, motions, or only the size if the readings cannot assign it to motions."""
    rough = any(t.order > SMOOTH_ORDER for t in solution.terms)
    if not rough and not any(test.flagged for test in solution.residual_tests):
        return ()
    known = (*(p.text() for p in periods(solution)), *(m.text() for m in rough_motions(solution)))
    if known or not rough:
        return known
    size = 1e3 * Priors().rough_mm * solution.size_factors["rough"]
    return (
        f"translational error motions are rough, each by about {size:.1f} µm; these readings do not show which of them at which places",
    )


@kept
def periods(solution: JointSolution) -> tuple[Period, ...]:
    """Return the periodic errors of the translational motions that the residuals of a solution prove, the clearest first."""
    search = _Search.of(solution)
    rest, out = search.rest, list[Period]()
    while len(out) < MOST_PERIODS:
        found = search.best(rest)
        if found is None:
            break
        period, explained = found
        out.append(period)
        rest = rest - explained
    return tuple(out)


@dataclass(frozen=True)
class _Search:
    """Whitened residuals, root of the readings' weights, and the solution's own whitened columns with the covariance of its unknowns."""

    solution: JointSolution
    rest: F1
    root_weight: F1
    columns: F2
    covariance: F2
    half: NDArray[np.bool_]

    @classmethod
    def of(cls, solution: JointSolution) -> _Search:
        """Fit the solution's unknowns again, in units of their prior, with the readings that became outliers because of a period."""
        root_weight = np.sqrt(np.concatenate(_weights(solution)))
        own = np.concatenate([run_design(solution.machine, solution.terms, r, solution.setup) for r in solution.data])
        columns = root_weight[:, None] * (own @ solution.prior_root)
        rest = root_weight * np.concatenate([r.residual_mm for r in solution.runs])
        before = np.linalg.solve(solution.prior_root, solution.estimate.theta)
        covariance = np.linalg.inv(np.eye(before.size) + columns.T @ columns)
        change = covariance @ (columns.T @ rest - before)
        half = np.concatenate([np.full(r.residual_mm.size, k % 2 == 0) for k, r in enumerate(solution.runs)])
        return cls(solution, rest - columns @ change, root_weight, columns, np.asarray(covariance, dtype=np.float64), half)

    def best(self, rest: F1) -> tuple[Period, F1] | None:
        """The clearest period of all motions, and the part of ``rest`` that it explains; None if no period is clear."""
        tried = [(name, a, c) for a, axis in enumerate(AXES) for c, name in enumerate(motion_names(axis)[:3])]
        found = [(*self._scan(rest, a, c), name, a, c) for name, a, c in tried]
        gain, frequency, alone, name, axis, component = max(found, key=lambda f: f[0])
        if gain < LEAST_GAIN or not alone:
            return None
        return self._fitted(rest, name, axis, component, frequency)

    def _waves(self, axis: int, component: int, frequency: F1) -> tuple[F2, F2]:
        """Whitened readings of a cosine and of a sine of unit amplitude, shape (n, frequencies) each."""
        parts = [_wave(run, axis, component, frequency) for run in self.solution.data]
        whole = np.concatenate(parts) * self.root_weight[:, None]
        return whole.real, whole.imag

    def _scan(self, rest: F1, axis: int, component: int) -> tuple[float, float, bool]:
        """Largest gain in chi squared, its frequency, and whether no other frequency gains nearly as much."""
        length = float(self.solution.machine.length_mm[axis])
        frequency = np.arange(1.0 / LONGEST_MM, 1.0 / SHORTEST_MM, 0.4 / length)
        cosine, sine = self._waves(axis, component, frequency)
        gain = _gain(rest, cosine, sine)
        i = int(np.argmax(gain))
        far = np.abs(frequency - frequency[i]) > 2.0 / length
        alone = not far.any() or gain[far].max() < RIVAL * gain[i]
        for half in (self.half, ~self.half) if gain[i] >= LEAST_GAIN and alone else ():  # both halves of the runs must agree
            own = _gain(rest[half], cosine[half], sine[half])
            alone = alone and (own.max() < CHANCE or own[~far].max() > RIVAL * own.max())
        return float(gain[i]), float(frequency[i]), bool(alone)

    def _fitted(self, rest: F1, name: str, axis: int, component: int, frequency: float) -> tuple[Period, F1] | None:
        length = float(self.solution.machine.length_mm[axis])
        close = frequency + np.linspace(-0.5, 0.5, 41) / length
        fits = [self._exact(rest, axis, component, f) for f in close]
        gain = np.array([f[0] for f in fits])
        k = int(np.clip(np.argmax(gain), 1, len(close) - 2))
        bend = gain[k - 1] - 2.0 * gain[k] + gain[k + 1]
        if gain[k] < LEAST_GAIN or bend >= 0.0 or self._rival(rest, axis, component, float(close[k])) > RIVAL * gain[k]:
            return None
        step = close[1] - close[0]
        at = close[k] + 0.5 * step * (gain[k - 1] - gain[k + 1]) / bend
        u = float(np.sqrt(-2.0 / bend)) * step  # chi squared rises by 1
        _, explained, amplitude, u_amplitude = self._exact(rest, axis, component, at)
        return Period(name, amplitude, u_amplitude, 1.0 / float(at), u / float(at) ** 2), explained

    def _rival(self, rest: F1, axis: int, component: int, frequency: float) -> float:
        """Largest gain of any other frequency, with all unknowns of the solution refitted."""
        length = float(self.solution.machine.length_mm[axis])
        other = np.arange(1.0 / LONGEST_MM, 1.0 / SHORTEST_MM, 0.4 / length)
        other = other[np.abs(other - frequency) > 2.0 / length]
        cosine, sine = self._waves(axis, component, other)
        across = [wave.T @ self.columns for wave in (cosine, sine)]
        taken = [a @ self.covariance for a in across]
        cc, ss = ((w**2).sum(0) - (t * a).sum(1) for w, t, a in zip((cosine, sine), taken, across, strict=True))
        cs = (cosine * sine).sum(0) - (taken[0] * across[1]).sum(1)
        c, s = rest @ cosine, rest @ sine
        gain = (ss * c**2 - 2.0 * cs * c * s + cc * s**2) / np.maximum(cc * ss - cs**2, 1e-3 * cc * ss + 1e-9)
        return float(gain.max(initial=0.0))

    def _exact(self, rest: F1, axis: int, component: int, frequency: float) -> tuple[float, F1, float, float]:
        """Gain with all unknowns of the solution refitted, the readings explained, amplitude and its standard uncertainty."""
        wave = np.column_stack(self._waves(axis, component, np.array([frequency])))
        across = wave.T @ self.columns
        information = wave.T @ wave - across @ self.covariance @ across.T
        covariance = np.linalg.inv(0.5 * (information + information.T) + 1e-9 * np.eye(2))
        asked = wave.T @ rest
        pair = covariance @ asked
        amplitude = float(np.hypot(*pair))
        along = pair / max(amplitude, 1e-15)
        left = wave @ pair - self.columns @ (self.covariance @ (across.T @ pair))
        return float(asked @ pair), left, amplitude, float(np.sqrt(along @ covariance @ along))


def _gain(rest: F1, cosine: F2, sine: F2) -> F1:
    """Gain in chi squared of a wave of each frequency, without refit of the other unknowns."""
    c, s = rest @ cosine, rest @ sine
    cc, ss, cs = (cosine**2).sum(0), (sine**2).sum(0), (cosine * sine).sum(0)
    return np.asarray((ss * c**2 - 2.0 * cs * c * s + cc * s**2) / np.maximum(cc * ss - cs**2, 1e-6 * cc * ss + 1e-9))


def _weights(solution: JointSolution) -> list[F1]:
    """Weight of every reading, run by run.

    Readings that the solution rejected only because the period made them outliers count again.
    """
    out, first = [], 0
    for run in solution.runs:
        weight = solution.weight_per_mm2[first : first + run.residual_mm.size].copy()
        usual = float(np.median(weight[weight > 0])) if (weight > 0).any() else 0.0
        size = np.abs(run.residual_mm)
        weight[(weight < usual) & (size < GROSS * float(np.median(size)))] = usual
        out.append(weight)
        first += weight.size
    return out


def _wave(run: RunData, axis: int, component: int, frequency: F1) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Reading of exp(2 pi i f x) of a translational motion, shape (n, frequencies): laser against its first record, bar against its cup,
    artefact in space."""

    def at(x_mm: F1) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
        return np.exp(2j * np.pi * np.multiply.outer(x_mm, frequency))

    if run.beam is not None:
        return np.asarray((at(run.axes_mm[:, axis]) - at(run.axes_mm[:1, axis])) * run.beam[component])
    if run.points is not None:
        return np.asarray(at(run.axes_mm[:, axis]) * run.points.direction[:, component, None])
    assert run.centre_mm is not None
    bar = run.axes_mm - run.centre_mm
    share = bar[:, component] / np.linalg.norm(bar, axis=1)
    piece = np.where(run.weight_n > 1.0, np.abs(np.gradient(run.axes_mm[:, axis])), 0.0)  # a mean over this way flattens the wave
    wave = at(run.axes_mm[:, axis]) * np.sinc(np.multiply.outer(piece, frequency))
    return np.asarray(share[:, None] * (wave - at(run.centre_mm[None, axis])))
