"""Where to put ball-bars and lasers in any machine's strokes: realistic campaigns, no more than an afternoon's work."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line

Kind = Literal["one_tool", "two_tool", "ballbar_only", "laser_only", "joint"]
RADII_MM = (50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0)
MARGIN_MM = 10.0
TURNS = 5
SAMPLES = 2000
"""Raw readings of one ball-bar run, at 33 a second a minute."""


@dataclass(frozen=True)
class Bar:
    """A planned ball-bar run; runs with the same ``setup`` use one cup."""

    label: str
    setup: str
    path_mm: np.ndarray
    centre_mm: np.ndarray
    radius_mm: float
    tool: int


@dataclass(frozen=True)
class Beam:
    """A planned laser run."""

    label: str
    path_mm: np.ndarray
    beam: np.ndarray
    tool: int = 0


def plan(machine: Machine, kind: Kind, rng: np.random.Generator) -> list[Bar | Beam]:
    """Runs of a campaign of one kind: 6 to 20."""
    large, small = radii(machine)
    if kind == "one_tool":
        return [*helices(machine, [large] * 3 + [small], 0, rng), *lines(machine, 1, rng), *diagonals(machine, ["XYZ"], rng)]
    if kind == "two_tool":
        first, second = helices(machine, [large] * 3, 0, rng), helices(machine, [large] * 2 + [small], 1, rng)
        return [*first, *second, *lines(machine, 1, rng), *diagonals(machine, ["XYZ"], rng)]
    if kind == "ballbar_only":
        count = int(rng.integers(2, 5))
        return [*helices(machine, [large] * count + [small] * 2, 0, rng), *circles(machine, large, rng)]
    if kind == "laser_only":
        orders = ["XYZ", "ZYX"] if rng.random() < 0.5 else ["XYZ"]
        return [*lines(machine, int(rng.integers(2, 4)), rng), *diagonals(machine, orders, rng)]
    return [*helices(machine, [large] * 4 + [small] * 2, 0, rng), *diagonals(machine, ["XYZ", "ZYX"], rng), *lines(machine, 1, rng)]


def radii(machine: Machine) -> tuple[float, float]:
    """A large bar that fits comfortably, and the next smaller one but one half as long or less."""
    fits = [r for r in RADII_MM if r <= 0.42 * float(machine.length_mm.min())]
    large = fits[-1]
    return large, max(r for r in RADII_MM if r <= 0.67 * large)


def helices(machine: Machine, sizes: list[float], tool: int, rng: np.random.Generator) -> list[Bar]:
    """One helix per size about a random axis, the first in the middle of the strokes, the others spread."""
    runs: list[Bar] = []
    for k, radius in enumerate(sizes):
        axis = int(rng.integers(3))
        low, high = _room(machine, radius, axis)
        share = np.full(3, 0.5) if k == 0 else rng.uniform(0.0, 1.0, 3)
        centre = low + share * (high - low)
        path = helix_points(centre, radius, turns=TURNS, n=SAMPLES, law="area", axis=axis)
        label = f"helix{len(runs)}t{tool}"
        runs.append(Bar(label, label, path, centre, radius, tool))
    return runs


def circles(machine: Machine, radius: float, rng: np.random.Generator) -> list[Bar]:
    """Full circles there and back in two planes about one cup in the middle."""
    centre = machine.centre_mm
    turn = np.linspace(0.0, 2.0 * np.pi, SAMPLES // 2)
    turn = np.concatenate([turn, turn[::-1]])
    runs = []
    for skip in rng.choice(3, 2, replace=False):
        a, b = (int(skip) + 1) % 3, (int(skip) + 2) % 3
        path = np.tile(centre, (turn.size, 1))
        path[:, a] += radius * np.cos(turn)
        path[:, b] += radius * np.sin(turn)
        runs.append(Bar(f"circle{'XYZ'[a]}{'XYZ'[b]}", "circles", path, centre, radius, 0))
    return runs


def lines(machine: Machine, each: int, rng: np.random.Generator) -> list[Beam]:
    """Positioning lines along every axis at ``each`` random places of the other two."""
    box = _box(machine)
    runs = []
    for axis in range(3):
        for k in range(each):
            start = rng.uniform(box[:, 0], box[:, 1])
            end = start.copy()
            start[axis], end[axis] = box[axis]
            runs.append(Beam(f"line{'XYZ'[axis]}{k}", straight_line(start, end, 25), np.eye(3)[axis]))
    return runs


def diagonals(machine: Machine, orders: list[str], rng: np.random.Generator) -> list[Beam]:
    """The four step diagonals in each order of axes."""
    box, steps = _box(machine), int(rng.integers(9, 13))
    runs = []
    for order in orders:
        for name in DIAGONALS:
            start, end = diagonal_ends(box, name)
            beam = (end - start) / np.linalg.norm(end - start)
            runs.append(Beam(f"diagonal_{name}_{order}", step_diagonal(start, end, steps, order), beam))
    return runs


def _box(machine: Machine) -> np.ndarray:
    return machine.stroke_mm + np.array([MARGIN_MM, -MARGIN_MM])


def _room(machine: Machine, radius: float, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the centre of a hemisphere about an axis may lie."""
    box = _box(machine)
    low, high = box[:, 0] + radius, box[:, 1] - radius
    low[axis] = box[axis, 0]
    return low, high
