"""Signals of structures without a name: readings by kind of structure, whatever its cause."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.effects.effect import Signal, Values
from abbe.models.effects.path import Path, Places
from abbe.models.functions.legendre import legendre_values
from abbe.models.machine import AXES

UM = 1e-3
"""Columns are mm per micrometre."""
SMOOTH_ORDERS = (2, 3, 4, 5, 6)
ODD_ORDERS = (1, 2, 3)
"""Without the constant: a jump at every reversal has a name, and a structure that includes it would replace the name."""
ARM_MM = 300.0
"""Rotations of a slip are stated as displacements at this distance, so that all its columns are in micrometres."""


def smooth(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """``"EYX"``: any smooth function of X in direction Y, Legendre orders 2 to 6 over the stroke."""
    return [p.read(lambda at, p=p: _along(key[1], _orders(p, at, key[2], SMOOTH_ORDERS))) for p in paths]  # type: ignore[misc]


def odd(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """A smooth function times the direction of the axis' last motion, orders 1 to 3."""

    def deviation(p: Path, at: Places) -> F3:
        return _along(key[1], at.sign[:, AXES.index(key[2]), None] * _orders(p, at, key[2], ODD_ORDERS))

    return [p.read(lambda at, p=p: deviation(p, at)) for p in paths]  # type: ignore[misc]


def wave(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """``"EYX"``: a wave of ``pitch_mm`` along X in direction Y."""
    axis = AXES.index(key[2])
    return [p.read(lambda at: _along(key[1], _turns(at.q_mm[:, axis] / values["pitch_mm"]))) for p in paths]


def surge(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """A wave of ``period_s`` on the clock: of an axis (``"X"``), or of the reading itself of ``"bar"`` or ``"laser"``."""
    period = values["period_s"]
    if key in AXES:
        return [p.read(lambda at: _along(key, _turns(at.t_s / period))) for p in paths]
    return [UM * (_turns(p.at.t_s / period) - _turns(p.reference.t_s / period)) if p.kind == key else np.zeros((p.n, 2)) for p in paths]


def step(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """A constant offset of one axis from ``t0_s`` on."""
    return [p.read(lambda at: _along(key, (at.t_s >= values["t0_s"]).astype(np.float64)[:, None])) for p in paths]


def slip(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """The work moves and turns at ``t0_s`` (a clamp gave way): three translations, three rotations about the middle of the strokes."""

    def deviation(p: Path, at: Places) -> F3:
        arm = (at.q_mm - p.machine.centre_mm) / ARM_MM
        turned = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
        moved = np.broadcast_to(np.eye(3), turned.shape)
        return np.asarray(UM * np.concatenate([moved, turned], axis=2) * (at.t_s >= values["t0_s"])[:, None, None])

    return [p.read(lambda at, p=p: deviation(p, at)) for p in paths]  # type: ignore[misc]


def settling(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """One axis drifts from ``t0_s`` on and settles with time constant ``tau_s``."""

    def gone(t_s: F1) -> F2:
        return np.asarray(-np.expm1(-np.maximum(t_s - values["t0_s"], 0.0) / values["tau_s"]))[:, None]

    return [p.read(lambda at: _along(key, gone(at.t_s))) for p in paths]


def bump(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Deviation in any direction near one place: where the campaign's path is at ``at_s``, Gaussian of ``width_mm``."""
    centre = place_at(paths, values["at_s"])

    def deviation(at: Places) -> F3:
        height = np.exp(-0.5 * np.sum((at.q_mm - centre) ** 2, axis=1) / values["width_mm"] ** 2)
        return np.asarray(UM * height[:, None, None] * np.eye(3))

    return [p.read(deviation) for p in paths]


def place_at(paths: tuple[Path, ...], at_s: float) -> F1:
    """Commanded position at a time of the campaign's clock, between readings by interpolation, between runs that of the nearest one."""

    def apart(p: Path) -> float:
        return max(float(p.at.t_s[0]) - at_s, at_s - float(p.at.t_s[-1]), 0.0)

    p = min(paths, key=apart)
    return np.array([np.interp(at_s, p.at.t_s, p.at.q_mm[:, k]) for k in range(3)])


def lobes(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """``"Z3"``: three lobes of the ball around Z, the same at every place: a wave in the bar's azimuth, as such and fading to the poles."""
    polar, number = AXES.index(key[0]), int(key[1:])
    return [UM * _lobed(p.look, polar, number) if p.kind == "bar" else np.zeros((p.n, 2)) for p in paths]


def lobe_latitude(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Freedom of form of lobes: their height differs with the bar's latitude."""
    polar, number = AXES.index(key[0]), int(key[1:])
    return [UM * _lobed(p.look, polar, number) * p.look[:, polar, None] if p.kind == "bar" else np.zeros((p.n, 2)) for p in paths]


def _lobed(look: F2, polar: int, number: int) -> F2:
    a, b = (polar + 1) % 3, (polar + 2) % 3
    azimuth = np.arctan2(look[:, b], look[:, a])
    return np.stack([np.cos(number * azimuth), np.sin(number * azimuth)], axis=1)


def burst(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """A ball-bar's reading oscillates with ``frequency_hz`` about ``t0_s``, under a Gaussian of standard deviation ``width_s``."""
    out = []
    for p in paths:
        since = p.at.t_s - values["t0_s"]
        near = np.exp(-0.5 * (since / values["width_s"]) ** 2)[:, None] * float(p.kind == "bar")
        out.append(np.asarray(UM * near * _turns(since * values["frequency_hz"])))
    return out


def _orders(p: Path, at: Places, axis: str, orders: tuple[int, ...]) -> F2:
    a = AXES.index(axis)
    return legendre_values(at.q_mm[:, a], p.machine.stroke_mm[a], max(orders))[:, list(orders)]


def _turns(turns: F1) -> F2:
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)


def _along(direction: str, columns: F2) -> F3:
    out = np.zeros((len(columns), 3, columns.shape[1]))
    out[:, AXES.index(direction), :] = UM * columns
    return out


SIGNALS: dict[str, Signal] = {
    "unnamed_smooth": smooth, "unnamed_odd": odd, "unnamed_wave": wave, "unnamed_surge": surge, "unnamed_step": step,
    "unnamed_slip": slip, "unnamed_settling": settling, "unnamed_bump": bump, "unnamed_lobes": lobes, "unnamed_burst": burst,
}  # fmt: skip
