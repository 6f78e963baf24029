"""wang_step_diagonal.json, last parts: plans behind its ranks, and its demonstration of what compensation leaves (math.md 5.5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.monomials import ErrorArrays, monomials
from abbe.models.papers.wang.experiments import Plan, distance_errors_mm, interpolated_mm, problem, readings
from abbe.models.papers.wang.model import exact_positions_mm, monomial_field
from abbe.models.solvers.designs import shortest_solution
from abbe.models.solvers.step_diagonal import increments, wang_eq7
from abbe.models.volumetric import volume_grid
from abbe.service.vectors.case import Case
from abbe.service.vectors.checks import Checks

RANK_STEPS = 20
RANK_POSITIONS = 20
"""math.md 4.6 has 20 steps; with 20 positions per line, and only so, all effective ranks of the file come out."""
ORDERS2 = ("XYZ", "ZYX")
RANK_PLANS: dict[str, Callable[[F1], Plan]] = {
    "ideal mirror": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, tilts=False),
    "8 tilt unknowns": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS),
    "8 tilt + linear laser X": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, axes="X"),
    "8 tilt + linear laser X,Y": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, axes="XY"),
    "8 tilt + linear laser X,Y,Z": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, axes="XYZ"),
    "two orders XYZ,ZYX, 16 tilt": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2),
    "two orders + linear X,Y,Z, 16 tilt": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2, axes="XYZ"),
    "two orders + linear XYZ on 2 edges, 16 tilt": lambda t: Plan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2, axes="XYZ", edges=(0, 1)),
}
NODES = 5
DEGREE = 3
ANGLE_SCALE = 1.0 / 500.0
"""Relative weight of angles, squareness and tilts against millimetres in the file's minimum-norm solution (as in yang_ballbar_complete)."""
IDEAL, TILTED = "with_angles|none", "with_angles|tilt_0.5mrad"
NOISY = "same with 0.1um noise"
DEMO_PLANS: dict[str, Callable[[F1, int], Plan] | None] = {
    "no_compensation": None,
    "wang_eq7_ideal_mirror": None,
    "wang_eq7_tilt_0.5mrad": None,
    "rigid_lsq_1order_linXYZ_1edge (rank 36/39)": lambda t, n: Plan(t, n, n + 1, axes="XYZ"),
    "rigid_lsq_2orders_linXYZ_2edges (rank 39/39)": lambda t, n: Plan(t, n, n + 1, ORDERS2, axes="XYZ", edges=(0, 1)),
    NOISY: None,
}
UM = 1e3


def demonstration(case: Case, checks: Checks, n: int, inc: F1, errors_of: Callable[[Case, F2, F1], ErrorArrays]) -> None:
    """Worst error of all distances in a grid before and after each compensation, of the machine ``with_angles`` (found out: it fits)."""
    travel, demo, machine = n * inc, case.at("compensation_demo"), case.at("cases", TILTED)
    grid = volume_grid(np.stack([np.zeros(3), travel], axis=1), NODES)

    def deviation(points_mm: F2) -> F2:
        return exact_positions_mm(errors_of(machine, points_mm, travel), points_mm)

    def worst_um(model_mm: F2) -> float:
        return float(np.abs(distance_errors_mm(grid, model_mm, deviation(grid))).max()) * UM

    def curves(name: str) -> F2:
        q = increments({d: v.array() for d, v in case.at("cases", name, "readings").items()})
        return interpolated_mm(grid, inc, wang_eq7(q, inc))

    maps = {"no_compensation": np.zeros_like(grid), "wang_eq7_ideal_mirror": curves(IDEAL), "wang_eq7_tilt_0.5mrad": curves(TILTED)}
    tilts = {name: angles.array() for name, angles in machine.at("tilt").items()}
    checks.assume(
        f"compensation_demo is of the machine {TILTED!r}: all distances in a grid of {NODES} nodes per axis; rigid-body solutions of "
        f"degree {DEGREE} weight angles {ANGLE_SCALE:g} against mm"
    )
    for key, plan in DEMO_PLANS.items():
        if plan is not None:
            maps[key] = _rigid(plan(travel, n), grid, deviation, tilts)
        if key in maps:
            why = "distances of 1000 mm subtracted, and readings good to 3e-13 mm; in µm"
            checks.compare(
                "worst distance after compensation", worst_um(maps[key]), demo.at(key), unit="1", floor=1e-9, rounding=why, relative=1e-9
            )
    checks.leave_out("worst distance after compensation, with noise", demo.at(NOISY), "the draws of the noise are not in the file")


def _rigid(plan: Plan, grid_mm: F2, deviation: Callable[[F2], F2], tilts: dict[str, F1]) -> F2:
    """Map of the cubic rigid-body model by least squares with mirror tilts as unknowns."""
    a, setup = problem(plan, DEGREE)
    terms = monomials(DEGREE)
    scale = np.array([1.0 if t.kind == "d" else ANGLE_SCALE for t in terms] + [ANGLE_SCALE] * setup.shape[1])
    theta = shortest_solution(np.concatenate([a, setup], axis=1), readings(plan, deviation, tilts), scale)
    return np.asarray(monomial_field(terms, grid_mm, plan.travel_mm) @ theta[: len(terms)])
