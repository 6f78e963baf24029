"""Seeded random draw of all parameters that are fixed for one machine and one set of instruments.

Error motions are smooth random functions of one axis position: cosines of incommensurable wavelengths plus a few Gaussian bumps, neither
polynomials nor splines, so that no identification by polynomials or splines can be exactly right.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.scenario import AXES, Magnitudes, Pair, Scenario

FEATURES = 8
BUMPS = 3
SHORTEST_STROKES = 0.5
LONGEST_STROKES = 3.0
_GRID = 401  # points on which rms and line are taken


@dataclass(frozen=True, slots=True)
class FunctionSet:
    """Several smooth functions of one position, evaluated together.

    Attributes: ``amplitude``, ``wavenumber`` (rad/mm), ``phase`` of shape (m, FEATURES); ``height``, ``centre_mm``,
    ``width_mm`` of shape (m, BUMPS); ``offset`` and ``slope_per_mm`` of shape (m,): a line added to each, ``offset`` at ``start_mm``.
    """

    amplitude: F
    wavenumber: F
    phase: F
    height: F
    centre_mm: F
    width_mm: F
    offset: F
    slope_per_mm: F
    start_mm: float

    def __call__(self, position_mm: F) -> F:
        """Return the values of the m functions at n positions: shape (n,) in mm gives (n, m)."""
        x = position_mm[:, None]
        m = self.offset.size
        waves = np.cos(x * self.wavenumber.reshape(1, -1) + self.phase.reshape(1, -1)) * self.amplitude.reshape(1, -1)
        distance = (x - self.centre_mm.reshape(1, -1)) / self.width_mm.reshape(1, -1)
        bumps = np.exp(-0.5 * distance * distance) * self.height.reshape(1, -1)
        line: F = self.offset + self.slope_per_mm * (x - self.start_mm)
        total: F = waves.reshape(-1, m, FEATURES).sum(axis=2) + bumps.reshape(-1, m, BUMPS).sum(axis=2) + line
        return total


def draw(rng: np.random.Generator, stroke_mm: tuple[float, float], rms: F, slope_per_mm: F) -> FunctionSet:
    """Draw m functions over a stroke.

    ``rms`` (m,): root mean square of each over the stroke after removal of its own least-squares line; ``slope_per_mm`` (m,): slope of a
    line then added, zero at the start of the stroke. The functions have the unit of ``rms``.
    """
    low, high = stroke_mm
    span = high - low
    shape = (rms.size, FEATURES)
    wavelength = span * np.exp(rng.uniform(np.log(SHORTEST_STROKES), np.log(LONGEST_STROKES), shape))
    raw = FunctionSet(
        amplitude=rng.normal(size=shape) * wavelength / span,
        wavenumber=2.0 * np.pi / wavelength,
        phase=rng.uniform(0.0, 2.0 * np.pi, shape),
        height=rng.normal(scale=0.4, size=(rms.size, BUMPS)),
        centre_mm=rng.uniform(low, high, (rms.size, BUMPS)),
        width_mm=span * rng.uniform(0.12, 0.3, (rms.size, BUMPS)),
        offset=np.zeros(rms.size),
        slope_per_mm=np.zeros(rms.size),
        start_mm=low,
    )
    return _normalised(raw, np.linspace(low, high, _GRID), rms, slope_per_mm)


def _normalised(raw: FunctionSet, grid_mm: F, rms: F, slope_per_mm: F) -> FunctionSet:
    """Scale each function to its rms about its own least-squares line, remove that line and add the wanted slope."""
    values = raw(grid_mm)
    design = np.stack([np.ones_like(grid_mm), grid_mm - raw.start_mm], axis=1)
    line, *_ = np.linalg.lstsq(design, values, rcond=None)
    gain = rms / np.sqrt(np.mean((values - design @ line) ** 2, axis=0))
    return FunctionSet(
        amplitude=raw.amplitude * gain[:, None],
        wavenumber=raw.wavenumber,
        phase=raw.phase,
        height=raw.height * gain[:, None],
        centre_mm=raw.centre_mm,
        width_mm=raw.width_mm,
        offset=-line[0] * gain,
        slope_per_mm=slope_per_mm - line[1] * gain,
        start_mm=raw.start_mm,
    )


UM = 1e-3  # mm
URAD = 1e-6  # rad

# Each purpose has its own generator, so that e.g. one more mount never changes the noise.
STREAM_TRUTH, STREAM_CUP, STREAM_BAR_NOISE, STREAM_MIRROR, STREAM_LASER_NOISE, STREAM_AIR = range(6)


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Return the random generator for a purpose (``stream[0]``, a ``STREAM_*``); further numbers select one event of that purpose."""
    return np.random.default_rng([seed, *stream])


@dataclass(frozen=True, slots=True)
class Draws:
    """The machine's and the instruments' true parameters: mm, rad, s.

    ``motions`` holds per carriage X, Y, Z a set of six functions of its position: EX, EY, EZ (mm), EA, EB, EC (rad). The positioning
    function includes the scale; the straightness functions do not include squareness. ``squareness`` = C0Y, B0Z, A0Z.
    """

    seed: int
    motions: tuple[FunctionSet, FunctionSet, FunctionSet]
    rms: F  # (3, 6) drawn rms values, mm and rad
    scale: F  # (3,) mm/mm
    angle_slope: F  # (3, 3) rad over the stroke, rows X Y Z, columns A B C
    squareness: F  # (3,) rad
    backlash_mm: F  # (3,)
    bar_length_error_mm: float
    bar_noise_mm: float
    laser_noise_mm: float
    drift_mm: F  # (3,) end value
    drift_tau_s: float


def draw_machine(scenario: Scenario) -> Draws:
    """Draw one machine. Equal seeds and magnitudes give the same machine."""
    sizes = scenario.magnitudes
    rng = generator(scenario.seed, STREAM_TRUTH)
    scale = rng.normal(scale=sizes.scale_sd_um_per_m * 1e-6, size=3)
    squareness = rng.normal(scale=sizes.squareness_sd_urad * URAD, size=3)
    backlash = rng.uniform(*sizes.backlash_um, size=3) * UM
    bar_length = float(rng.normal(scale=sizes.bar_length_sd_um * UM))
    bar_noise = float(rng.uniform(*sizes.bar_noise_um) * UM)
    drift = rng.normal(scale=sizes.drift_sd_um * UM, size=3)
    tau_s = float(rng.uniform(*sizes.drift_tau_min) * 60.0)
    rms = np.stack([_axis_rms(rng, sizes, a) for a in range(3)])
    angle_slope = rng.normal(scale=sizes.angle_slope_sd_urad * URAD, size=(3, 3))
    strokes: list[Pair] = [getattr(scenario.machine.stroke_mm, axis) for axis in AXES]
    motions = tuple(draw(rng, strokes[a], rms[a], _slopes(a, scale[a], angle_slope[a], strokes[a])) for a in range(3))
    return Draws(
        seed=scenario.seed,
        motions=(motions[0], motions[1], motions[2]),
        rms=rms,
        scale=scale,
        angle_slope=angle_slope,
        squareness=squareness,
        backlash_mm=backlash,
        bar_length_error_mm=bar_length,
        bar_noise_mm=bar_noise,
        laser_noise_mm=bar_noise * sizes.laser_noise_factor,
        drift_mm=drift,
        drift_tau_s=tau_s,
    )


def _axis_rms(rng: np.random.Generator, sizes: Magnitudes, axis: int) -> F:
    """Return the root mean squares of the six motions of one carriage: (6,), mm and rad."""
    linear = rng.uniform(*sizes.straightness_rms_um, size=3) * UM
    linear[axis] = rng.uniform(*sizes.positioning_rms_um) * UM
    return np.concatenate([linear, rng.uniform(*sizes.angle_rms_urad, size=3) * URAD])


def _slopes(axis: int, scale: float, angle_slope: F, stroke_mm: Pair) -> F:
    """Return the slopes per mm of the six motions of one carriage: (6,). Straightness has none: its slope is squareness."""
    slopes = np.zeros(6)
    slopes[axis] = scale
    slopes[3:] = angle_slope / (stroke_mm[1] - stroke_mm[0])
    return slopes


def describe(draws: Draws) -> dict[str, object]:
    """Return the drawn parameters in µm and µrad, for people."""

    def per_axis(values: F, unit: float) -> dict[str, float]:
        return {axis: round(float(v) / unit, 4) for axis, v in zip(AXES, values, strict=True)}

    return {
        "seed": draws.seed,
        "scale_um_per_m": per_axis(draws.scale, 1e-6),
        "squareness_urad": {k: round(float(v) / URAD, 4) for k, v in zip(("C0Y", "B0Z", "A0Z"), draws.squareness, strict=True)},
        "backlash_um": per_axis(draws.backlash_mm, UM),
        "positioning_rms_um": per_axis(draws.rms[[0, 1, 2], [0, 1, 2]], UM),
        "straightness_rms_um": _named(draws.rms[:, :3], UM, "XYZ", skip_own=True),
        "angle_rms_urad": _named(draws.rms[:, 3:], URAD, "ABC"),
        "angle_slope_urad": _named(draws.angle_slope, URAD, "ABC"),
        "bar_length_error_um": round(draws.bar_length_error_mm / UM, 4),
        "noise_bar_um": round(draws.bar_noise_mm / UM, 4),
        "noise_laser_um": round(draws.laser_noise_mm / UM, 4),
        "drift_um": per_axis(draws.drift_mm, UM),
        "drift_tau_min": round(draws.drift_tau_s / 60.0, 3),
    }


def _named(values: F, unit: float, kinds: str, *, skip_own: bool = False) -> dict[str, float]:
    """Return the values of a (3, 3) block (axis, kind) by names E + kind + axis, in ``unit``."""
    return {
        f"E{kind}{axis}": round(float(values[a, k]) / unit, 4)
        for a, axis in enumerate(AXES)
        for k, kind in enumerate(kinds)
        if not (skip_own and a == k)
    }
