"""Instruments with the minutes of their set-ups, and all collision-free measurements with the runs that they would record.

Measurements are helices, edge lines and body diagonals. Collision-free means that the whole path stays inside the strokes less a clearance
and that hemispheres open towards the spindle (`opening`), which then never moves beyond the cup. The service's sequences move to the same
positions (a test compares the two).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import permutations, product

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.observations import RunData, Test
from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.models.uncertainty.inputs import StatedInputs

BAR_LENGTHS_MM = (50.0, 100.0, 150.0, 200.0, 250.0, 300.0)
"""Default lengths: one bar with its extensions."""
Point = tuple[float, float, float]
RAPID_MM_MIN = 6000.0
BAR_FEED_MM_MIN = 2000.0
BAR_RATE_HZ = 100.0
READING_S = 0.4
"""Settling and reading of the laser at one position."""
CLEARANCE_MM = 10.0
"""Laser paths keep this distance from the ends of the strokes."""
BAR_VALUES = 400
"""Number of block means to which the solution reduces one ball-bar run."""
_FINE = 8
BAR_CLEARANCE_MM = 5.0
"""Hemispheres keep this distance from the ends of the strokes, for approach, lost motion and cup offset."""
EDGES = (0.1, 0.5, 0.9)
"""Positions of laser lines on the two other axes, as fractions of the stroke."""
ORDERS = tuple("".join(p) for p in permutations("XYZ"))
SHORTEST_TOOL_MM = 1.0
"""A shorter tool vector leaves open on which side of the cup the spindle is."""
OBLIQUE = 0.5
"""The spindle's direction is doubtful if the tool's second longest component is at least this share of its longest."""


@dataclass(frozen=True, slots=True)
class SetupMinutes:
    """Time that a person needs for each set-up, minutes; the defaults are typical values.

    Attributes
    ----------
    cup : mount cup and bar at a new centre.
    bar : change to another bar at the same cup. The other direction with the same bar needs no set-up.
    line : align the laser along an edge.
    diagonal : align laser and flat mirror along a body diagonal. Another step order with the same mirror needs no set-up.
    """

    cup: float = 3.0
    bar: float = 1.5
    line: float = 5.0
    diagonal: float = 8.0

    def __post_init__(self) -> None:
        """Refuse negative times."""
        if not all(0 <= v < float("inf") for v in (self.cup, self.bar, self.line, self.diagonal)):
            raise ValueError("set-up minutes: every time must be 0 or more")


@dataclass(frozen=True, slots=True)
class Instruments:
    """The instruments at hand and their uncertainties.

    Attributes
    ----------
    bar_lengths_mm : tuple of float
        Nominal lengths of the ball-bars at hand; empty: no ball-bar.
    laser : bool
        Whether there is a laser with a flat mirror.
    bar_noise_mm, laser_noise_mm : float
        Standard deviation of one reading.
    floor_mm : float
        Standard uncertainty that averaging cannot reduce, because smooth error functions do not follow the machine exactly (as in the
        joint solution).
    u_bar_length_mm : float
        Standard uncertainty of each bar's calibrated length.
    u_wavelength : float
        Relative standard uncertainty of the laser's wavelength, common to all laser runs.
    setup : SetupMinutes
        How long set-ups take.
    max_feed_mm_min : float
        Fastest feed of any measurement on the machine.
    inputs : StatedInputs
        How well the temperatures of bars and scales are known; default: as in the budget of a solution.
    """

    bar_lengths_mm: tuple[float, ...] = BAR_LENGTHS_MM
    laser: bool = True
    bar_noise_mm: float = 0.5e-3
    laser_noise_mm: float = 0.3e-3
    floor_mm: float = 0.3e-3
    u_bar_length_mm: float = 2e-3
    u_wavelength: float = U_WAVELENGTH
    setup: SetupMinutes = field(default_factory=SetupMinutes)
    max_feed_mm_min: float = 6000.0
    inputs: StatedInputs = field(default_factory=StatedInputs)

    def __post_init__(self) -> None:
        """Refuse values that no instrument can have."""
        noise = (self.bar_noise_mm, self.laser_noise_mm)
        sizes = (*self.bar_lengths_mm, *noise, self.u_bar_length_mm, self.u_wavelength, self.max_feed_mm_min)
        if not all(0 < v < float("inf") for v in sizes) or not 0 <= self.floor_mm < float("inf"):
            raise ValueError("instruments: lengths, noise, uncertainties and feed must be positive numbers")
        if not self.bar_lengths_mm and not self.laser:
            raise ValueError("instruments: there is neither a ball-bar nor a laser")


@dataclass(frozen=True, slots=True)
class HelixTest:
    """Ball-bar on a hemispherical helix about one cup, from pole to equator or (direction -1) back.

    The pole lies along ``axis`` (0 to 2), on the positive (``opens`` 1) or negative (-1) side of the cup, where the spindle is.
    """

    centre_mm: Point
    radius_mm: float
    direction: int = 1
    turns: float = 5.0
    axis: int = 2
    opens: int = 1

    @property
    def mounting(self) -> str:
        """Key of the mounted cup: tests with the same key share one mounting."""
        return "cup " + ",".join(f"{v:g}" for v in self.centre_mm)

    @property
    def label(self) -> str:
        """Name of the test within a plan."""
        return f"helix {','.join(f'{v:g}' for v in self.centre_mm)} R{self.radius_mm:g}{'' if self.direction > 0 else ' back'}"


@dataclass(frozen=True, slots=True)
class DiagonalTest:
    """Laser along a body diagonal: single-axis steps in ``order``, or straight when ``order`` is empty; out and back."""

    diagonal: str
    order: str = "XYZ"
    steps: int = 12

    @property
    def mounting(self) -> str:
        """Key of the mirror's mounting: tests with the same key have the same mirror tilt."""
        return f"diagonal {self.diagonal}"

    @property
    def label(self) -> str:
        """Name of the test within a plan."""
        return f"diagonal {self.diagonal} {self.order or 'plain'}"


@dataclass(frozen=True, slots=True)
class LineTest:
    """Laser along one axis, ``n`` positions out and back; ``at``: positions of the two others, X before Y before Z, fractions of stroke."""

    axis: int
    at: tuple[float, float]
    n: int = 25

    @property
    def mounting(self) -> str:
        """Key of the laser's alignment: every line has its own."""
        return self.label

    @property
    def label(self) -> str:
        """Name of the test within a plan."""
        return f"line {AXES[self.axis]} {self.at[0]:g},{self.at[1]:g}"


Measurement = HelixTest | DiagonalTest | LineTest


def laser_path(machine: Machine, test: DiagonalTest | LineTest) -> tuple[F2, F1]:
    """Positions of a laser test, shape (n, 3), mm, and the unit vector of its nominal beam."""
    if isinstance(test, DiagonalTest):
        start, end = diagonal_ends(machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM]), test.diagonal)
        path = step_diagonal(start, end, test.steps, test.order) if test.order else straight_line(start, end, test.steps + 1)
    else:
        others = [a for a in range(3) if a != test.axis]
        start = machine.stroke_mm[:, 0].copy()
        start[others] += np.array(test.at) * machine.length_mm[others]
        end = start.copy()
        start[test.axis], end[test.axis] = machine.stroke_mm[test.axis] + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        path = straight_line(start, end, test.n)
    return path, np.asarray((end - start) / np.linalg.norm(end - start))


def helix_path(test: HelixTest, n: int) -> F2:
    """Positions of a ball-bar test in the order of measuring, shape (n, 3), mm."""
    points = helix_points(np.array(test.centre_mm), test.radius_mm, turns=test.turns, n=n, law="area", axis=test.axis)
    if test.opens < 0:  # mirrored at the equator
        points[:, test.axis] = 2.0 * test.centre_mm[test.axis] - points[:, test.axis]
    return points if test.direction > 0 else points[::-1]


def feed_mm_min(tools: Instruments, test: Measurement) -> float:
    """Feed along a test's path: the instrument's usual feed, limited to the machine's fastest."""
    return min(BAR_FEED_MM_MIN if isinstance(test, HelixTest) else RAPID_MM_MIN, tools.max_feed_mm_min)


def machine_seconds(machine: Machine, test: Measurement, tools: Instruments) -> float:
    """Time that one test takes for approach, path and readings, s, without the set-up."""
    feed = feed_mm_min(tools, test)
    if isinstance(test, HelixTest):
        length = np.linalg.norm(np.diff(helix_path(test, 2000), axis=0), axis=1).sum()
        return float(length / feed + test.radius_mm / min(RAPID_MM_MIN, tools.max_feed_mm_min)) * 60.0
    path, _ = laser_path(machine, test)
    travel = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    return float(travel / feed * 60.0 + READING_S * len(path))


def expected_run(machine: Machine, test: Measurement, tools: Instruments, *, values: int = BAR_VALUES, start_s: float = 0.0) -> RunData:
    """Return the run that a perfect machine would give: real positions, directions, times and weights; every deviation zero.

    A ball-bar run has ``values`` block means on the sphere, each of ``weight_n`` readings; a laser run has one reading per position.
    """
    if isinstance(test, HelixTest):
        return _expected_helix(test, tools, values, start_s)
    path, beam = laser_path(machine, test)
    n = len(path)
    kind: Test = "diagonal" if isinstance(test, DiagonalTest) else "linear"
    moved = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1)])
    t_s = start_s + np.cumsum(moved / feed_mm_min(tools, test) * 60.0 + READING_S)
    return RunData(test.label, test.mounting, "laser", path, np.zeros(n), travel_sign(path), t_s, np.ones(n), beam=beam, test=kind)


def _expected_helix(test: HelixTest, tools: Instruments, values: int, start_s: float) -> RunData:
    fine = helix_path(test, _FINE * values)
    sign = travel_sign(fine)[_FINE // 2 :: _FINE]
    points = fine[_FINE // 2 :: _FINE]
    feed = feed_mm_min(tools, test)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])[_FINE // 2 :: _FINE]
    weight = np.full(values, max(1.0, float(along[-1]) / feed * 60.0 * BAR_RATE_HZ / values))
    return RunData(
        test.label,
        test.mounting,
        "bar",
        points,
        np.zeros(values),
        sign,
        start_s + along / feed * 60.0,
        weight,
        np.array(test.centre_mm),
        test.radius_mm,
        u_length_mm=tools.u_bar_length_mm,
        length_calibrated=True,
        test="helix",
    )


@dataclass(frozen=True, slots=True)
class Opening:
    """Direction in which hemispheres open: ``side`` (1 or -1) of ``axis``; ``warning``: why this direction is doubtful, or empty."""

    axis: int
    side: int
    warning: str = ""

    @property
    def text(self) -> str:
        """The direction as text, for example +Z."""
        return f"{'+' if self.side > 0 else '-'}{AXES[self.axis]}"


def opening(machine: Machine, vertical: int = 2) -> Opening:
    """Find the side of the cup on which the spindle is. The tool vector points from the spindle to the ball, away from this side.

    Without a known tool the result is the upper side of the vertical axis, which is right for a vertical spindle.
    """
    longest = int(np.argmax(np.abs(machine.tool_mm)))
    sizes = np.sort(np.abs(machine.tool_mm))
    if sizes[2] < SHORTEST_TOOL_MM:
        reason = f"hemispheres open along +{AXES[vertical]}, the vertical axis: without tool_mm the direction of the spindle is unknown"
        return Opening(vertical, 1, f"{reason}; if the spindle is horizontal, state tool_mm in the machine file, or it may hit the cup")
    found = Opening(longest, -1 if machine.tool_mm[longest] > 0 else 1)
    if sizes[1] < OBLIQUE * sizes[2]:
        return found
    tool = ", ".join(f"{v:g}" for v in machine.tool_mm)
    warning = (
        f"hemispheres open along {found.text}, against the longest component of tool_mm ({tool}); the tool is oblique: check that the "
        "spindle cannot hit the cup"
    )
    return Opening(found.axis, found.side, warning)


def candidates(machine: Machine, tools: Instruments, vertical: int = 2) -> tuple[Measurement, ...]:
    """All measurements that the planner may choose from, helices first.

    Parameters
    ----------
    vertical : int
        Index of the vertical axis. Hemispheres open upwards along it if the tool vector does not show where the spindle is (`opening`).

    Raises
    ------
    ValueError
        Nothing fits into the strokes.
    """
    found: list[Measurement] = []
    spindle = opening(machine, vertical)
    for radius in sorted(tools.bar_lengths_mm):
        found += [HelixTest(c, radius, axis=spindle.axis, opens=spindle.side) for c in helix_centres(machine, radius, spindle)]
    if tools.laser and (machine.length_mm > 4 * CLEARANCE_MM).all():
        found += [LineTest(a, (u, v)) for a in range(3) for u, v in product(EDGES, repeat=2)]
        found += [DiagonalTest(d, order) for d in DIAGONALS for order in (*ORDERS, "")]
    if not found:
        raise ValueError("planner: no helix with any of the bars and no laser path fits into the strokes")
    return tuple(found)


def _room(machine: Machine, radius_mm: float, spindle: Opening) -> tuple[F1, F1]:
    """Lowest and highest cup centre (whole mm) at which a hemisphere of this radius stays inside the strokes."""
    below, above = np.full(3, radius_mm + BAR_CLEARANCE_MM), np.full(3, radius_mm + BAR_CLEARANCE_MM)
    (below if spindle.side > 0 else above)[spindle.axis] = BAR_CLEARANCE_MM
    return np.ceil(machine.stroke_mm[:, 0] + below), np.floor(machine.stroke_mm[:, 1] - above)


def bars_that_fit(machine: Machine, tools: Instruments, test: HelixTest) -> tuple[float, ...]:
    """Lengths (mm) of the bars whose whole hemisphere about the cup of ``test`` stays inside the strokes."""
    fit = []
    for radius in tools.bar_lengths_mm:
        lo, hi = _room(machine, radius, Opening(test.axis, test.opens))
        if (lo <= test.centre_mm).all() and (test.centre_mm <= hi).all():
            fit.append(radius)
    return tuple(fit)


def helix_centres(machine: Machine, radius_mm: float, spindle: Opening) -> tuple[Point, ...]:
    """A grid of cup centres (whole mm) at which the whole hemisphere of this radius stays inside the strokes."""
    lo, hi = _room(machine, radius_mm, spindle)
    if (hi < lo).any():
        return ()
    places = []
    for a in range(3):
        room = hi[a] - lo[a]
        n = 1 if room < 0.2 * radius_mm else 2 if room < 0.7 * radius_mm else 3
        places.append([float(v) for v in np.round(np.linspace(lo[a], hi[a], n) if n > 1 else [0.5 * (lo[a] + hi[a])])])
    return tuple((x, y, z) for x, y, z in product(*places))
