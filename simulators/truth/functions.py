"""Smooth random functions of one axis position: the shapes of the error motions.

They are cosines of incommensurable wavelengths plus a few Gaussian bumps: neither polynomials nor splines, so that no
identification whose basis is one of those can be exactly right.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F

FEATURES = 8
BUMPS = 3
SHORTEST_STROKES = 0.5
LONGEST_STROKES = 3.0
_GRID = 401  # points on which rms and line are taken


@dataclass(frozen=True, slots=True)
class FunctionSet:
    """Several smooth functions of one position, evaluated together.

    Attributes: ``amplitude``, ``wavenumber`` (rad/mm), ``phase`` of shape (m, FEATURES); ``height``, ``centre_mm``,
    ``width_mm`` of shape (m, BUMPS); ``offset`` and ``slope_per_mm`` of shape (m,), a line added on top, about ``start_mm``.
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
        """Values of the m functions at n positions: shape (n,) in mm gives (n, m)."""
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

    ``rms`` (m,) is the root mean square of each over the stroke after its own least-squares line is removed;
    ``slope_per_mm`` (m,) the slope of a line then added (zero at the start of the stroke). Units of the result are those of ``rms``.
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
    """Scale each function to its rms about its own line, take that line away and add the wanted slope."""
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
