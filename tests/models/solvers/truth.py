"""Machines that the solvers cannot represent, and the runs that a ball-bar and a laser would record on them."""

from collections.abc import Callable

import numpy as np

from abbe.models.geometry.chain import exact_deviation_mm, travel_sign
from abbe.models.machine import Machine, with_tool
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observations import RunData, block_average
from abbe.models.solvers.observe import perpendicular

MACHINE = Machine(
    "w-X-Y-b-Z-t",
    np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]),
    np.array([[300.0, 250.0, -150.0], [300.0, 250.0, -250.0], [0.0, 320.0, 260.0]]),
    np.array([0.0, 0.0, -120.0]),
)
PLACES = [(300, 250, 135, 200), (192, 180, 90, 165), (408, 320, 90, 165), (192, 320, 112, 165), (408, 180, 112, 165)]
"""Centre and radius of the five helices, mm."""


class Truth:
    """A seeded machine: sines and a bump, not polynomials; finite rotations."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.wave = rng.uniform(0.7, 2.5, (3, 6, 3))
        self.phase = rng.uniform(0, 2 * np.pi, (3, 6, 3))
        self.size = rng.normal(0, 1.0, (3, 6, 3)) * np.r_[[2e-3] * 3, [6e-6] * 3][None, :, None]
        self.slope = np.zeros((3, 6))
        self.slope[[0, 1, 2], [0, 1, 2]] = rng.normal(0, 40e-6, 3)
        self.square = rng.normal(0, 25e-6, 3)
        self.backlash = rng.uniform(1e-3, 5e-3, 3)

    def motions(self, p: np.ndarray) -> np.ndarray:
        out = np.empty((len(p), 3, 6))
        for a in range(3):
            u = p[:, a] / MACHINE.length_mm[a]
            out[:, a] = (self.size[a] * np.sin(2 * np.pi * u[:, None, None] / self.wave[a] + self.phase[a])).sum(-1)
            out[:, a] += self.slope[a] * p[:, a, None]
        out[:, 1, 0] -= self.square[0] * p[:, 1]
        out[:, 2, 0] += self.square[1] * p[:, 2]
        out[:, 2, 1] -= self.square[2] * p[:, 2]
        return out

    def deviation(self, p: np.ndarray, sign: np.ndarray | None = None, tool_mm: np.ndarray | None = None) -> np.ndarray:
        d = exact_deviation_mm(with_tool(MACHINE, tool_mm), p, self.motions(p))
        return d if sign is None else d - 0.5 * sign * self.backlash

    def bar(self, label: str, centre: np.ndarray, radius: float, length_mm: float = 1.5e-3, tool_mm: np.ndarray | None = None) -> RunData:
        p = helix_points(centre, radius, turns=5, n=int(radius * 20), law="area", axis=2)
        sign = travel_sign(p)
        offset = self.deviation(centre[None], None, tool_mm)[0] + self.rng.normal(0, 10e-3, 3)
        reading = np.linalg.norm(p + self.deviation(p, sign, tool_mm) - centre - offset, axis=1) - radius + length_mm
        reading += self.rng.normal(0, 4e-4, len(p))
        n = len(p)
        return RunData(label, label, "bar", p, reading, sign, np.arange(n) * 0.03, np.ones(n), centre, radius, None, 2e-3, True, tool_mm)

    def laser(self, label: str, p: np.ndarray) -> RunData:
        beam = (p[len(p) // 2] - p[0]) / np.linalg.norm(p[len(p) // 2] - p[0])
        tilt = self.rng.normal(0, 150e-6, 2) @ perpendicular(beam)
        sign = travel_sign(p)
        moved, turned = p + self.deviation(p, sign), self.motions(p)[:, :, 3:].sum(axis=1)
        m = beam + tilt + np.cross(turned, beam + tilt)  # the mirror is on the spindle
        reading = ((moved - moved[0]) * m).sum(axis=1) / (m @ beam) - (p - p[0]) @ beam + self.rng.normal(0, 2.4e-4, len(p))
        return RunData(label, label, "laser", p, reading, sign, np.arange(len(p)) * 1.0, np.ones(len(p)), beam=beam)

    def helices(self, tool_mm: np.ndarray | None = None, length_mm: float = 1.5e-3) -> list[RunData]:
        bars = [self.bar(f"h{k}", np.array(c[:3], float), c[3], length_mm, tool_mm) for k, c in enumerate(PLACES)]
        return [block_average(b, 300) for b in bars]

    def campaign(self) -> tuple[RunData, ...]:
        runs = self.helices()
        box = MACHINE.stroke_mm + np.array([10.0, -10.0])
        for a in range(3):
            for at in (0.15, 0.85):
                start = MACHINE.stroke_mm[:, 0] + at * MACHINE.length_mm
                end = start.copy()
                start[a], end[a] = box[a]
                runs.append(self.laser(f"l{a}{at}", straight_line(start, end, 25)))
        for order in ("XYZ", "ZYX"):
            runs += [self.laser(f"d{d}{order}", step_diagonal(*diagonal_ends(box, d), 12, order)) for d in DIAGONALS]
        return tuple(runs)


SolvedTruth = Callable[[int], tuple[Truth, JointSolution]]
"""The fixture ``solved_truth``: a machine by its seed, and the solution of its campaign."""
SIGMA = {"bar": 4e-4, "laser": 3e-4}
FLOOR = {"bar": 3e-4, "laser": 3e-4}


def linear_parameters(grid: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """EXX, EYY, EZZ slopes and C0Y, B0Z, A0Z of a deviation field."""
    centred = grid - grid.mean(axis=0)
    m = deviation.T @ centred / np.sum(centred**2, axis=0)  # [output, input]
    return np.array([m[0, 0], m[1, 1], m[2, 2], -m[0, 1] - m[1, 0], m[0, 2] + m[2, 0], -m[1, 2] - m[2, 1]])
