"""Building blocks for the declarations of effects (`Effect`).

The key of an effect says where it acts: an axis (``"X"``), a component (``"EYX"``) or nothing. A column is the first-order reading per unit
of one coefficient; a signal is the columns of all runs for one key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.effects.effect import Form, Signal, Values
from abbe.models.effects.path import FAR_MM, Path, Places, read_together
from abbe.models.functions.legendre import legendre_values
from abbe.models.machine import AXES

UM, PPM = 1e-3, 1e-6
"""One micrometre in mm; one part per million. Columns are mm per UNIT of strength, so that coefficients have the unit shown to people."""
AXIS_KEYS = ("X", "Y", "Z")
LATERAL_KEYS = ("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ")
"""Straightness components: the third letter is the moving axis, the second the direction in which the tool deviates."""
NO_KEY = ("",)
STEEL_PER_K = 11.5e-6
"""Thermal expansion of steel, 1/K."""
AIR_PER_K = -0.93e-6
"""Relative error of a laser reading per kelvin, 1/K: warm air is thin, so the laser reads short. The value is dn/dT at 20 degree C,
101325 Pa and constant vapour pressure; at constant relative humidity -0.96e-6 (Edlen equation by Birch and Downs, Metrologia 30 (1993)
155)."""
CAMPAIGN_S = (600.0, 12000.0)
"""Range of time constants, s, that a campaign of hours can separate from a constant and from a straight line."""

VISITED = (2.0 / 3.0) ** 2 / 3.0
"""Mean square of the position x (-1 .. +1 over the stroke) in the middle two thirds, where tests move. The form x^2 - VISITED has mean zero
there and so does not change the strength."""
BLOCKS = 4
"""Number of blocks into which a run is divided to average its temperatures."""

Deviation = Callable[[Places, str, Values], F3]
WITH_LINE = (2.5, 1.5)
"""Ratio of the rms of a smooth curve to its rms without the straight line, which scale and squareness absorb; with standard uncertainty.
For stationary curves with a correlation length of 0.3 strokes the median is 2.6, and two of three curves have 1.5 to 5."""
WITH_CONSTANT = (1.4, 0.7)
"""Ratio of the rms of a smooth curve to its rms without its mean: the median is 1.4, and two of three curves have 1.0 to 2.6."""
WITH_SLOW = (1.07, 0.06)
"""Ratio of the final drift of a head or column to the final value of the exponential that best fits its first two or three hours; with
standard uncertainty. These parts have several time constants (ISO 230-3). If the second is a quarter to four times as long, with a weight
of 15 to 60 %, the median ratio is 1.08 with a constant in the fit and 1.05 without, and two of three parts have 1.02 to 1.16. In 26 own and
practice cases the fitted size was 9 % too small on average. A screw is one body: in 16 cases its growth was 2 % too small.
"""


def axis_of(key: str) -> int:
    """Return the index of the moving axis: the last letter of ``"X"`` or ``"EYX"``."""
    return AXES.index(key[-1])


def direction_of(key: str) -> int:
    """Return the index of the direction of the deviation: Y for ``"EYX"``, the axis itself for ``"X"``."""
    return AXES.index(key[1]) if len(key) == 3 else axis_of(key)


def third_axis(key: str) -> int:
    """Return the index of the axis that a key like ``"EYX"`` does not name."""
    return 3 - axis_of(key) - direction_of(key)


def along(direction: int, *values: F1) -> F3:
    """Return k columns of shape (n,) as deviations along the axis of index ``direction`` (0: X, 1: Y, 2: Z), shape (n, 3, k).

    `axis_of` and `direction_of` give the index that a key names. Raises ValueError for any other value.
    """
    if direction not in range(len(AXES)):
        raise ValueError(f"along: direction {direction!r}, expected the index of an axis: 0 (X), 1 (Y) or 2 (Z)")
    out = np.zeros((len(values[0]), 3, len(values)))
    for k, value in enumerate(values):
        out[:, direction, k] = value
    return out


def of_machine(deviation: Deviation) -> Signal:
    """Make the signal of a deviation of the tool, as every test reads it to first order (`Path.read`)."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [path.read(lambda at: deviation(at, key, values)) for path in paths]

    return signal


def of_places(deviation: Deviation) -> Signal:
    """Do the same as `of_machine` for all runs at once, if the deviation treats each row of `Places` alone and uses no temperature."""
    return lambda paths, key, values: read_together(paths, lambda at: deviation(at, key, values))


def of_path(deviation: Callable[[Path, Places, str, Values], F3]) -> Signal:
    """Do the same as `of_machine` for a deviation that also depends on the machine, e.g. on its strokes or its vertical axis."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [path.read(lambda at, p=path: deviation(p, at, key, values)) for path in paths]  # type: ignore[misc]

    return signal


def of_strokes(deviation: Callable[[Path, Places, str, Values], F3]) -> Signal:
    """Do the same as `of_places` for a deviation that also depends on the strokes or the vertical axis, which all runs share."""
    return lambda paths, key, values: read_together(paths, lambda at: deviation(paths[0], at, key, values))


def of_body(deviation: Callable[[Path, Places, str, Values], F3], turn: Callable[[Path, Places, str, Values], F3]) -> Signal:
    """Do the same as `of_path` for a body that turns, and add the reading from the plane mirror that turns with it.

    ``turn``: rotation of tool against workpiece, shape (rows, 3, k), rad per unit of each coefficient. After a travel l of the tool since
    the reference, a rotation w since then adds (w x n).l to a laser's reading along the beam n, because the beam meets the mirror beside
    its first spot: 50 mm times 20 urad is 1 um.
    """

    def read(path: Path, key: str, values: Values) -> F2:
        columns = path.read(lambda at: deviation(path, at, key, values))
        if path.kind == "bar":
            return columns
        beam, beside = path.look[0], path.at.q_mm - path.reference.q_mm
        lean = np.cross(turn(path, path.at, key, values) - turn(path, path.reference, key, values), beam[None, :, None], axis=1)
        return np.asarray(columns + np.einsum("ni,nik->nk", beside, lean))

    return lambda paths, key, values: [read(path, key, values) for path in paths]


def of_kind(kind: str, reading: Callable[[Path, str, Values], F2], columns: int) -> Signal:
    """Make a signal that only one kind of instrument reads, ``"bar"`` or ``"laser"``; other runs get ``columns`` columns of zeros."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [reading(path, key, values) if path.kind == kind else np.zeros((path.n, columns)) for path in paths]

    return signal


def per_setup(kind: str, parts: int, reading: Callable[[Path, Values], F2]) -> Signal:
    """Make a signal with ``parts`` columns for every set-up of one kind of instrument, set-ups in alphabetical order."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        places = order_of(path.setup for path in paths if path.kind == kind)
        out = [np.zeros((path.n, parts * max(len(places), 1))) for path in paths]
        for path, columns in zip(paths, out, strict=True):
            if path.kind == kind:
                at = parts * places[path.setup]
                columns[:, at : at + parts] = reading(path, values)
        return out

    return signal


def order_of(names: Iterable[str]) -> dict[str, int]:
    """Return the alphabetical index of each distinct name, which does not depend on the order of the runs."""
    return {name: k for k, name in enumerate(sorted(set(names)))}


def commanded_turns(at: Places, axis: int) -> tuple[F1, F1]:
    """Return direction of motion and travel since the last reversal of one axis, from `Places.commanded_turns`, shape (n,) each."""
    sign, since = at.commanded_turns
    return sign[:, axis], since[:, axis]


def wind_up(at: Places, axis: int, *over_mm: float) -> list[F1]:
    """Return the signed share of the lost motion that remains while the drive winds up after a reversal, one column per length."""
    sign, since = commanded_turns(at, axis)
    return [np.asarray(sign * np.exp(-since / length)) for length in over_mm]


def before_first_turn(at: Places, axis: int) -> F1:
    """Return the travel of an axis since the first reading, mm; `FAR_MM` after its first reversal.

    Effects use this travel to describe the rest of a reversal in the unrecorded run-in before the first reading.
    """
    if len(at.t_s) < 2 or not at.v_mm_s.any():
        return np.full(len(at.t_s), FAR_MM)
    travel = np.abs(at.q_mm[:, axis] - at.q_mm[0, axis])
    return np.where(at.since_mm[:, axis] >= FAR_MM, travel, FAR_MM)


def play(at: Places, axis: int, width_mm: float = 0.008) -> F1:
    """Return the position of an axis within its play, from -1 to +1 in the direction of motion, shape (n,).

    After a reversal the axis stays until the command has travelled the width of the play. The outermost command is taken as reversal.
    """
    sign, since = commanded_turns(at, axis)
    return np.asarray(sign * np.clip(2.0 * since / width_mm - 1.0, -1.0, 1.0))


def turn_between(at: Places, axis: int) -> F1:
    """Return a sudden step at the true point of reversal (possibly between two readings), minus `play`."""
    return np.asarray(at.sign[:, axis] - play(at, axis))


def warmth(t_s: F1, tau_s: float) -> F1:
    """Return the state of warm-up, 1 - exp(-t / tau), at times ``t_s`` of the campaign clock: 0 at first, 1 in the end."""
    return np.asarray(-np.expm1(-np.maximum(t_s, 0.0) / tau_s))


def rise_of(paths: tuple[Path, ...], sensor: str) -> Callable[[F1], F1] | None:
    """Return the rise of a temperature since the start of the campaign, K, as a function of campaign time; None if no run has the sensor.

    Readings are averaged over blocks of a run, because noise of a regressor biases the fit. Linear interpolation fills the gaps between
    runs, where cups are set.
    """
    clock: dict[float, float] = {}
    for path in paths:
        if sensor in path.at.temp_c:
            for block in np.array_split(np.arange(path.n), min(BLOCKS, path.n)):
                clock[float(path.at.t_s[block].mean())] = float(path.at.temp_c[sensor][block].mean())
    if not clock:
        return None
    when = np.array(sorted(clock))
    rise = np.array([clock[t] for t in when])
    return lambda t_s: np.asarray(np.interp(t_s, when, rise - rise[0]))


def with_sensor(deviation: Callable[[Path, Places, str, Values, F1], F3], sensor_of: Callable[[str], str]) -> Signal:
    """Make a signal that follows the rise of the temperature sensor that ``sensor_of(key)`` names; zeros if no run has this sensor."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        rise = rise_of(paths, sensor_of(key))
        if rise is None:
            return [np.zeros((path.n, 1)) for path in paths]
        return [path.read(lambda at, p=path: deviation(p, at, key, values, rise(at.t_s))) for path in paths]  # type: ignore[misc]

    return signal


def share_of_stroke(path_axis_mm: F1, stroke_mm: F1) -> F1:
    """Return positions on an axis as -1 .. +1 over its stroke, shape (n,)."""
    return np.asarray(2.0 * (path_axis_mm - stroke_mm[0]) / (stroke_mm[1] - stroke_mm[0]) - 1.0)


def spread(low: float, high: float, n: int) -> tuple[float, ...]:
    """Return n start values from ``low`` to ``high``, evenly spaced on a logarithmic scale."""
    return tuple(float(v) for v in np.geomspace(low, high, n))


def first(coefficients: F1, values: Values) -> float:
    """Return the first coefficient, signed, as the strength."""
    return float(coefficients[0])


def amplitude(coefficients: F1, values: Values) -> float:
    """Return the amplitude of a wave from its sine and cosine coefficients as the strength."""
    return float(np.hypot(coefficients[0], coefficients[1]))


def rms(coefficients: F1, values: Values) -> float:
    """Return as the strength the rms over the stroke of a sum of orthogonal columns, each with mean square 1."""
    return float(np.linalg.norm(coefficients))


def size(coefficients: F1, values: Values) -> float:
    """Return the square root of a variance coefficient as the strength; zero if the coefficient is negative."""
    return float(np.sqrt(max(float(coefficients[0]), 0.0)))


def setup_length(parts: int) -> Callable[[F1, Values], float]:
    """Make a strength function: the rms length of the set-ups' vectors of ``parts`` coefficients each; vectors of zeros do not count."""

    def strength(coefficients: F1, values: Values) -> float:
        lengths = np.linalg.norm(np.reshape(coefficients, (-1, parts)), axis=1)
        nonzero = lengths[lengths > 0.0]
        return float(np.sqrt(np.mean(nonzero**2))) if nonzero.size else 0.0

    return strength


def smooth(position_mm: F1, stroke_mm: F1, first: int, last: int) -> F2:
    """Return Legendre polynomials of orders ``first`` to ``last``, scaled to mean square 1 over the stroke, one column each."""
    orders = np.arange(first, last + 1)
    return np.asarray(legendre_values(position_mm, stroke_mm, last)[:, first:] * np.sqrt(2.0 * orders + 1.0))


def shifts(direction: Callable[[str], int], first: int, last: int) -> Signal:
    """Make the signal of a translation that varies smoothly along the moving axis (`axis_of`).

    The signal has one column per Legendre order from ``first`` to ``last``, each 1 um rms over the stroke. ``direction``: function from an
    effect's key to the index (0 to 2) of the direction in which the tool deviates.
    """

    def moved(path: Path, at: Places, key: str, values: Values) -> F3:
        a = axis_of(key)
        return along(direction(key), *(UM * smooth(at.q_mm[:, a], path.machine.stroke_mm[a], first, last)).T)

    return of_strokes(moved)


def finer_shifts(direction: Callable[[str], int]) -> tuple[Form, ...]:
    """Return the two forms that extend `shifts` to orders 7 to 9 and 10 to 13."""
    return Form("finer", shifts(direction, 7, 9)), Form("finest", shifts(direction, 10, 13))
