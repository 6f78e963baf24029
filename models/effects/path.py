"""A run without its readings, as effects need it: positions, velocities, reversals, times, and direction of measurement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.chain import REST_MM, travel_sign
from abbe.models.machine import Machine

Kind = Literal["bar", "laser"]
FAR_MM = 1e9
"""Value of the travel since the last reversal of an axis that has not reversed yet."""


@dataclass(frozen=True)
class Places:
    """Position and motion of the tool, one row per time. An effect of the machine may depend on nothing else.

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
        Campaign time.
    temp_c : dict
        Recorded temperatures, degree C, by sensor ("x", "y", "z", "spindle", "air"), shape (n,) each; empty without sensors.
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
        """``sign`` and ``since_mm`` if every axis reversed at a commanded position and not between two of them, shape (n, 3) each.

        If the machine dwells, the results are ``sign`` and ``since_mm`` themselves.
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
    label, setup, test : str
        Names of run, set-up and test.
    kind : "bar" | "laser"
    machine : Machine
        With the tool of this run.
    vertical : int
        Index of the axis along which gravity acts.
    at : Places
        The path itself.
    reference : Places
        One row: position and state of the machine for which the reading is zero. Ball-bar: at rest at the centre, where the spindle set the
        cup at ``t_set_s``; the direction of approach is unknown. Laser: the first record.
    look : array, shape (n, 3)
        Direction of measurement, unit vector from cup to tool or along the beam: the reading per mm of deviation, to first order.
    feed_mm_min, direction : array, shape (n,)
        Commanded feed; direction of motion along the path, by its sign.
    travel_mm : array, shape (n,)
        Nominal displacement along the beam since the first record; zero for a bar.
    t_set_s : float
        Campaign time at which the set-up was mounted and zeroed.
    dead_path_mm : float
        Length of the laser path outside the measured travel.
    radius_mm, centre_mm : float, array, shape (3,)
        Radius and centre of the ball-bar's sphere; zero for a laser.
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
        """Return the first-order reading of a deviation of the tool relative to the workpiece.

        Parameters
        ----------
        deviation : function of `Places`
            Deviation in machine coordinates, shape (rows, 3, k), mm per unit of each of k coefficients.

        Returns
        -------
        array, shape (n, k)
            Reading, mm: ``look . (deviation(at) - deviation(reference))``.
        """
        return np.asarray(np.einsum("ni,nik->nk", self.look, deviation(self.at) - deviation(self.reference)))


class Together(tuple[Path, ...]):
    """Runs of a search, which reads hundreds of deviations along them: their places are joined once."""

    @cached_property
    def joined(self) -> tuple[Places, F2, NDArray[np.intp]]:
        """Places of all readings and then of all references; ``look``, shape (n, 3); readings per run."""
        places = _joined([*(p.at for p in self), *(p.reference for p in self)])
        return places, np.concatenate([p.look for p in self]), np.array([p.n for p in self])


def read_together(paths: Sequence[Path], deviation: Callable[[Places], F3]) -> list[F2]:
    """Return `Path.read` of all runs at once, for a deviation that treats each row of `Places` alone and uses no temperature."""
    if not paths:
        return []
    at, look, n = (paths if isinstance(paths, Together) else Together(paths)).joined
    found = deviation(at)
    zero = np.repeat(found[len(look) :], n, axis=0)
    columns = np.einsum("ni,nik->nk", look, found[: len(look)] - zero)
    return [columns[end - size : end] for end, size in zip(np.cumsum(n).tolist(), n.tolist(), strict=True)]


def _joined(parts: Sequence[Places]) -> Places:
    """Concatenate places, without temperatures."""
    columns = [[p.q_mm, p.sign, p.since_mm, p.v_mm_s, p.a_mm_s2] for p in parts]
    q, sign, since, v, a = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Places(q, sign, since, v, a, np.concatenate([p.t_s for p in parts]), {})


RUN_IN = 2
"""Number of positions that `run_in` extrapolates before the first reading."""


def driven(q_mm: F2, t_s: F1, feed_mm_min: F1, *, dwelling: bool, temp_c: Mapping[str, F1]) -> Places:
    """Return the `Places` of a sequence of commanded positions, mm, at times ``t_s``.

    A moving axis reverses between two samples. The point of reversal follows from the velocities on both sides at constant acceleration;
    backlash and friction in the next samples depend on the travel from this point.

    Parameters
    ----------
    dwelling : bool
        Whether the machine stands at every position (step tests): velocity and acceleration are then zero. Otherwise the velocity has the
        direction of the path and the size of the commanded feed.
    """
    v, a = np.zeros_like(q_mm), np.zeros_like(q_mm)
    if dwelling or len(t_s) < 3:
        sign = travel_sign(q_mm)
        return Places(q_mm, sign, since_reversal(q_mm, sign), v, a, t_s, temp_c)
    v = np.asarray(scipy.interpolate.CubicSpline(t_s, q_mm, axis=0)(t_s, 1))  # chords would give 2 % too little near the pole of a helix
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    v *= np.divide(feed_mm_min[:, None] / 60.0, speed, out=np.ones_like(speed), where=speed > 0)
    a = np.gradient(v, t_s, axis=0, edge_order=2)
    came_mm = run_in(q_mm)
    step = np.gradient(came_mm, axis=0, edge_order=2)
    sign = travel_sign(np.cumsum(np.concatenate([np.zeros((1, 3)), step]), axis=0))[1:]
    since = since_reversal(came_mm, sign, step)
    return Places(q_mm, sign[RUN_IN:], since[RUN_IN:], v, a, t_s, temp_c)


def run_in(q_mm: F2) -> F2:
    """Prepend `RUN_IN` positions, extrapolated at constant acceleration, because a test may start where an axis reverses."""
    before = [q_mm[:1] - k * (q_mm[1:2] - q_mm[:1]) + 0.5 * k * (k + 1) * (q_mm[2:3] - 2.0 * q_mm[1:2] + q_mm[:1]) for k in (2, 1)]
    return np.concatenate([*before, q_mm])


def since_reversal(q_mm: F2, sign: F2, step_mm: F2 | None = None) -> F2:
    """Return the travel of each axis since its last reversal, mm, shape (n, 3); `FAR_MM` before the first.

    Parameters
    ----------
    step_mm : array, shape (n, 3), optional
        Motion per sample, at every sample. If given, an axis reverses where it comes to rest between two samples; if not, at a sample.
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
    """Return `Places` with one row: the machine stands, and its direction of approach is unknown."""
    rest = np.zeros((1, 3))
    return Places(q_mm[None], rest, np.full((1, 3), FAR_MM), rest, rest, np.array([t_s]), temp_c)
