"""Measurements a plan chooses from: set-up, positions and expected record of each.

The service's sequences move to the same positions (a test keeps both in step); here they are reduced to the needs of the solver's design.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import AXES, Machine
from abbe.models.paths.helix import helix_points
from abbe.models.paths.lines import diagonal_ends, step_diagonal, straight_line
from abbe.models.planning.instruments import Instruments
from abbe.models.solvers.observations import RunData, Test

Point = tuple[float, float, float]
RAPID_MM_MIN = 6000.0
BAR_FEED_MM_MIN = 2000.0
BAR_RATE_HZ = 100.0
READING_S = 0.4
"""Settling and reading of the laser at one position."""
CLEARANCE_MM = 10.0
"""Laser paths keep this distance from the ends of the strokes."""
BAR_VALUES = 400
"""Block averages that one ball-bar run gives the solution."""
_FINE = 8


@dataclass(frozen=True, slots=True)
class HelixTest:
    """Ball-bar on a hemispherical helix about one cup, pole to equator or (direction -1) back.

    ``axis``, ``opens``: the pole stands on this axis, on its positive (1) or negative (-1) side of the cup: where the spindle is.
    """

    centre_mm: Point
    radius_mm: float
    direction: int = 1
    turns: float = 5.0
    axis: int = 2
    opens: int = 1

    @property
    def mounting(self) -> str:
        """Tests with equal mounting share what was mounted: this cup."""
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
        """Tests with equal mounting share the mirror's tilt."""
        return f"diagonal {self.diagonal}"

    @property
    def label(self) -> str:
        """Name of the test within a plan."""
        return f"diagonal {self.diagonal} {self.order or 'plain'}"


@dataclass(frozen=True, slots=True)
class LineTest:
    """Laser along one axis, ``n`` positions out and back; ``at``: relative places of the two other axes, in the order X, Y, Z."""

    axis: int
    at: tuple[float, float]
    n: int = 25

    @property
    def mounting(self) -> str:
        """Every line has its own alignment."""
        return self.label

    @property
    def label(self) -> str:
        """Name of the test within a plan."""
        return f"line {AXES[self.axis]} {self.at[0]:g},{self.at[1]:g}"


Measurement = HelixTest | DiagonalTest | LineTest


def laser_path(machine: Machine, test: DiagonalTest | LineTest) -> tuple[F2, F1]:
    """Positions of a laser test, shape (n, 3), and its nominal beam (unit vector)."""
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
    if test.opens < 0:  # seen in a mirror across the equator
        points[:, test.axis] = 2.0 * test.centre_mm[test.axis] - points[:, test.axis]
    return points if test.direction > 0 else points[::-1]


def feed_mm_min(tools: Instruments, test: Measurement) -> float:
    """Feed along a test's path: the usual one, or the machine's fastest where that is less."""
    return min(BAR_FEED_MM_MIN if isinstance(test, HelixTest) else RAPID_MM_MIN, tools.max_feed_mm_min)


def machine_seconds(machine: Machine, test: Measurement, tools: Instruments) -> float:
    """Time the machine moves and reads for one test: out to the path, along it, reading; without any set-up."""
    feed = feed_mm_min(tools, test)
    if isinstance(test, HelixTest):
        length = np.linalg.norm(np.diff(helix_path(test, 2000), axis=0), axis=1).sum()
        return float(length / feed + test.radius_mm / min(RAPID_MM_MIN, tools.max_feed_mm_min)) * 60.0
    path, _ = laser_path(machine, test)
    travel = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    return float(travel / feed * 60.0 + READING_S * len(path))


def expected_run(machine: Machine, test: Measurement, tools: Instruments, *, values: int = BAR_VALUES, start_s: float = 0.0) -> RunData:
    """The run that a perfect machine would give: real positions, directions, times and weights; every deviation zero.

    A ball-bar run comes as ``values`` block means on the sphere, each of ``weight_n`` readings; a laser run has one reading a position.
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
