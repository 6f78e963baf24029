"""Effects of the drives: lost motion, quadrant glitches, cyclic errors, servo lag, friction, vibration.

If ``e.wild`` (`Hidden.wild`) is not 0, an effect departs from its textbook form.
"""

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import MS, UM, Bend, Hidden, effect, middle
from abbe.simulators.hidden.track import Track, carriage_mm


@effect("backlash")
def backlash(e: Hidden, track: Track, out: Bend) -> None:
    """Lost motion of width ``strength`` um; if ``e.wild``, a part is elastic wind-up that gives way over tenths of a millimetre."""
    width, soft = e["strength"] * UM, e.freedom(0.1, 0.35, 1)
    out.drive[:, e.axis] = carriage_mm(track, e.axis, lambda x: np.full(x.shape, 0.5 * width * (1.0 - soft)))
    out.drive[:, e.axis] += wind_up(track, e.axis, soft * width, e.freedom(0.1, 0.8, 2) or 1.0)


@effect("backlash_position_dependent")
def backlash_position_dependent(e: Hidden, track: Track, out: Bend) -> None:
    """Lost motion of width strength (1 + k x), x = -1 to 1 over the stroke; if ``e.wild``, also a term in x^2, and part is wind-up."""
    a, k, bow, soft = e.axis, e["k"], e.freedom(0.05, 0.3, 1, signed=True), e.freedom(0.0, 0.3, 2)
    low, high = track.low_mm[a], track.high_mm[a]

    def half(x: F) -> F:
        place = (2.0 * x - low - high) / (high - low)
        return np.asarray(0.5 * e["strength"] * UM * (1.0 - soft) * (1.0 + k * place + bow * (place * place - 1.0 / 3.0)))

    out.drive[:, a] = carriage_mm(track, a, half)
    out.drive[:, a] += wind_up(track, a, soft * e["strength"] * UM * (1.0 + k * middle(track, a)), e.freedom(0.1, 0.8, 3) or 1.0)


def wind_up(track: Track, axis: int, width_mm: float | F, over_mm: float) -> F:
    """Return the elastic lag behind the motion, (n,) mm; after a reversal it changes sign within about ``over_mm`` of travel."""
    rest = np.exp(-np.minimum(track.since_mm[:, axis] / over_mm, 60.0))
    return np.asarray(-0.5 * width_mm * track.sign[:, axis] * (1.0 - 2.0 * rest))


@effect("reversal_spike")
def reversal_spike(e: Hidden, track: Track, out: Bend) -> None:
    """Friction holds the axis back after a reversal. The lag is ``strength`` um at 1000 mm/min and grows as feed^p.

    The lag rises within a small part of d0_mm and decays over d0_mm; if ``e.wild``, it depends on the direction, and its decay has a tail.
    """
    if not track.moving:
        return
    a = e.axis
    x = np.minimum(track.since_mm[:, a] / (e["d0_mm"] * (1.0 + e.freedom(0.0, 0.2, 1, signed=True))), 1e3)
    height = e["strength"] * UM * (track.feed_mm_min / 1000.0) ** e["p"]
    tail = e.freedom(0.0, 0.15, 2)
    held = -np.expm1(-10.0 * x) * ((1.0 - tail) * np.exp(-np.minimum(x**1.2, 60.0)) + tail * np.exp(-np.minimum(x / 3.0, 60.0)))
    side = 1.0 + e.freedom(0.1, 0.35, 3, signed=True) * track.sign[:, a]
    out.drive[:, a] = -track.sign[:, a] * height * side * held


@effect("cyclic_error")
def cyclic_error(e: Hidden, track: Track, out: Bend) -> None:
    """Add waves with the screw's pitch and half of it to an axis; if ``e.wild``, they vary along the screw and have a third harmonic."""
    a = e.axis
    x, place = track.q_mm[:, a], middle(track, a)
    angle = 2.0 * np.pi * x / e["pitch_mm"] + e.freedom(0.2, 1.0, 1, signed=True) * np.sin(2.0 * place + e.freedom(0.0, 6.0, 2))
    swell = 1.0 + e.freedom(0.1, 0.35, 3) * np.sin(1.5 * place + e.freedom(0.0, 6.0, 4))
    wave = np.sin(angle + e["ph1"]) + e["r2"] * np.sin(2.0 * angle + e["ph2"]) + e.freedom(0.0, 0.1, 5) * np.sin(3.0 * angle)
    out.drive[:, a] = e["strength"] * UM * swell * wave


NODES, WEIGHTS = np.polynomial.laguerre.laggauss(10)


def lagging(track: Track, lag_s: float, second: float) -> F:
    """Return actual minus commanded axis positions, (n, 3) mm, when the axes follow the command through a second-order loop.

    The loop's time constants are a = lag_s (1 - second) and b = lag_s second. The commanded course is convolved with the impulse response
    (exp(-s/a) - exp(-s/b)) / (a - b) by Gauss-Laguerre quadrature.
    """
    if track.course is None or lag_s == 0.0:
        return np.zeros((track.n, 3))
    slow, fast = lag_s * (1.0 - second), lag_s * second
    out = np.zeros((track.n, 3))
    parts = ((slow, slow / (slow - fast)), (fast, fast / (fast - slow))) if fast else ((slow, 1.0),)
    for time, share in parts:
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            out += share * weight * track.course(track.t_s - time * node)
    return np.asarray(out - track.q_mm)


@effect("contour_lag")
def contour_lag(e: Hidden, track: Track, out: Bend) -> None:
    """All axes trail by ``strength`` ms; if ``e.wild``, part of it is a second, faster lag of the current loop."""
    second = e.freedom(0.05, 0.25, 1)
    # a circle shrinks with the second moment of the impulse response: this scaling keeps it at 2 strength^2
    out.drive += lagging(track, e["strength"] * MS / np.sqrt(1.0 - second + second * second), second)


@effect("servo_mismatch")
def servo_mismatch(e: Hidden, track: Track, out: Bend) -> None:
    """One axis trails the others by ``strength`` ms (negative: it leads); if ``e.wild``, the lag depends on speed."""
    a = e.axis
    stiff = e.freedom(0.05, 0.25, 1, signed=True)
    lag = lagging(track, e["strength"] * MS, e.freedom(0.0, 0.2, 2))[:, a]
    out.drive[:, a] = lag * (1.0 + stiff * (np.abs(track.v_mm_s[:, a]) / 40.0 - 0.5))


@effect("stick_slip")
def stick_slip(e: Hidden, track: Track, out: Bend) -> None:
    """Well below the speed v_c (mm/s) the axis sticks and jumps: a saw-tooth of amplitude ``strength`` um every period_mm of travel.

    The amplitude falls with speed as exp(-(v / v_c)^2) (Stribeck friction) and is 0 at standstill. The phase follows the travel, from a
    random start; if ``e.wild``, the teeth differ in length.
    """
    if not track.moving:
        return
    a = e.axis
    start = e.rng(7, track.number).uniform(0.0, 1.0)
    teeth = track.travelled_mm[:, a] / e["period_mm"] + start
    teeth += e.freedom(0.1, 0.6, 1) * np.sin(0.7 * teeth + start)
    speed = np.abs(track.v_mm_s[:, a])
    gate = np.where(speed < 1e-3, 0.0, np.exp(-((speed / e["v_c"]) ** 2)))
    out.drive[:, a] = -track.sign[:, a] * e["strength"] * UM * gate * (2.0 * (teeth % 1.0) - 1.0)


@effect("vibration")
def vibration(e: Hidden, track: Track, out: Bend) -> None:
    """The axis vibrates at f_hz while the machine moves, with another phase in every run; if ``e.wild``, the amplitude varies slowly."""
    if not track.moving:
        return
    rng = e.rng(7, track.number)
    t = track.t_s - track.start_s
    breath = 1.0 + e.freedom(0.1, 0.4, 1) * np.sin(2.0 * np.pi * t / 17.0 + rng.uniform(0.0, 6.28))
    out.drive[:, e.axis] = e["strength"] * UM * breath * np.sin(2.0 * np.pi * e["f_hz"] * t + rng.uniform(0.0, 6.28))
