"""Effects outside the catalogue of effects. If ``e.wild`` (`Hidden.wild`) is not 0, an effect departs from its textbook form."""

import numpy as np

from abbe.simulators.hidden.effect import UM, URAD, Bend, Hidden, effect
from abbe.simulators.hidden.track import Track


@effect("clamp_slip")
def clamp_slip(e: Hidden, track: Track, out: Bend) -> None:
    """At t0_s the clamp slips: from then on the workpiece is rotated by ``strength`` urad about the origin, around a random axis."""
    after = track.t_s >= e["t0_s"]
    axis = e.rng(31).normal(size=3)
    turn = e["strength"] * URAD * axis / np.linalg.norm(axis)
    out.shift[2] += np.where(after[:, None], np.cross(turn, track.q_mm), 0.0)


@effect("encoder_count_loss")
def encoder_count_loss(e: Hidden, track: Track, out: Bend) -> None:
    """At t0_s an encoder loses counts: from then on the axis is ``strength`` um away from its commanded position."""
    out.drive[:, e.axis] = np.where(track.t_s >= e["t0_s"], e["strength"] * UM, 0.0)


@effect("local_bump")
def local_bump(e: Hidden, track: Track, out: Bend) -> None:
    """A local bump displaces the tool along one axis: by ``strength`` um at (cx, cy, cz), with Gaussian width w_mm around it."""
    away = track.q_mm - np.array([e["cx"], e["cy"], e["cz"]])
    out.shift[2, :, e.axis] += e["strength"] * UM * np.exp(-0.5 * np.sum(away * away, axis=1) / e["w_mm"] ** 2)


@effect("ball_form")
def ball_form(e: Hidden, track: Track, out: Bend) -> None:
    """The ball is not round: ``lobes`` waves of ``strength`` um over the bar's direction in the XY plane, weaker for a steeper bar."""
    if track.kind == "bar":
        around = np.arctan2(track.look[:, 1], track.look[:, 0])
        level = track.look[:, 0] ** 2 + track.look[:, 1] ** 2
        out.reading += e["strength"] * UM * level * np.cos(e["lobes"] * around + e["phase"])


@effect("interference_burst")
def interference_burst(e: Hidden, track: Track, out: Bend) -> None:
    """Electrical interference: for about width_s around t0_s the bar's readings swing by ``strength`` um at f_hz."""
    if track.kind == "bar":
        away = track.t_s - e["t0_s"]
        swing = np.sin(2.0 * np.pi * e["f_hz"] * away + e.rng(32).uniform(0.0, 6.28))
        out.reading += e["strength"] * UM * np.exp(-0.5 * (away / e["width_s"]) ** 2) * swing


@effect("counterbalance_surge")
def counterbalance_surge(e: Hidden, track: Track, out: Bend) -> None:
    """The counterbalance moves the vertical axis up and down by ``strength`` um with period period_s; if ``e.wild``, not as a sine."""
    if track.number >= 0:
        angle = 2.0 * np.pi * track.t_s / e["period_s"] + e["phase"]
        wave = np.sin(angle) + e.freedom(0.2, 0.6, 1) * np.sin(2.0 * angle + e.freedom(0.0, 6.0, 2))
        out.drive[:, track.vertical] += e["strength"] * UM * wave
