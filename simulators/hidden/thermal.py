"""Thermal effects: bodies that warm up from power-on (time 0 of the campaign clock), and the displacements by them.

If ``e.wild`` (`Hidden.wild`) is not 0, an effect departs from its textbook form.
"""

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import PPM, UM, URAD, Bend, Hidden, effect, middle
from abbe.simulators.hidden.track import Track

STEEL_PPM = 11.5


def warmth(t_s: F, tau_s: float, *, slow_share: float = 0.0, slow_s: float = 1.0) -> F:
    """Return the temperature rise of a body under constant heat since power-on, as a fraction of its final rise, (n,).

    The rise is a weighted sum of two exponential rises, with time constants ``tau_s`` and ``slow_s``; ``slow_share``: weight of the second.
    """
    order = np.argsort(t_s, kind="stable")
    out = np.empty(len(t_s))
    quick = slow = now = 0.0
    for i in order.tolist():
        step = max(float(t_s[i]) - now, 0.0)
        quick += (1.0 - quick) * -np.expm1(-step / tau_s)
        slow += (1.0 - slow) * -np.expm1(-step / slow_s)
        now = max(now, float(t_s[i]))
        out[i] = (1.0 - slow_share) * quick + slow_share * slow
    return out


def rise(e: Hidden, t_s: F) -> F:
    """Return the temperature rise of an effect's body as a fraction of its final rise; if ``e.wild``, with a second time constant."""
    ratio = float(np.exp(e.freedom(0.6, 1.4, 11, signed=True)))
    return warmth(t_s, e["tau_s"], slow_share=e.freedom(0.15, 0.6, 12), slow_s=e["tau_s"] * ratio)


@effect("axis_thermal_growth")
def axis_thermal_growth(e: Hidden, track: Track, out: Bend) -> None:
    """The screw warms up, finally by ``strength`` K, and grows from x_fixed; if ``e.wild``, unevenly: warmer where the nut works."""
    a = e.axis
    x = track.q_mm[:, a]
    span = track.high_mm[a] - track.low_mm[a]
    away = (x - e["x_fixed"]) / span
    bow = e.freedom(0.05, 0.2, 1, signed=True) * (away * np.abs(away) - away)
    out.drive[:, a] = STEEL_PPM * PPM * e["strength"] * rise(e, track.t_s) * span * (away + bow)


@effect("spindle_thermal_drift")
def spindle_thermal_drift(e: Hidden, track: Track, out: Bend) -> None:
    """Spindle and head displace the tool along one axis, finally by ``strength`` um."""
    out.shift[2, :, e.axis] = e["strength"] * UM * rise(e, track.t_s)


@effect("squareness_thermal")
def squareness_thermal(e: Hidden, track: Track, out: Bend) -> None:
    """One squareness changes, finally by ``strength`` urad: C0Y (XY), B0Z (ZX) or A0Z (YZ); if ``e.wild``, the column bends as it tilts."""
    carriage, direction, sign = {"XY": (1, 0, -1.0), "ZX": (2, 0, 1.0), "YZ": (2, 1, -1.0)}[e.key]
    place = middle(track, carriage)
    half = 0.5 * (track.high_mm[carriage] - track.low_mm[carriage])
    arm = track.q_mm[:, carriage] + half * e.freedom(0.0, 0.2, 1, signed=True) * (place * place - 1.0)
    out.shift[carriage, :, direction] = sign * e["strength"] * URAD * rise(e, track.t_s) * arm


@effect("bar_thermal")
def bar_thermal(e: Hidden, track: Track, out: Bend) -> None:
    """The bar is ``strength`` K too warm from the hand when a set-up begins, so it is longer and reads too little.

    If ``e.wild``, the excess varies from set-up to set-up, and two time constants act.
    """
    if track.kind != "bar":
        return
    hand = 1.0 + e.freedom(0.02, 0.15, 1, signed=True) * float(np.sin(track.set_s))
    left = 1.0 - warmth(track.t_s - track.set_s, e["tau_s"], slow_share=e.freedom(0.1, 0.3, 2), slow_s=2.5 * e["tau_s"])
    out.reading -= STEEL_PPM * PPM * track.radius_mm * e["strength"] * hand * left
