"""Effects in the variance of the readings, not in their mean: vibration, stick-slip, outliers of a laser, bursts of interference.

Each effect is tested on whitened residuals against uniform scatter. The evidence is a log likelihood ratio minus a price, on the scale of
half a chi-square; an effect is named when its evidence is positive. The price accounts for the number of trials (frequencies, axes,
windows), so that noise alone leads to a given name in less than 3 of 1000 campaigns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Localization
from abbe.models.discovery.instrument_noise import Colour
from abbe.models.discovery.localization import localize_signal
from abbe.models.discovery.variance.creeping_axis import at_standstill, creep_speed, scatter_along, without_band
from abbe.models.discovery.variance.spectrum import (
    ALIKE,
    FEW,
    SpectralLine,
    fast,
    gated_roughness,
    line_of_axis,
    loud_windows,
    roughness_of,
    tooth_variance,
)
from abbe.models.effects.path import Path
from abbe.models.machine import AXES

NEAR_MM, LOUD = 30.0, 3.0
"""Readings within `NEAR_MM` of each other belong to one place; each counts with at most `LOUD` standard deviations."""
RATES = np.array([0.01, 0.015, 0.02, 0.03, 0.045, 0.065])
SIZES = np.geomspace(1.5, 60.0, 24)
"""Typical sizes of outliers, in sigmas, to either side."""
SPREAD = 0.4
"""Relative standard deviation of the outliers' size."""
SCALES = np.linspace(0.75, 1.1, 15)
"""Tried ratios of the good readings' noise to its robust estimate; with a fixed ratio, a wrong noise would look like outliers."""
UM = 1e3
NAME_PRICE = 7.0
"""Price of a name in log likelihood, added to the log of the number of trials: noise alone gains this with probability exp(-7) or so."""
OFF, PLACE_Z = 3.5, 4.0
"""`OFF`: a reading this many standard deviations off is an outlier. `PLACE_Z`: if the readings near outliers deviate by this many, the
cause is the position and not a lost beam (13 campaigns with lost beams had at most 1.2, three with a bump at least 4.2)."""
LEAST_INSIDE, LEAST_RUNS, IN_RUNS, ROUGHER = 12, 3, 0.75, 1.2
"""Least values for a rough place: readings of a run inside and outside of it, number of such runs, share of them that show the place, and
ratio of the variances."""
CLIPPED, MOSTLY = 4.0, 0.7
"""At a rough place, larger deviations count as `CLIPPED` standard deviations. Wrong readings belong to the place if at least the share
`MOSTLY` of them lies there."""
UNNAMED_PRICE = 3.0
BURST_PRICE = 7.0
"""Further price of a burst: noise has memory, so a few readings in a row are large more often than the price of a name assumes. The largest
gain beyond the log of the trials was 11.3 in 146 campaigns without a burst; the weakest true burst of the practice set had 23.
"""
LEAST_OFF = 10
"""Minimum number of wrong readings of a ball-bar that get a name; fewer are left out of the fit without a message."""
LEAST_LASER = 60
"""Minimum number of laser readings for estimating a rate of 1 in 100."""
DRIVES = ("stick_slip", "vibration")
OVERSHADOWS = 3.0
"""Vibration or stick-slip of one axis shows a little along the others, so a finding of the same round whose evidence is weaker by this
factor counts as explained. The next round tests it again, without the stronger one."""
GATE = 1.3
"""Readings below this multiple of the stick-slip speed scatter."""
SAW_P, TOOTH = 0.05, 0.5 * np.pi
"""`SAW_P`: a line is a saw-tooth if noise has as much power at its harmonics with at most this probability. `TOOTH`: half height of a
saw-tooth, in amplitudes of its first wave."""


def bound_to_places(q_mm: F2, rest: F1, off: NDArray[np.bool_]) -> tuple[float, F1]:
    """Find out whether laser outliers belong to a position: return the common deviation of other readings near them, and that position.

    The deviation is in standard deviations, the position in mm, shape (3,). A lost beam does not affect the readings nearby, so their
    common deviation is then within 3.

    Parameters
    ----------
    q_mm : array, shape (n, 3)
        Tool positions.
    rest : array, shape (n,)
        Whitened residuals; exact zeros mark missing readings.
    off : array of bool, shape (n,)
        True for outliers.
    """
    total = count = most = 0.0
    clipped, middle = np.clip(rest, -LOUD, LOUD), np.zeros(3)
    for i in np.flatnonzero(off):
        near = (np.linalg.norm(q_mm - q_mm[i], axis=1) < NEAR_MM) & (rest != 0.0)
        along = np.sign(rest[i]) * clipped * near
        total += float(along.sum() - along[i])
        count += float(near.sum()) - 1.0
        if float(along.sum()) > most:
            most = float(along.sum())
            middle = np.maximum(along, 0.0) @ q_mm / np.maximum(along, 0.0).sum()
    return (total / np.sqrt(count) if count else 0.0), np.asarray(middle)


@dataclass(frozen=True)
class Contaminated:
    """Fit of noise with outliers: gain in log likelihood, share of outliers (``rate``), their typical size (sigmas) and its uncertainty."""

    gain: float
    rate: float
    size: float
    u_size: float


def contaminated(rest: F1) -> Contaminated:
    """Fit a mixture of noise and outliers to whitened residuals, shape (n,), and compare it with fitted noise alone."""
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


@dataclass(frozen=True)
class VarianceFinding:
    """One variance effect.

    Attributes
    ----------
    name, key : name in the catalogue and axis; or ``unnamed_burst`` (seconds of one run), ``unnamed_place`` (laser, near one position).
    strength, u_strength : amplitude or typical size, um, with its standard uncertainty.
    parameters : ``frequency_hz`` of a vibration; ``v_c`` (mm/s) of stick-slip; ``rate``, share of outliers; ``t0_s``, ``width_s``: burst.
    evidence : log likelihood ratio less price; the effect is named when it is positive.
    """

    name: str
    key: str
    strength: float
    u_strength: float
    parameters: Mapping[str, float]
    evidence: float
    location: Localization

    @property
    def label(self) -> str:
        """Label of the effect: ``name:key``, or the name alone without a key."""
        return f"{self.name}:{self.key}" if self.key else self.name


def extra_variance(
    paths: tuple[Path, ...],
    whitened: tuple[F1, ...],
    sigma_mm: tuple[float, ...],
    *,
    leverage: tuple[F1, ...] | None = None,
    colours: Mapping[str, Colour] | None = None,
    alone: tuple[F1, ...] | None = None,
    known: Sequence[VarianceFinding] = (),
) -> tuple[VarianceFinding, ...]:
    """Find variance effects with positive evidence that no stronger effect explains; per axis at most one of vibration and stick-slip.

    Parameters
    ----------
    paths : runs.
    whitened : one array (n,) per run
        Whitened residuals of the mean model with all found effects, of variance 1 for noise alone. They must include outliers; exact zeros
        mark missing readings.
    sigma_mm : noise of one reading of each run.
    leverage : one array (n,) per run, optional
        Share of each reading's noise that the fit absorbed.
    colours : Colour by "bar" and "laser", optional
        Noise with which the residuals were whitened; default: white noise.
    alone : one array (n,) per run, optional
        1 for single wrong readings (`abbe.models.discovery.instrument_noise.lone`); a ball-bar's are tested as outliers and rough places.
    known : findings from before, which the residuals no longer contain (`abbe.models.discovery.variance.rounds.calmed`)
        An axis with a vibration or a stick-slip among them gets no second one, and a burst is explained by a stronger one as before.
        Readings that a stick-slip among them makes scatter are not tested as outliers.

    Returns
    -------
    tuple of VarianceFinding
        Evidence above zero only, highest first.
    """
    tried = candidates(paths, whitened, sigma_mm, leverage=leverage, colours=colours, alone=alone, known=known)
    once = {f.key for f in known if f.name in DRIVES}
    found = [f for f in tried if f.evidence > 0 and not (f.name in DRIVES and f.key in once)]
    out: list[VarianceFinding] = []
    for finding in sorted(found, key=lambda f: -f.evidence):
        if finding.name in DRIVES and any(_overshadows(o, finding) for o in out):
            continue
        if finding.name in (*DRIVES, "unnamed_burst") and any(o.name == "unnamed_rough" for o in out):
            continue
        if finding.name == "unnamed_burst" and any(o.name in DRIVES and 3.0 * o.evidence > finding.evidence for o in (*known, *found)):
            continue
        if finding.name == "unnamed_burst" and any(o.name == "bar_outliers" and o.evidence > OVERSHADOWS * finding.evidence for o in out):
            continue
        out.append(finding)
    return tuple(out)


def _overshadows(strong: VarianceFinding, weak: VarianceFinding) -> bool:
    """Whether ``strong`` explains ``weak``: it is stronger along the same axis, or much stronger along another."""
    return strong.name in DRIVES and (strong.key == weak.key or strong.evidence > OVERSHADOWS * weak.evidence)


def candidates(
    paths: tuple[Path, ...],
    whitened: tuple[F1, ...],
    sigma_mm: tuple[float, ...],
    *,
    leverage: tuple[F1, ...] | None = None,
    colours: Mapping[str, Colour] | None = None,
    alone: tuple[F1, ...] | None = None,
    known: Sequence[VarianceFinding] = (),
) -> tuple[VarianceFinding, ...]:
    """Return all variance effects with their evidence, which may be negative; parameters as in `extra_variance`."""
    even = _studentised(whitened, leverage)
    bars = [k for k, p in enumerate(paths) if p.kind == "bar"]
    out: list[VarianceFinding] = []
    if bars:
        bar_paths, sigma = tuple(paths[k] for k in bars), tuple(sigma_mm[k] for k in bars)
        off = tuple(np.zeros(paths[k].n) if alone is None else alone[k] for k in bars)
        kept = tuple(even[k] * (1.0 - o) for k, o in zip(bars, off, strict=True))
        quick = tuple(fast(p, r) for p, r in zip(bar_paths, kept, strict=True))
        for axis in range(3):
            out += _vibration(axis, bar_paths, quick, sigma, (colours or {}).get("bar"))
        out += _stick_slip(bar_paths, kept, sigma)
        sticking = [creeping(bar_paths, f) for f in (*known, *out) if f.name == "stick_slip" and f.evidence > 0.0]
        teeth = np.any([np.zeros(sum(p.n for p in bar_paths)), *sticking], axis=0)
        out += _burst(bar_paths, kept, sigma)
        out += _bar_scatter(bar_paths, tuple(even[k] for k in bars), off, sigma, teeth)
    lasers = [k for k, p in enumerate(paths) if p.kind == "laser"]
    if sum(paths[k].n for k in lasers) >= LEAST_LASER:
        subset = tuple(paths[k] for k in lasers), tuple(even[k] for k in lasers), tuple(sigma_mm[k] for k in lasers)
        out += _outliers(*subset)
    return tuple(out)


def _studentised(whitened: tuple[F1, ...], leverage: tuple[F1, ...] | None) -> tuple[F1, ...]:
    if leverage is None:
        return whitened
    return tuple(r / np.sqrt(np.maximum(1.0 - h, 0.1)) for r, h in zip(whitened, leverage, strict=True))


def _vibration(
    axis: int, paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...], colour: Colour | None
) -> list[VarianceFinding]:
    """Find a vibration of an axis, or a stick-slip if the axis creeps at one speed.

    At one speed, a saw-tooth in position is also one in time, with harmonics. If its teeth differ in length, the readings also scatter
    along the axis without the vibration (`without_band`).
    """
    line = line_of_axis(axis, paths, rest, sigma_mm, colour)
    if line is None:
        return []
    evidence = float(line.gain - np.log(line.tried * 3.0) - NAME_PRICE)
    location = localize_signal(paths, tuple(np.abs(p.look[:, axis]) for p in paths))
    location = Localization(
        location.tests, (AXES[axis],), location.directions, location.runs, period_s=1.0 / line.frequency_hz, depends_on=("time",)
    )
    sticks = _creeping(axis, paths, rest, sigma_mm, line, evidence, location)
    size, u, parameters = line.amplitude_mm * UM, line.u_mm * UM, {"frequency_hz": line.frequency_hz}
    return sticks or [VarianceFinding("vibration", AXES[axis], size, u, parameters, evidence, location)]


def _creeping(
    axis: int, paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...],
    line: SpectralLine, evidence: float, location: Localization,
) -> list[VarianceFinding]:  # fmt: skip
    """Return the stick-slip of an axis that creeps at one speed, if teeth explain its spectral line, or its scatter beside the line."""
    v = creep_speed(axis, paths)
    if v is None:
        return []
    beside = tuple(without_band(line.frequency_hz, axis, p, r) for p, r in zip(paths, rest, strict=True))
    price = float(np.log(len(AXES)) + NAME_PRICE)
    uneven = scatter_along(axis, paths, beside, sigma_mm).gain - price
    if uneven > 0.0:
        whole = scatter_along(axis, paths, rest, sigma_mm)
        height, evidence = (whole.height_mm, whole.u_mm), max(whole.gain - price, uneven + max(evidence, 0.0))
        location = replace(location, period_s=None, depends_on=())
    elif line.p_harmonics < SAW_P:
        height = (TOOTH * line.amplitude_mm, TOOTH * line.u_mm)
    else:
        return []
    size, u, v_c = at_standstill(height[0] * UM, height[1] * UM, v)
    return [VarianceFinding("stick_slip", AXES[axis], size, u, {"v_c": v_c}, evidence, location)]


def _stick_slip(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> list[VarianceFinding]:
    out = []
    for axis, rough in gated_roughness(paths, rest, sigma_mm).items():
        evidence = rough.gain - np.log(rough.tried * 3.0) - NAME_PRICE
        location = localize_signal(paths, rough.weight)
        location = Localization(location.tests, (AXES[axis],), location.directions, location.runs, depends_on=("speed", "reversal"))
        size, u = rough.size_mm * UM, rough.u_mm * UM
        out.append(VarianceFinding("stick_slip", AXES[axis], size, u, {"v_c": rough.v_c}, float(evidence), location))
    return out


def creeping(paths: tuple[Path, ...], found: VarianceFinding) -> F1:
    """Return 1 for ball-bar readings to which a stick-slip adds scatter (`GATE`), else 0, stacked over the runs, shape (n,)."""
    axis, fast_mm_s = AXES.index(found.key), GATE * found.parameters["v_c"]
    moves = (float(p.kind == "bar" and np.ptp(p.at.q_mm[:, axis]) > 0) for p in paths)
    return np.concatenate([(np.abs(p.at.v_mm_s[:, axis]) < fast_mm_s) * m for p, m in zip(paths, moves, strict=True)])


def teeth_mm2(paths: Sequence[Path], found: VarianceFinding) -> F1:
    """Return the variance that a stick-slip adds to every ball-bar reading, mm^2, stacked over the runs, shape (n,)."""
    bar = np.repeat([float(p.kind == "bar") for p in paths], [p.n for p in paths])
    return bar * tooth_variance(paths, AXES.index(found.key), found.parameters["v_c"]) * (found.strength / UM) ** 2 / 3.0


def rough_place(paths: tuple[Path, ...], key: str) -> tuple[F1, ...]:
    """Return 1 for readings of a quarter of the ball-bar's sphere (``"+X-Y"``: cup to tool towards +X and -Y), else 0, by run."""
    a, b = AXES.index(key[1]), AXES.index(key[3])
    signs = [1.0 if s == "+" else -1.0 for s in key[::2]]
    return tuple(
        np.asarray((signs[0] * p.look[:, a] > 0) & (signs[1] * p.look[:, b] > 0) & (p.kind == "bar"), dtype=np.float64) for p in paths
    )


def _bar_scatter(
    paths: tuple[Path, ...], rest: tuple[F1, ...], off: tuple[F1, ...], sigma_mm: tuple[float, ...], teeth: NDArray[np.bool_]
) -> list[VarianceFinding]:
    """Find a rough place of the ball-bar, and single wrong readings (``off`` is 1) unless most of them lie in the rough place.

    Readings to which a stick-slip adds scatter (``teeth``, stacked over the runs) do not count as wrong: a tooth of its saw-tooth that is
    only one reading long looks like a wrong reading.
    """
    found = _rough_places(paths, tuple(np.clip(r, -CLIPPED, CLIPPED) for r in rest), sigma_mm)
    if found and found[0].evidence > 0.0:
        there = np.concatenate(rough_place(paths, found[0].key))
        wrong = np.concatenate(off)
        if float(there @ wrong) > MOSTLY * float(wrong.sum()):
            return found
    calm = np.split(~teeth, np.cumsum([p.n for p in paths])[:-1])
    wrong_only = tuple(r * o * c for r, o, c in zip(rest, off, calm, strict=True))
    return [*found, *_bar_outliers(paths, wrong_only, int((~teeth).sum()), sigma_mm)]


def _rough_places(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> list[VarianceFinding]:
    """Find the quarter of the sphere in which readings scatter more than in the rest, in the share `IN_RUNS` or more of the runs that pass
    it.

    A deviation of the mean that neighbours share is left out (as in `abbe.models.discovery.variance.spectrum.gated_roughness`).
    """
    best: tuple[float, float, str, tuple[F1, ...]] | None = None
    keys = [f"{s}{AXES[a]}{t}{AXES[b]}" for a, b in ((0, 1), (1, 2), (2, 0)) for s in "+-" for t in "+-"]
    for key in keys:
        there = rough_place(paths, key)
        tried = [(r[r != 0.0], w[r != 0.0] > 0) for r, w in zip(rest, there, strict=True)]
        runs = [(r, w) for r, w in tried if min(w.sum(), (~w).sum()) >= LEAST_INSIDE]
        if len(runs) < LEAST_RUNS:
            continue
        smooth = [(roughness_of(r), w) for r, w in runs]
        louder = [float(np.mean(q[w])) > ROUGHER * float(np.mean(q[~w])) for q, w in smooth]
        alike, times = _two_levels(smooth)
        gain = min(alike / ALIKE, _two_levels([(r**2, w) for r, w in runs])[0])
        if gain > 0.0 and np.mean(louder) >= IN_RUNS and (best is None or gain > best[0]):
            best = (gain, times, key, there)
    if best is None:
        return []
    gain, times, key, there = best
    size = float(np.sqrt(times**2 - 1.0) * np.mean(sigma_mm)) * UM
    shape = f"readings scatter {times:.2g} times as much where the ball-bar points to {key[:2]} {key[2:]}, in most runs"
    location = Localization(localize_signal(paths, there).tests, depends_on=("bar azimuth",), shape=shape)
    evidence = float(gain - np.log(len(keys)) - NAME_PRICE - UNNAMED_PRICE)
    return [VarianceFinding("unnamed_rough", key, size, 0.3 * size, {"times": times}, evidence, location)]


def _two_levels(runs: list[tuple[F1, NDArray[np.bool_]]]) -> tuple[float, float]:
    """Return the gain in log likelihood of two levels of noise over one, and their ratio, from squared readings inside and outside, by run.

    The largest `FEW` squares of a run are left out.
    """
    inside, outside = (np.concatenate([np.sort(q[w == side])[:-FEW] for q, w in runs]) for side in (True, False))
    a, b = float(np.mean(inside)), float(np.mean(outside))
    both = float(np.mean(np.concatenate([inside, outside])))
    gain = -0.5 * (inside.size * np.log(a / both) + outside.size * np.log(b / both)) if a > b else 0.0
    return gain, float(np.sqrt(a / b))


def _bar_outliers(paths: tuple[Path, ...], off: tuple[F1, ...], readings: int, sigma_mm: tuple[float, ...]) -> list[VarianceFinding]:
    """Name single wrong readings of a ball-bar if there are at least `LEAST_OFF`.

    ``off``: whitened residuals of these readings (`abbe.models.discovery.instrument_noise.lone`), one array (n,) per run, all others zero.
    ``readings``: number of readings among which they were looked for.
    The evidence compares normal noise with noise as wide as these readings.
    """
    sizes = np.concatenate([o[o != 0.0] * s for o, s in zip(off, sigma_mm, strict=True)])
    sigmas = np.concatenate([o[o != 0.0] for o in off])
    if sizes.size < LEAST_OFF:
        return []
    width = float(np.sqrt(np.mean(sigmas**2)))
    evidence = sizes.size * (0.5 * (width**2 - 1.0) - np.log(width) - np.log(readings / sizes.size)) - NAME_PRICE
    size = float(np.sqrt(np.mean(sizes**2))) * UM
    found = localize_signal(paths, off)
    location = Localization(found.tests, runs=found.runs)
    u = size / float(np.sqrt(2.0 * sizes.size))
    return [VarianceFinding("bar_outliers", "", size, u, {"rate": sizes.size / readings}, float(evidence), location)]


def _burst(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> list[VarianceFinding]:
    loud = loud_windows(paths, rest)
    if loud is None:
        return []
    gain, tried, k, t0, width, excess = loud
    location = Localization(
        tests=(paths[k].test,), runs=(paths[k].label,), time_s=(t0 - width, t0 + width), depends_on=("time",)
    )  # fmt: skip
    size = float(np.sqrt(2.0 * max(excess, 0.0))) * sigma_mm[k] * UM
    evidence = float(gain - np.log(tried) - NAME_PRICE - BURST_PRICE)
    return [VarianceFinding("unnamed_burst", "", size, 0.3 * size, {"t0_s": t0, "width_s": width}, evidence, location)]


def _outliers(paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> list[VarianceFinding]:
    stacked: F1 = np.concatenate(rest)
    found = contaminated(stacked[stacked != 0.0])
    sigma = float(np.mean(sigma_mm))
    off = np.abs(stacked) > max(OFF, 0.5 * found.size)
    size, u = found.size * sigma * UM, found.u_size * sigma * UM
    weight = tuple(np.asarray(part, dtype=np.float64) for part in np.split(off, np.cumsum([p.n for p in paths])[:-1]))
    location = Localization(tests=tuple(dict.fromkeys(p.test for p in paths)), runs=localize_signal(paths, weight).runs)
    evidence, (bound, (x, y, z)) = float(found.gain - NAME_PRICE), bound_to_places(np.concatenate([p.at.q_mm for p in paths]), stacked, off)
    if bound > PLACE_Z:
        place = replace(location, position_mm=(float(x), float(y), float(z)), radius_mm=NEAR_MM, depends_on=("position",))
        return [VarianceFinding("unnamed_place", "", size, u, {}, evidence, place)]
    return [VarianceFinding("beam_outliers", "", size, u, {"rate": found.rate}, evidence, location)]
