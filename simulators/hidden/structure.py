"""Effects of slides, bed and ram: play across the travel, a bed that bends, sag, error motions beyond the present model.

If ``e.wild`` (`Hidden.wild`) is not 0, an effect departs from its textbook form.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import UM, URAD, Bend, Hidden, effect, middle
from abbe.simulators.hidden.track import Track


@effect("lateral_play")
def lateral_play(e: Hidden, track: Track, out: Bend) -> None:
    """A carriage steps sideways by ``strength`` um when it reverses; if ``e.wild``, gradually, and more at one end of the guide."""
    a = e.axis
    half = 0.5 * e["strength"] * UM * (1.0 + e.freedom(0.05, 0.3, 1, signed=True) * middle(track, a))
    over = e.freedom(0.02, 0.4, 2) or 1e-9
    crossed = 1.0 - 2.0 * np.exp(-np.minimum(track.since_mm[:, a] / over, 60.0)) if e.wild else np.ones(track.n)
    out.shift[a, :, e.component] = half * track.sign[:, a] * crossed


@effect("nonrigid_bed")
def nonrigid_bed(e: Hidden, track: Track, out: Bend) -> None:
    """A straightness error that changes sign along the ``other`` axis: A sin(pi x / L)(2 y / L_y - 1); if ``e.wild``, not symmetric."""
    a, other = e.axis, int(e["other"])
    x = 0.5 * (middle(track, a) + 1.0)
    across = middle(track, other)
    bow = np.sin(np.pi * x) + e.freedom(0.1, 0.35, 1, signed=True) * np.sin(2.0 * np.pi * x)
    across = across + e.freedom(0.1, 0.3, 2, signed=True) * (across * across - 1.0 / 3.0)
    out.shift[a, :, e.component] = e["strength"] * UM * bow * across


@effect("ram_sag")
def ram_sag(e: Hidden, track: Track, out: Bend) -> None:
    """The ram (axis Z) sinks as it extends: -A z^2 (1 + beta y), z = 0 to 1, y = -1 to 1 (height), A = ``strength`` um.

    The ram sinks along gravity and tilts by the slope of this curve. If ``e.wild``, the curve has a cubic part. No effect if Z is vertical.
    """
    if track.vertical == 2:
        return
    down = track.vertical
    span = track.high_mm[2] - track.low_mm[2]
    z = (track.q_mm[:, 2] - track.low_mm[2]) / span
    height = middle(track, down) * e["beta"]
    cubic = e.freedom(0.1, 0.3, 1, signed=True)
    a = e["strength"] * UM
    out.shift[2, :, down] = -a * (z * z * (1.0 - cubic) + cubic * z**3) * (1.0 + height)
    out.angle[2, :, 0] = a / span * (2.0 * z * (1.0 - cubic) + 3.0 * cubic * z * z) * (1.0 + height)


WAVES = 6


@dataclass(frozen=True, slots=True)
class Curve:
    """A smooth function of position, drawn from a seed as a sum of long waves, with rms 1 about its mean over the stroke."""

    seed: int
    low_mm: float
    high_mm: float

    def __call__(self, position_mm: F) -> F:
        """Return the values at n positions, (n,)."""
        rng = np.random.default_rng([43, self.seed])
        length = np.exp(rng.uniform(np.log(0.8), np.log(4.0), WAVES))
        size, phase = rng.normal(size=WAVES) * np.minimum(length, 2.0), rng.uniform(0.0, 2.0 * np.pi, WAVES)

        def raw(part: F) -> F:
            return np.asarray(np.cos(2.0 * np.pi * part[:, None] / length + phase) @ size)

        grid = raw(np.linspace(0.0, 1.0, 201))
        return np.asarray((raw((position_mm - self.low_mm) / (self.high_mm - self.low_mm)) - grid.mean()) / grid.std())


def curve(e: Hidden, track: Track) -> F:
    """Return the effect's smooth function along its axis, (n,)."""
    a = e.axis
    return Curve(int(e["seed"]), float(track.low_mm[a]), float(track.high_mm[a]))(track.q_mm[:, a])


@effect("straightness")
def straightness(e: Hidden, track: Track, out: Bend) -> None:
    """A carriage deviates from a straight line by ``strength`` um rms over the stroke."""
    out.shift[e.axis, :, e.component] = e["strength"] * UM * curve(e, track)


@effect("positioning_nonlinear")
def positioning_nonlinear(e: Hidden, track: Track, out: Bend) -> None:
    """The positioning error of an axis is not linear: ``strength`` um rms over the stroke."""
    out.drive[:, e.axis] = e["strength"] * UM * curve(e, track)


@effect("angular_error")
def angular_error(e: Hidden, track: Track, out: Bend) -> None:
    """A carriage pitches, rolls or yaws about its pivot by ``strength`` urad rms over the stroke."""
    out.angle[e.axis, :, e.component] = e["strength"] * URAD * curve(e, track)
