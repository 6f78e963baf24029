"""Parts of the effects' columns: axes of a key, columns per kind of run, state in time, strength from coefficients."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.effects.effect import Form, Signal, Values
from abbe.models.effects.path import FAR_MM, Path, Places, read_together
from abbe.models.functions.legendre import legendre_values
from abbe.models.machine import AXES

UM, PPM = 1e-3, 1e-6
"""mm per micrometre; one part per million. Columns are mm per UNIT of the strength, so a coefficient is a strength as people read it."""
AXIS_KEYS = ("X", "Y", "Z")
LATERAL_KEYS = ("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ")
"""Straightness components: deviation in the second letter while the third moves."""
NO_KEY = ("",)
STEEL_PER_K = 11.5e-6
"""Thermal growth of steel, 1/K (effects.md 3)."""
AIR_PER_K = -0.93e-6
"""What a laser reads too much per kelvin of warmer air and per millimetre of path: it counts n D over the wavelength that was assumed, and
warm air is thin, so it reads short. dn/dT at 20 C, 101325 Pa and a constant vapour pressure, as when a hall warms up; at a constant
relative humidity -0.96e-6 (Edlen as of Birch and Downs, Metrologia 30 (1993) 155; effects.md 4)."""
CAMPAIGN_S = (600.0, 12000.0)
"""Time constants that a campaign of hours can tell from a constant and from a straight line."""

VISITED = (2.0 / 3.0) ** 2 / 3.0
"""Mean square of a position (-1 .. +1 over the stroke) where tests go, the middle two thirds: a form that is zero there on average leaves
the strength what it is."""
BLOCKS = 4
"""Averages of a temperature per run."""

Deviation = Callable[[Places, str, Values], F3]
WITH_LINE = (2.5, 1.5)
"""Rms of a smooth curve over that of its bent part (its line, which scale and squareness swallow, taken away), and its standard
uncertainty. Of a stationary curve whose correlation length is 0.3 strokes: half of all curves have 2.6 or more, two of three 1.5 to 5."""
WITH_CONSTANT = (1.4, 0.7)
"""Of the same curves, rms over that without their constant: half have 1.4 or more, two of three 1.0 to 2.6."""


def axis_of(key: str) -> int:
    """Index of the axis that moves: last letter of ``"X"`` or ``"EYX"``."""
    return AXES.index(key[-1])


def direction_of(key: str) -> int:
    """Index of the direction that deviates: of ``"EYX"`` that of Y, of ``"X"`` the axis itself."""
    return AXES.index(key[1]) if len(key) == 3 else axis_of(key)


def third_axis(key: str) -> int:
    """The axis that ``"EYX"`` does not name."""
    return 3 - axis_of(key) - direction_of(key)


def along(direction: int, *values: F1) -> F3:
    """Deviation in one direction, shape (n, 3, k), from k columns of shape (n,)."""
    out = np.zeros((len(values[0]), 3, len(values)))
    for k, value in enumerate(values):
        out[:, direction, k] = value
    return out


def of_machine(deviation: Deviation) -> Signal:
    """Signal of a deviation of the tool: every test sees it to first order (`Path.read`)."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [path.read(lambda at: deviation(at, key, values)) for path in paths]

    return signal


def of_places(deviation: Deviation) -> Signal:
    """`of_machine`, faster, for a deviation that depends on every row of `Places` alone and on no temperature: all runs at once."""
    return lambda paths, key, values: read_together(paths, lambda at: deviation(at, key, values))


def of_path(deviation: Callable[[Path, Places, str, Values], F3]) -> Signal:
    """`of_machine` for a deviation that also depends on the machine: its strokes, its vertical axis."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [path.read(lambda at, p=path: deviation(p, at, key, values)) for path in paths]  # type: ignore[misc]

    return signal


def of_body(deviation: Callable[[Path, Places, str, Values], F3], turn: Callable[[Path, Places, str, Values], F3]) -> Signal:
    """`of_path` for a body that turns: the mirror on it turns too, and a step across the beam meets it at another distance.

    ``turn``: rotation of tool against workpiece, shape (rows, 3, k), rad per unit. A plane mirror turned by w reads (w x n).l more where it
    stands l beside the beam's first spot; 50 mm times 20 urad is 1 um (effects.md, second order (ii)).
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
    """Signal of one kind of instrument, ``"bar"`` or ``"laser"``; zeros in ``columns`` columns for the other."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        return [reading(path, key, values) if path.kind == kind else np.zeros((path.n, columns)) for path in paths]

    return signal


def per_setup(kind: str, parts: int, reading: Callable[[Path], F2]) -> Signal:
    """``parts`` columns for every set-up of one kind of instrument, set-ups in the order of their first run."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        places = order_of(path.setup for path in paths if path.kind == kind)
        out = [np.zeros((path.n, parts * max(len(places), 1))) for path in paths]
        for path, columns in zip(paths, out, strict=True):
            if path.kind == kind:
                at = parts * places[path.setup]
                columns[:, at : at + parts] = reading(path)
        return out

    return signal


def order_of(names: Iterable[str]) -> dict[str, int]:
    """Index of every different name in alphabetical order, so that the order of runs does not matter."""
    return {name: k for k, name in enumerate(sorted(set(names)))}


def commanded_turns(at: Places, axis: int) -> tuple[F1, F1]:
    """`Places.commanded_turns` of one axis, shape (n,) each."""
    sign, since = at.commanded_turns
    return sign[:, axis], since[:, axis]


def wind_up(at: Places, axis: int, *over_mm: float) -> list[F1]:
    """Share of a turn that is still missing while screw, coupling and guide wind up, one column per wind-up length."""
    sign, since = commanded_turns(at, axis)
    return [np.asarray(sign * np.exp(-since / length)) for length in over_mm]


def before_first_turn(at: Places, axis: int) -> F1:
    """Travel of an axis since the first reading, `FAR_MM` once it has turned: for what a turn in the unrecorded run-in leaves."""
    if len(at.t_s) < 2 or not at.v_mm_s.any():
        return np.full(len(at.t_s), FAR_MM)
    travel = np.abs(at.q_mm[:, axis] - at.q_mm[0, axis])
    return np.where(at.since_mm[:, axis] >= FAR_MM, travel, FAR_MM)


def play(at: Places, axis: int, width_mm: float = 0.008) -> F1:
    """Position of an axis within a play of some width, -1 .. +1 in the direction of motion, shape (n,).

    After a turn the axis stays until the command has travelled the width. The turn is the farthest position that was commanded: a control
    commands positions, and between two of them nothing is known of the play.
    """
    sign, since = commanded_turns(at, axis)
    return np.asarray(sign * np.clip(2.0 * since / width_mm - 1.0, -1.0, 1.0))


def turn_between(at: Places, axis: int) -> F1:
    """Change of `play` if the axis turns at its rest position between two readings."""
    return np.asarray(at.sign[:, axis] - play(at, axis))


def warmth(t_s: F1, tau_s: float) -> F1:
    """Warm-up of a machine since the start of the campaign's clock: 0 at first, 1 in the end; shape of ``t_s``."""
    return np.asarray(-np.expm1(-np.maximum(t_s, 0.0) / tau_s))


def rise_of(paths: tuple[Path, ...], sensor: str) -> Callable[[F1], F1] | None:
    """Rise of a temperature sensor since the first reading of the campaign, K, as a function of the clock; None without the sensor.

    Blocks of a run are averaged, because a sensor is a regressor with noise; between runs it is a straight line, so that the
    setting of a cup has a temperature too.
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
    """Signal whose state in time is the rise of a sensor (named for a key); a column of zeros where the runs hold none."""

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        rise = rise_of(paths, sensor_of(key))
        if rise is None:
            return [np.zeros((path.n, 1)) for path in paths]
        return [path.read(lambda at, p=path: deviation(p, at, key, values, rise(at.t_s))) for path in paths]  # type: ignore[misc]

    return signal


def share_of_stroke(path_axis_mm: F1, stroke_mm: F1) -> F1:
    """Position on an axis as -1 .. +1 over its stroke, shape (n,)."""
    return np.asarray(2.0 * (path_axis_mm - stroke_mm[0]) / (stroke_mm[1] - stroke_mm[0]) - 1.0)


def spread(low: float, high: float, n: int) -> tuple[float, ...]:
    """n starts from low to high, evenly on a logarithmic scale."""
    return tuple(float(v) for v in np.geomspace(low, high, n))


def first(coefficients: F1, values: Values) -> float:
    """Strength of an effect whose first column carries it, signed."""
    return float(coefficients[0])


def amplitude(coefficients: F1, values: Values) -> float:
    """Strength of a wave: length of its sine and cosine coefficient."""
    return float(np.hypot(coefficients[0], coefficients[1]))


def rms(coefficients: F1, values: Values) -> float:
    """Strength of a sum of columns of unit mean square each over the stroke, orthogonal there."""
    return float(np.linalg.norm(coefficients))


def size(coefficients: F1, values: Values) -> float:
    """Strength of an effect that adds variance: root of its coefficient; zero where the readings are calmer than without it."""
    return float(np.sqrt(max(float(coefficients[0]), 0.0)))


def setup_length(parts: int) -> Callable[[F1, Values], float]:
    """Strength of an effect with ``parts`` coefficients per set-up: root mean square length of those that are not zero (observed)."""

    def strength(coefficients: F1, values: Values) -> float:
        lengths = np.linalg.norm(np.reshape(coefficients, (-1, parts)), axis=1)
        nonzero = lengths[lengths > 0.0]
        return float(np.sqrt(np.mean(nonzero**2))) if nonzero.size else 0.0

    return strength


def smooth(position_mm: F1, stroke_mm: F1, first: int, last: int) -> F2:
    """Legendre polynomials of orders ``first`` to ``last`` over the stroke, each with mean square 1 there, shape (n, last - first + 1)."""
    orders = np.arange(first, last + 1)
    return np.asarray(legendre_values(position_mm, stroke_mm, last)[:, first:] * np.sqrt(2.0 * orders + 1.0))


def shifts(direction: Callable[[str], int], first: int, last: int) -> Signal:
    """A translation as a smooth function of the axis of a key, orders ``first`` to ``last``, 1 um rms over the stroke each.

    ``direction``: the component (0 to 2) that a key moves the tool in.
    """

    def moved(path: Path, at: Places, key: str, values: Values) -> F3:
        a = axis_of(key)
        return along(direction(key), *(UM * smooth(at.q_mm[:, a], path.machine.stroke_mm[a], first, last)).T)

    return of_path(moved)


def finer_shifts(direction: Callable[[str], int]) -> tuple[Form, ...]:
    """Freedoms of form of a translation of `shifts`: orders 7 to 9, and 10 to 13."""
    return Form("finer", shifts(direction, 7, 9)), Form("finest", shifts(direction, 10, 13))
