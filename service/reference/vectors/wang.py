"""`wang_step_diagonal.json`: simulated step diagonals with and without tilt, squareness, ranks, and a demonstration of compensation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.monomials import ErrorArrays, monomials
from abbe.models.geometry.volume import volume_grid
from abbe.models.papers.wang.experiments import WangPlan, distance_errors_mm, interpolated_mm, problem, readings
from abbe.models.papers.wang.model import (
    diagonal_beam,
    displacement_eq11,
    exact_positions_mm,
    mirror_normal,
    monomial_field,
    step_readings_mm,
)
from abbe.models.papers.wang.squareness import AcuteSquareness, diagonal_totals_eq12, squareness_eq13_printed
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal
from abbe.models.solvers.designs import ranks, shortest_solution
from abbe.models.solvers.step_diagonal import closure_mm, demeaned, increments, squareness_contrast, wang_eq7, wang_four
from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import LAYOUT, VectorCase

RANK_STEPS = 20
RANK_POSITIONS = 20
"""Positions found by trial: only with them do the effective ranks equal those in the file."""
ORDERS2 = ("XYZ", "ZYX")
RANK_PLANS: dict[str, Callable[[F1], WangPlan]] = {
    "ideal mirror": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, tilts=False),
    "8 tilt unknowns": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS),
    "8 tilt + linear laser X": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, axes="X"),
    "8 tilt + linear laser X,Y": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, axes="XY"),
    "8 tilt + linear laser X,Y,Z": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, axes="XYZ"),
    "two orders XYZ,ZYX, 16 tilt": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2),
    "two orders + linear X,Y,Z, 16 tilt": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2, axes="XYZ"),
    "two orders + linear XYZ on 2 edges, 16 tilt": lambda t: WangPlan(t, RANK_STEPS, RANK_POSITIONS, ORDERS2, axes="XYZ", edges=(0, 1)),
}
NODES = 5
DEGREE = 3
ANGLE_SCALE = 1.0 / 500.0
"""Weight of angles, squareness and tilts against mm in the minimum-norm solution of the file."""
IDEAL, TILTED = "with_angles|none", "with_angles|tilt_0.5mrad"
NOISY = "same with 0.1um noise"
DEMO_PLANS: dict[str, Callable[[F1, int], WangPlan] | None] = {
    "no_compensation": None,
    "wang_eq7_ideal_mirror": None,
    "wang_eq7_tilt_0.5mrad": None,
    "rigid_lsq_1order_linXYZ_1edge (rank 36/39)": lambda t, n: WangPlan(t, n, n + 1, axes="XYZ"),
    "rigid_lsq_2orders_linXYZ_2edges (rank 39/39)": lambda t, n: WangPlan(t, n, n + 1, ORDERS2, axes="XYZ", edges=(0, 1)),
    NOISY: None,
}
UM = 1e3


LAST = "last digits"
CURVES = tuple(i + a for a in "XYZ" for i in "XYZ")


def read(case: VectorCase, checks: Checks) -> None:
    """Compare every case of the file with computed numbers, then its squareness, ranks and demonstration."""
    n = case.whole("n")
    inc = case.array("inc", shape=(3,))
    for _ in case.at("compensation_demo").named("metric", *DEMO_PLANS):
        pass  # check that all exist; they are compared last
    for _, part in case.at("cases").items():
        _readings(part, checks, n, inc)
        _curves(part, checks, n, inc)
    _squareness(case.at("squareness"), checks)
    checks.assume(
        f"the ranks hold for {RANK_STEPS} steps per diagonal and {RANK_POSITIONS} positions per straight line, the only numbers that give "
        "all effective ranks"
    )
    for key, part in case.at("ranks").named(*RANK_PLANS):
        plan = RANK_PLANS[key](n * inc)
        wanted = len(case.at("ranks", next(iter(RANK_PLANS))).parts())
        if len(part.parts()) != wanted:
            raise FileFormatError(f"{part.label}: expected {wanted} polynomial degrees, got {len(part.parts())}", LAYOUT)
        found = [ranks(*problem(plan, degree + 1)) for degree in range(len(part.parts()))]
        checks.compare("rank and effective rank", found, part, unit="1")
    _demonstration(case, checks, n, inc)


def errors_of(part: VectorCase, axes_mm: F2, travel_mm: F1) -> ErrorArrays:
    """Return the errors of a case: ``d_coef["YX"]`` holds the coefficients of (x / travel)^1, ^2, .. in delta_y(X), mm; ``a_coef``, rad."""
    u = np.asarray(axes_mm) / travel_mm
    d, e = np.zeros((len(u), 3, 3)), np.zeros((len(u), 3, 3))
    for out, key in ((d, "d_coef"), (e, "a_coef")):
        for i in range(3):
            for j in range(3):
                c = part.array(key, "XYZ"[i] + "XYZ"[j], shape=(None,))
                out[:, i, j] = sum(v * u[:, j] ** (k + 1) for k, v in enumerate(c))
    xy, yz, xz = part.array("txy_tyz_txz", shape=(3,))
    return ErrorArrays(d, e, np.array([xy, xz, yz]))


def tilts_of(part: VectorCase) -> dict[str, F1]:
    """Return the mirror tilts of a case, two angles per diagonal; empty for ideal mirrors."""
    if not part.at("tilt").value:
        return {}
    return {name: angles.array(shape=(2,)) for name, angles in part.at("tilt").named(*DIAGONALS)}


def _readings(part: VectorCase, checks: Checks, n: int, inc: F1) -> None:
    tilts, travel = tilts_of(part), n * inc
    box = np.stack([np.zeros(3), travel], axis=1)
    for name in DIAGONALS:
        path = step_diagonal(*diagonal_ends(box, name), n, back=False)
        beam = diagonal_beam(inc, name)
        mirror = mirror_normal(beam, tilts.get(name, np.zeros(2)))
        found = step_readings_mm(path, exact_positions_mm(errors_of(part, path, travel), path), beam, mirror)
        stored, rounding = part.at("readings", name), "difference of positions of up to 1000 mm"
        checks.compare("readings, exact", found, stored, unit="mm", floor=6e-13, rounding=rounding)


def _curves(part: VectorCase, checks: Checks, n: int, inc: F1) -> None:
    """Compare everything derived from the stored readings."""
    q = increments({name: part.array("readings", name) for name in DIAGONALS})
    for name, values in q.items():
        checks.compare("q", values, part.at("q", name), unit="mm", floor=1e-17, rounding=LAST)
    seven, four, flat = wang_eq7(q, inc), wang_four(q, inc), wang_eq7(demeaned(q), inc)
    for key, found in (("wang_eq7", seven), ("wang_lsq4", four), ("wang_demeaned", flat)):
        for name, stored in part.at(key).named(*CURVES):
            checks.compare(key, found["XYZ".index(name[0]), "XYZ".index(name[1])], stored, unit="mm", floor=2e-16, rounding=LAST)
    for name, stored in part.at("truth_eq11_translational").named(*CURVES):
        i, a = "XYZ".index(name[0]), "XYZ".index(name[1])
        line = np.outer(np.arange(n + 1) * inc[a], np.eye(3)[a])
        true = displacement_eq11(errors_of(part, line, n * inc), line)[:, i, a]
        checks.compare("truth, eq (11) on the axis", true, stored, unit="mm", floor=1e-17, rounding=LAST)
        worst, error = np.abs(seven[i, a] - true).max(), part.at("max_abs_error_eq7", name)
        checks.compare("largest error of eq (7)", worst, error, unit="mm", floor=2e-16, rounding=LAST)
    checks.compare("closure", np.abs(closure_mm(q)).max(), part.at("closure_max"), unit="mm", floor=1e-17, rounding=LAST)


def _squareness(part: VectorCase, checks: Checks) -> None:
    length, scale = part.array("L", shape=(3,)), part.array("scale_ppm", shape=(3,))
    acute = AcuteSquareness(*(-part.number("theta_obtuse", k) for k in ("tyz", "txz", "txy")))
    for name, total in diagonal_totals_eq12(acute, length, scale).items():
        stored, rounding = part.at("dR_total", name), "difference of two lengths of 1024 mm"
        checks.compare("totals, eq (12) with scales", total, stored, unit="mm", floor=6e-13, rounding=rounding)
    totals = {name: part.number("dR_total", name) for name in DIAGONALS}
    printed = squareness_eq13_printed(totals, length)
    contrast = squareness_contrast(totals, length)
    pairs = (
        ("squareness, eq (13) as printed", "printed_eq13_acute", "tyz", printed.theta_yz),
        ("squareness, eq (13) as printed", "printed_eq13_acute", "tzx", printed.theta_zx),
        ("squareness, eq (13) as printed", "printed_eq13_acute", "txy", printed.theta_xy),
        ("squareness, contrasts", "contrast_obtuse", "tyz", contrast.theta_yz),
        ("squareness, contrasts", "contrast_obtuse", "txz", contrast.theta_xz),
        ("squareness, contrasts", "contrast_obtuse", "txy", contrast.theta_xy),
    )
    for name, key, letter, value in pairs:
        checks.compare(name, value, part.at(key, letter), unit="rad", floor=1e-19, rounding=LAST)


def _demonstration(case: VectorCase, checks: Checks, n: int, inc: F1) -> None:
    """Compare the largest error of all distances in a grid before and after each compensation."""
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
        f"compensation_demo holds for the machine {TILTED!r} and all distances in a grid of {NODES} nodes per axis; rigid-body solutions "
        f"of degree {DEGREE} weight angles {ANGLE_SCALE:g} against mm"
    )
    for key, plan in DEMO_PLANS.items():
        if plan is not None:
            maps[key] = _rigid(plan(travel, n), grid, deviation, tilts)
        if key in maps:
            why = "difference of distances of 1000 mm, and readings accurate to 3e-13 mm; in µm"
            worst = worst_um(maps[key])
            checks.compare("worst distance after compensation", worst, demo.at(key), unit="1", floor=1e-9, rounding=why, relative=1e-9)
    checks.leave_out("worst distance after compensation, with noise", demo.at(NOISY), "the file does not contain the noise")


def _rigid(plan: WangPlan, grid_mm: F2, deviation: Callable[[F2], F2], tilts: dict[str, F1]) -> F2:
    """Return the map of the cubic rigid-body model fitted by least squares with the mirror tilts as unknowns."""
    a, setup = problem(plan, DEGREE)
    terms = monomials(DEGREE)
    scale = np.array([1.0 if t.kind == "d" else ANGLE_SCALE for t in terms] + [ANGLE_SCALE] * setup.shape[1])
    theta = shortest_solution(np.concatenate([a, setup], axis=1), readings(plan, deviation, tilts), scale)
    return np.asarray(monomial_field(terms, grid_mm, plan.travel_mm) @ theta[: len(terms)])
