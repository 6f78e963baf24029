"""Effects of the instruments and their set-up. If ``e.wild`` (`Hidden.wild`) is not 0, an effect departs from its textbook form."""

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import MRAD, PPM, UM, URAD, Bend, Hidden, effect
from abbe.simulators.hidden.track import Track

AIR_PPM_PER_K = -0.93
"""Change of a reading, ppm/K: in warmer, thinner air the wavelength is longer, so the laser counts fewer waves on the same path."""
DEAD_PATH_MM = 900.0


@effect("bar_length_error")
def bar_length_error(e: Hidden, track: Track, out: Bend) -> None:
    """Every bar reads ``strength`` um too much; if ``e.wild``, the error varies slightly with the bar's length."""
    if track.kind == "bar":
        out.reading += e["strength"] * UM * (1.0 + e.freedom(0.02, 0.15, 1, signed=True) * (track.radius_mm / 150.0 - 1.0))


@effect("mirror_tilt")
def mirror_tilt(e: Hidden, track: Track, out: Bend) -> None:
    """The mirror is tilted by about ``strength`` urad, differently in every set-up."""
    if track.kind == "laser":
        out.tilt += e["strength"] * URAD * per_setup(e, track.setup)


@effect("laser_cosine")
def laser_cosine(e: Hidden, track: Track, out: Bend) -> None:
    """The beam is misaligned by ``strength`` mrad, in a different direction in every set-up; if ``e.wild``, the angle differs, too."""
    if track.kind == "laser":
        aside = per_setup(e, track.setup)
        size = 1.0 + e.freedom(0.02, 0.12, 1) * float(np.sin(7.0 * aside[0]))
        out.beam += e["strength"] * MRAD * size * aside / np.linalg.norm(aside)


@effect("setup_centre_offset")
def setup_centre_offset(e: Hidden, track: Track, out: Bend) -> None:
    """The cup is offset from the spindle's position by ``strength`` um, in another direction in every set-up.

    The simulation shifts the tool instead.
    """
    if track.kind == "bar" and track.number >= 0:
        away = e.rng(21, zlib_of(track.setup)).normal(size=3)
        out.shift[2] -= e["strength"] * UM * away / np.linalg.norm(away)


def per_setup(e: Hidden, setup: str) -> F:
    """Return the random vector of this set-up, (2,), with a length of 0.6 to 1.3."""
    rng = e.rng(22, zlib_of(setup))
    angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.6, 1.3)
    return length * np.array([np.cos(angle), np.sin(angle)])


def zlib_of(text: str) -> int:
    """Return a number for a name, the same in every process."""
    return int.from_bytes(text.encode()[:8], "big")


def air_rise(e: Hidden, t_s: F) -> F:
    """Return actual minus assumed temperature of the air, K, (n,): a wave of amplitude ``strength``; if ``e.wild``, two waves."""
    wave = np.sin(2.0 * np.pi * t_s / e["period_s"] + e["phase"])
    return np.asarray(e["strength"] * (wave + e.freedom(0.05, 0.25, 1) * np.sin(2.0 * np.pi * t_s / (0.31 * e["period_s"]) + e["phase"])))


@effect("air_refraction")
def air_refraction(e: Hidden, track: Track, out: Bend) -> None:
    """The laser reads a path too short while the air is warmer than the laser assumes, and too long while the air is colder."""
    if track.kind == "laser":
        out.reading += AIR_PPM_PER_K * PPM * air_rise(e, track.t_s) * track.reach_mm


@effect("dead_path")
def dead_path(e: Hidden, track: Track, out: Bend) -> None:
    """The dead path, from laser to zero position, lies in air that warms by ``strength`` K/h; if ``e.wild``, unevenly."""
    if track.kind == "laser":
        hours = (track.t_s - track.t_s[0]) / 3600.0
        uneven = hours * (1.0 + e.freedom(0.1, 0.4, 1, signed=True) * (hours / 0.1 - 0.5))
        out.reading += AIR_PPM_PER_K * PPM * DEAD_PATH_MM * e["strength"] * uneven


@effect("beam_outliers")
def beam_outliers(e: Hidden, track: Track, out: Bend) -> None:
    """A share ``rate`` of the laser's readings is wrong by about ``strength`` um, with either sign."""
    if track.kind == "laser":
        rng = e.rng(23, track.number)
        hit = rng.random(track.n) < e["rate"]
        hit[0] = False
        size = rng.uniform(0.6, 1.6, track.n) * rng.choice([-1.0, 1.0], track.n)
        out.reading += np.where(hit, e["strength"] * UM * size, 0.0)
