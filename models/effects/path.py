"""A run as effects need it: positions, velocities, reversals, clock, and measuring direction of the instrument."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.chain import REST_MM, travel_sign
from abbe.models.machine import Machine

Kind = Literal["bar", "laser"]
FAR_MM = 1e9
"""Travel since the last reversal of an axis that has not reversed yet."""


@dataclass(frozen=True)
class Places:
    """Position and motion of the tool, one row per time: all that an effect of the machine may depend on.

    Attributes
    ----------
    q_mm : array, shape (n, 3)
        Commanded positions.
    sign : array, shape (n, 3)
        Direction of the last motion of each axis, -1, 0 (never moved) or +1.
    since_mm : array, shape (n, 3)
        Travel of each axis since its last reversal (`FAR_MM` before the first).
    v_mm_s, a_mm_s2 : array, shape (n, 3)
        Commanded velocity and acceleration; zero where the machine dwells.
    t_s : array, shape (n,)
        Campaign clock.
    temp_c : dict
        Temperatures that the run holds, by sensor ("x", "y", "z", "spindle", "air"), shape (n,) each; empty: no sensors.
    """

    q_mm: F2
    sign: F2
    since_mm: F2
    v_mm_s: F2
    a_mm_s2: F2
    t_s: F1
    temp_c: Mapping[str, F1]

    @cached_property
    def commanded_turns(self) -> tuple[F2, F2]:
        """Direction of the last motion and travel since the last turn, shape (n, 3) each, where axes turn at a commanded position.

        A machine that dwells turns where ``sign`` and ``since_mm`` say: it may have gone beyond a place and come back.
        """
        n = len(self.t_s)
        if n < 2 or not self.v_mm_s.any():
            return self.sign, self.since_mm
        came_mm = run_in(self.q_mm) if n > 2 else self.q_mm
        sign = travel_sign(came_mm)
        return sign[-n:], since_reversal(came_mm, sign)[-n:]


@dataclass(frozen=True)
class Path:
    """One run without its readings.

    Attributes
    ----------
    label, setup, test : names of run, set-up and test (run-format.md 3).
    kind : "bar" | "laser"
    machine : Machine
        With the tool of this run.
    vertical : int
        Index of the axis that gravity acts along (run-format.md 1, ``vertical_axis``).
    at : Places
        The path itself.
    reference : Places
        Zero of the reading, one row: cup set with the spindle (bar: at the centre, at ``t_set_s``, standing, from
        no known direction), or the first record (laser).
    look : array, shape (n, 3)
        Direction of measurement, unit vector: cup to tool, or beam; change of the reading per mm of deviation, to first order.
    feed_mm_min, direction : array, shape (n,)
    travel_mm : array, shape (n,)
        Nominal displacement along the beam since the first record; zero for a bar.
    t_set_s : float
        When the set-up was mounted and zeroed, campaign clock.
    dead_path_mm : float
        Laser path outside of the measured travel.
    radius_mm, centre_mm : of the bar; 0 and zeros for a laser.
    """

    label: str
    setup: str
    test: str
    kind: Kind
    machine: Machine
    vertical: int
    at: Places
    reference: Places
    look: F2
    feed_mm_min: F1
    direction: F1
    travel_mm: F1
    t_set_s: float
    dead_path_mm: float
    radius_mm: float
    centre_mm: F1

    @property
    def n(self) -> int:
        """Number of readings."""
        return len(self.at.t_s)

    def read(self, deviation: Callable[[Places], F3]) -> F2:
        """Reading of a deviation of the tool from the workpiece, first order (effects.md, "First-order observables").

        Parameters
        ----------
        deviation : function of `Places`
            Deviation in machine coordinates, shape (rows, 3, k), mm per unit of each of k coefficients.

        Returns
        -------
        array, shape (n, k)
            Reading, mm: ``look . (deviation at the place - deviation at the reference)``.
        """
        return np.asarray(np.einsum("ni,nik->nk", self.look, deviation(self.at) - deviation(self.reference)))


def read_together(paths: Sequence[Path], deviation: Callable[[Places], F3]) -> list[F2]:
    """`Path.read` of all runs at once, for a deviation that depends on every row of `Places` alone and on no temperature."""
    if not paths:
        return []
    found = deviation(_joined([*(p.at for p in paths), *(p.reference for p in paths)]))
    n = [p.n for p in paths]
    zero = np.repeat(found[sum(n) :], n, axis=0)
    reading = np.einsum("ni,nik->nk", np.concatenate([p.look for p in paths]), found[: sum(n)] - zero)
    return np.split(reading, np.cumsum(n)[:-1])


def _joined(parts: Sequence[Places]) -> Places:
    """One after the other, without temperatures."""
    columns = [[p.q_mm, p.sign, p.since_mm, p.v_mm_s, p.a_mm_s2] for p in parts]
    q, sign, since, v, a = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Places(q, sign, since, v, a, np.concatenate([p.t_s for p in parts]), {})


RUN_IN = 2
"""Positions before the first reading that are made up from the motion after it."""


def driven(q_mm: F2, t_s: F1, feed_mm_min: F1, *, dwelling: bool, temp_c: Mapping[str, F1]) -> Places:
    """Places of a sequence of commanded positions.

    A moving axis turns between two samples; where, is read from the velocities on both sides (constant acceleration between them), because
    the travel since then decides what backlash and friction do to the next samples.

    Parameters
    ----------
    dwelling : bool
        The machine stands at every position (step tests): no velocity, no acceleration. Else velocity is the motion between samples,
        scaled to the commanded feed where the samples are rounded.
    """
    v, a = np.zeros_like(q_mm), np.zeros_like(q_mm)
    if dwelling or len(t_s) < 3:
        sign = travel_sign(q_mm)
        return Places(q_mm, sign, since_reversal(q_mm, sign), v, a, t_s, temp_c)
    v = np.asarray(scipy.interpolate.CubicSpline(t_s, q_mm, axis=0)(t_s, 1))  # chords are shorter than arcs: 2 % near a helix's pole
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    v *= np.divide(feed_mm_min[:, None] / 60.0, speed, out=np.ones_like(speed), where=speed > 0)
    a = np.gradient(v, t_s, axis=0, edge_order=2)
    came_mm = run_in(q_mm)
    step = np.gradient(came_mm, axis=0, edge_order=2)
    sign = travel_sign(np.cumsum(np.concatenate([np.zeros((1, 3)), step]), axis=0))[1:]
    since = since_reversal(came_mm, sign, step)
    return Places(q_mm, sign[RUN_IN:], since[RUN_IN:], v, a, t_s, temp_c)


def run_in(q_mm: F2) -> F2:
    """The positions with `RUN_IN` more in front, as at constant acceleration: a test may start at the turn of an axis."""
    before = [q_mm[:1] - k * (q_mm[1:2] - q_mm[:1]) + 0.5 * k * (k + 1) * (q_mm[2:3] - 2.0 * q_mm[1:2] + q_mm[:1]) for k in (2, 1)]
    return np.concatenate([*before, q_mm])


def since_reversal(q_mm: F2, sign: F2, step_mm: F2 | None = None) -> F2:
    """Travel of each axis since its last reversal, shape (n, 3); `FAR_MM` before the first.

    Parameters
    ----------
    step_mm : array, shape (n, 3), optional
        Motion per sample at every sample: the axis turns between two samples, where it comes to rest. None: it turns at a sample.
    """
    travel = np.abs(np.diff(q_mm, axis=0, prepend=q_mm[:1])).cumsum(axis=0)
    out = np.full(q_mm.shape, FAR_MM)
    for i in range(3):
        turned = np.flatnonzero((sign[1:, i] != sign[:-1, i]) & (sign[:-1, i] != 0)) + 1
        if turned.size:
            which = np.searchsorted(turned, np.arange(len(q_mm)), side="right") - 1
            start = travel[turned - 1, i]
            if step_mm is not None:
                before, after = np.abs(step_mm[turned - 1, i]), np.abs(step_mm[turned, i])
                start = travel[turned, i] - 0.5 * after * after / np.maximum(before + after, REST_MM)
            out[:, i] = np.where(which >= 0, travel[:, i] - start[np.maximum(which, 0)], FAR_MM)
    return out


def at_rest(q_mm: F1, t_s: float, temp_c: Mapping[str, F1]) -> Places:
    """Places with one row: the machine stands, its approach is unknown."""
    rest = np.zeros((1, 3))
    return Places(q_mm[None], rest, np.full((1, 3), FAR_MM), rest, rest, np.array([t_s]), temp_c)
