"""Cyclic error: screw, encoder or gear repeats a small wave in every revolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import AXIS_KEYS, UM, VISITED, along, amplitude, axis_of, of_places, of_strokes, share_of_stroke
from abbe.models.effects.effect import Effect, Form, Parameter, Signal, Values
from abbe.models.effects.path import Path, Places

LOW_MM, HIGH_MM, PER_MM = 4.0, 30.0, 0.0024
"""Bounds of the pitch, mm, and spacing of the search's start values in wave number, 1/mm: over 300 mm neighbours differ by less than one
period, so the search converges from the nearer neighbour."""
STARTS = tuple(float(1.0 / k) for k in np.arange(1.0 / HIGH_MM, 1.0 / LOW_MM + PER_MM, PER_MM) if 1.0 / k >= LOW_MM)


def _waves(at: Places, key: str, values: Values, harmonic: int) -> tuple[F3, F3]:
    x = at.q_mm[:, axis_of(key)]
    phase = 2.0 * np.pi * harmonic * x / values["pitch_mm"]
    return UM * np.sin(phase), UM * np.cos(phase)


def wave(at: Places, key: str, values: Values) -> F3:
    """Return sine and cosine of 2 pi x / pitch, each with an amplitude of 1 um."""
    return along(axis_of(key), *_waves(at, key, values, 1))


def _second(at: Places, key: str, values: Values) -> F3:
    """Return the second harmonic: offsets of an encoder's signals make a wave of one period, unequal gains or phases a wave of half a
    period.

    Source: Heydemann, Appl. Opt. 20 (1981) 3382.
    """
    return along(axis_of(key), *_waves(at, key, values, 2))


def _harmonics(first: int, last: int) -> Signal:
    """Return the signal of some higher harmonics, which a saw-tooth has."""
    return of_places(lambda at, key, values: along(axis_of(key), *(w for k in range(first, last + 1) for w in _waves(at, key, values, k))))


def _along(path: Path, at: Places, key: str) -> F1:
    a = axis_of(key)
    return share_of_stroke(at.q_mm[:, a], path.machine.stroke_mm[a])


def _modulated(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the wave times the position, -1 .. +1 along the screw; the strength remains the mean amplitude."""
    x = _along(path, at, key)
    return along(axis_of(key), *(x * wave for wave in _waves(at, key, values, 1)))


def _modulated_twice(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the wave, strongest in the middle or at the ends of the screw; the strength remains the mean amplitude where tests move."""
    x = _along(path, at, key)
    return along(axis_of(key), *((x**2 - VISITED) * wave for wave in _waves(at, key, values, 1)))


EFFECT = Effect(
    name="cyclic_error",
    title="cyclic error of screw or encoder",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(0.5, 5.0),
    shape=(Parameter("pitch_mm", "mm", LOW_MM, HIGH_MM, 10.0, "usual leads of ball screws: 5 to 25 mm", STARTS),),
    signal=of_places(wave),
    strength=amplitude,
    forms=(
        Form("second harmonic", of_places(_second)),
        Form("harmonics 3 to 6", _harmonics(3, 6)),
        Form("harmonics 7 to 14", _harmonics(7, 14)),
        Form("modulated", of_strokes(_modulated)),
        Form("modulated twice", of_strokes(_modulated_twice)),
    ),
    needs="at least four readings per pitch along the axis; a laser step that is not a multiple of the pitch",
    signature="a chirp on the circle: fast where the axis moves fast, slow near its reversals, the same in both directions",
    remedy="mechanics",
    remedy_text="align screw, bearing and encoder coupling; a control with pitch-wise compensation can take the rest out",
    source="usual model: a sine and its harmonic over the pitch",
    separated_by={
        "positioning_nonlinear": ("second_radius", "single_axis_laser"),
        "reversal_spike": ("laser_diagonals",),
        "cyclic_error": ("single_axis_laser",),
    },
)
SECOND = replace(
    EFFECT,
    name="cyclic_error_second",
    title="second cyclic error of screw or encoder",
    signature="a second chirp, of another pitch, on the circle of the same axis",
    beside=("cyclic_error",),
    variant_of="cyclic_error",
)
"""Cyclic error of the same axis with a second pitch, such as an encoder's in addition to the screw's."""
