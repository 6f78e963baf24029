"""`kwon_kinematics.json` and `kwon_rsm.json`: the 3-PUU machine and the response surfaces of its errors."""

from __future__ import annotations

import re

import numpy as np

from abbe.models.papers.kwon.forensics import (
    LADDER,
    coefficients_from_planes,
    grid_sums,
    in_plane_coefficients,
    in_plane_label,
    square_grid,
)
from abbe.models.papers.kwon.frames import best_fit_errors, nearest_rotation, three_point_errors, three_point_frame
from abbe.models.papers.kwon.kinematics import (
    PER_LEG,
    Geometry,
    forward,
    forward_as_printed,
    inverse,
    jacobian,
    parameter_jacobian,
    square_commands,
)
from abbe.models.papers.kwon.layout import IN_PLANE, layout
from abbe.models.papers.kwon.surface import anova_from_sums, critical_f, fit_surface
from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import LAYOUT, VectorCase

HALF_MM = 1.0
MIDDLE_MM = 1.0
"""The workspace is the square of +-1 mm at the height of the ball centre when all drives are at 1 mm."""

ROOTS = "roots of 1e4 mm2"
DIGITS = 4
"""Significant digits of Table 1 in print."""
PRINTED_DIGITS = 7
"""Largest number of significant digits in Table 2."""
SUM_DIGITS = 3
"""Valid digits of the sums of squares of regression and total in Table 2; a printed fourth digit 0 (4.240e-2) may be padding."""
COMPONENTS = ("ex", "ey", "ez")
PLANES = ("rank plane 9x9, Z=const", "rank 2 planes", "rank 3 planes", "rank 4 planes")
NEAR_F = 1e-3
"""Accepted relative difference of the printed F from a quotient of other printed numbers, because of their rounding."""
REGRESSION_DOF, RESIDUAL_DOF = 20, 60
"""Degrees of freedom of the paper, for the mean squares in the file."""
POINTS = 81
RANK = 10
UM = 1e3
NEAR_MM = 1e-3
"""Points within this distance of the paper's grid are taken as that grid."""
PRINT = "quotient of two numbers of four digits"


def read_kinematics(case: VectorCase, checks: Checks) -> None:
    """Compare everything that the file's own inputs determine."""
    geometry = _geometry(case.at("geometry"))
    for part in case.at("fk").parts():
        _pose(geometry, part, checks)
    _example(geometry, case.at("example"), checks)
    top = forward(geometry, np.full((1, 3), MIDDLE_MM))[0, 2]
    stroke = square_commands(geometry, HALF_MM, float(top))
    checks.compare("stroke for +-1 mm", stroke, case.at("workspace_lambda"), unit="mm", floor=2e-13, rounding=ROOTS)
    command = case.array("example", "lambda")[None]
    sensitivities = parameter_jacobian(geometry, command)
    for name in PER_LEG:
        stored = case.at("param_jacobian_at_example", name)
        checks.compare("dP/dparameter", sensitivities[name][0], stored, unit="1", floor=2e-14, rounding="3 x 3 solves of 100-mm links")
    _frame(case.at("frame"), checks)


def _geometry(part: VectorCase) -> Geometry:
    names = {"R": "R_mm", "r": "r_mm", "l": "l_mm", "lup": "l_up_mm", "ldw": "l_dw_mm", "theta": "theta_rad", "le": "le_mm"}
    return Geometry(**{field: part.number(name) for name, field in names.items()})  # type: ignore[arg-type]


def _pose(geometry: Geometry, part: VectorCase, checks: Checks) -> None:
    command, p = part.array("lambda", shape=(3,))[None], part.array("P", shape=(3,))[None]
    checks.compare("forward solution", forward(geometry, command)[0], part.at("P"), unit="mm", floor=2e-13, rounding=ROOTS)
    for name in ("ik", "lambda"):  # the inverse solution must return the command
        checks.compare("inverse solution", inverse(geometry, p)[0], part.at(name), unit="mm", floor=2e-13, rounding=ROOTS)
    checks.compare("dP/dlambda", jacobian(geometry, command)[0], part.at("J"), unit="1", floor=2e-15)
    printed = forward_as_printed(geometry, command)[0]
    checks.compare("(4) as printed", printed, part.at("P_printed_eq4"), unit="mm", floor=4e-13, rounding=ROOTS)


def _example(geometry: Geometry, part: VectorCase, checks: Checks) -> None:
    command = part.array("lambda", shape=(3,))[None]
    checks.compare("forward solution", forward(geometry, command)[0], part.at("P"), unit="mm", floor=2e-13, rounding=ROOTS)
    printed = forward_as_printed(geometry, command)[0]
    checks.compare("(4) as printed", printed, part.at("P_printed"), unit="mm", floor=4e-13, rounding=ROOTS)


def _frame(part: VectorCase, checks: Checks) -> None:
    nominal3, measured3 = part.array("nominal3", shape=(3, 3)), part.array("measured3", shape=(3, 3))
    targets, measured = part.array("targets", shape=(None, 3)), part.array("measured", shape=(None, 3))
    sides = "differences of 300-mm coordinates over 2 mm"
    for name, points in (("frame_nominal", nominal3), ("frame_measured", measured3)):
        checks.compare("three-point frame", three_point_frame(points), part.at(name), unit="1", floor=1e-15)
    for name, nominal, actual in (("error_3point", targets, measured), ("datum_point_errors", nominal3, measured3)):
        errors = three_point_errors(nominal3, measured3, nominal, actual)
        checks.compare("errors, three-point frame", errors, part.at(name), unit="mm", floor=2e-13, rounding=sides)
    best = best_fit_errors(targets, measured)
    checks.compare("errors, best fit", best, part.at("error_bestfit"), unit="mm", floor=2e-13, rounding=sides)
    _truth(part.at("T_pm_to_cmm"), checks)


def _truth(part: VectorCase, checks: Checks) -> None:
    """Check that the placement of the measured points contains a rotation; its shift depends on unknown machine errors."""
    rotation = part.array(shape=(4, 4))[:3, :3]
    for i, row in enumerate(nearest_rotation(rotation)):
        for k, value in enumerate(row):
            checks.check_form("placement is a rotation", value, part.at(i, k), floor=5e-16)
        checks.leave_out(
            "shift of the placement", part.at(i, 3), "the points contain errors of the machine, which no input separates from the shift"
        )
    checks.check_form("last row of the placement", np.array([0.0, 0.0, 0.0, 1.0]), part.at(3))


def read_rsm(case: VectorCase, checks: Checks) -> None:
    """Compare everything that the file's own inputs determine."""
    keys = case.keys()
    found = {key.split("@")[0] for key in keys if "@Z=" in key} | {key.removeprefix("table2 ") for key in keys if key.startswith("table2 ")}
    for component in sorted(found.union(COMPONENTS)):
        _planes(case, component, checks)
        _table2(case.at(f"table2 {component}"), checks)
    _ranks(case, checks)
    checks.assume("the coefficients of Table 1 have four digits, which makes it possible to recover them from their values on two planes")
    for key, part in case.at("F_crit").items():
        df_reg, df_res, alpha = _three_numbers(key, part)
        checks.compare("critical F", critical_f(int(df_reg), int(df_res), alpha), part, unit="1", floor=1e-14)
    _anova(case.at("anova_vector"), checks)


def _three_numbers(key: str, part: VectorCase) -> tuple[float, float, float]:
    """Return both degrees of freedom and the level from a key such as ``F(9,71,.01)``."""
    match = re.fullmatch(r"F\((\d+),(\d+),(0?\.\d+)\)", key)
    if match is None:
        raise FileFormatError(f"{part.label}: expected a key such as F(9,71,.01)", LAYOUT)
    return float(match[1]), float(match[2]), float(match[3])


def _planes(case: VectorCase, component: str, checks: Checks) -> None:
    """Compare coefficients and sums of one component on the implied and on the printed plane."""
    implied, printed = (_find(case, component, word) for word in ("implied", "printed"))
    z_implied = case.number("implied_plane_Z")
    z_printed = float(printed.path[-1].split("Z=")[1].split()[0])  # type: ignore[union-attr]
    planes = ((implied, z_implied), (printed, z_printed))
    first, second = (np.array([part.number("coef", in_plane_label(t)) for t in IN_PLANE]) for part, _ in planes)
    beta = coefficients_from_planes(first, z_implied, second, z_printed, DIGITS)
    for part, z in planes:
        for term, value in zip(IN_PLANE, in_plane_coefficients(beta, z), strict=True):
            checks.compare("Table 1 on a plane", value, part.at("coef", in_plane_label(term)), unit="1", floor=1e-16)
        _sums(part, checks)
    for up, low in LADDER:
        if low:  # beta_0 is below the rounding of float64
            checks.compare(
                "quotients of Table 1, mm", beta[up] / beta[low], case.at("implied_plane_Z"), unit="1", floor=0.1, rounding=PRINT
            )


def _find(case: VectorCase, component: str, word: str) -> VectorCase:
    for key, part in case.items():
        if key.startswith(f"{component}@Z=") and word in key:
            return part
    raise FileFormatError(f"{case.label}: {component} has no {word} plane", LAYOUT)


def _sums(part: VectorCase, checks: Checks) -> None:
    sums = grid_sums(np.array([part.number("coef", in_plane_label(t)) for t in IN_PLANE]))
    checks.compare("largest on the grid, um", sums.largest * UM, part.at("max_um"), unit="1", floor=1e-13)
    checks.compare("sum of squares about the mean", sums.ss_mean, part.at("ss_mean"), unit="1", floor=1e-16)
    checks.compare("sum of squares about zero", sums.ss_zero, part.at("ss_zero"), unit="1", floor=1e-16)


def _ranks(case: VectorCase, checks: Checks) -> None:
    for key in PLANES:
        case.at(key)
    for key, part in case.items():
        if key.startswith("rank "):
            count = re.search(r"(\d+) planes", key)
            heights = np.arange(int(count.group(1)) if count else 1)
            points = np.concatenate([square_grid(z_mm=float(z)) for z in heights])
            checks.compare("rank of 20 monomials", layout(points).rank, part, unit="1")


def _table2(part: VectorCase, checks: Checks) -> None:
    ss_reg, ss_res = REGRESSION_DOF * part.number("SSR/20"), RESIDUAL_DOF * part.number("SSE/60")
    for key, factor in (("SSR/20", REGRESSION_DOF), ("SSE/60", RESIDUAL_DOF)):
        checks.check_form("sums as printed", _printed(factor * part.number(key)) / factor, part.at(key))
    for key in ("MSR_printed", "MSE_printed", "SST_printed", "F_printed"):
        checks.check_form("digits as printed", _printed(part.number(key)), part.at(key))
    total = part.number("SST_printed")
    rounding = f"SSR and SST hold to {SUM_DIGITS} printed digits"
    half = _half_unit(ss_reg) + _half_unit(total)
    checks.compare("Table 2, SST_printed", ss_reg + ss_res, part.at("SST_printed"), unit="1", floor=half, relative=0.0, rounding=rounding)
    computed = {
        "SSE/61": ss_res / 61,
        "MSR/MSE_printed": part.number("MSR_printed") / part.number("MSE_printed"),
        "F(20,60)": anova_from_sums(ss_reg, ss_res, 20, 60).f,
        "F(20,61 for MSE)": anova_from_sums(ss_reg, ss_res, 20, 61).f,
        "F(9,71)": anova_from_sums(ss_reg, ss_res, RANK - 1, POINTS - RANK).f,
        "F(9,72) N=82": anova_from_sums(ss_reg, ss_res, RANK - 1, POINTS + 1 - RANK).f,
        "SSR+SSE": ss_reg + ss_res,
        "R2": anova_from_sums(ss_reg, ss_res, RANK - 1, POINTS - RANK).r2,
        "rms_res_um(71)": anova_from_sums(ss_reg, ss_res, RANK - 1, POINTS - RANK).residual_sd * UM,
    }
    for key, value in computed.items():
        checks.compare(f"Table 2, {key}", value, part.at(key), unit="1", floor=1e-19)
    quotients = [computed[key] for key in ("MSR/MSE_printed", "F(20,60)", "F(20,61 for MSE)")]
    nearest = min(quotients, key=lambda f: abs(f - part.number("F_printed")))
    rounding = "compared with the nearest quotient of the printed numbers, as no single rule gives all three F"
    checks.compare("Table 2, F_printed", nearest, part.at("F_printed"), unit="1", floor=0.0, relative=NEAR_F, rounding=rounding)


def _anova(part: VectorCase, checks: Checks) -> None:
    xy, y = part.array("xy", shape=(None, 2)), part.array("y", shape=(None,))
    surface = fit_surface(np.column_stack([xy, np.zeros(xy.shape[0])]), y)
    grid = square_grid()[:, :2]
    if xy.shape == grid.shape and np.abs(xy - grid).max() < NEAR_MM:
        checks.check_form("points of the paper's grid", grid, part.at("xy"), unit="mm", floor=1e-15)
    checks.compare("terms", np.array(surface.terms), part.at("terms"), unit="1")
    checks.compare("coefficients of the surface", surface.coefficients, part.at("coef"), unit="1", floor=1e-16)
    table = surface.anova
    for key, value in (("ss_reg", table.ss_reg), ("ss_res", table.ss_res), ("ss_tot", table.ss_tot)):
        checks.compare("sums of squares", value, part.at(key), unit="1", floor=1e-17)
    for key, count in (("df_reg", table.df_reg), ("df_res", table.df_res), ("rank", table.df_reg + 1)):
        checks.compare("degrees of freedom", count, part.at(key), unit="1")
    checks.compare("F", table.f, part.at("F"), unit="1", floor=1e-10, rounding="sums of 81 squares")
    checks.compare("p", table.p, part.at("p_value"), unit="1", floor=0.0)
    checks.compare("R2", table.r2, part.at("R2"), unit="1")


def _printed(value: float) -> float:
    return float(f"{value:.{PRINTED_DIGITS - 1}e}")


def _half_unit(value: float) -> float:
    """Return half a unit of the last valid digit of a sum of squares."""
    return float(0.5 * 10.0 ** (np.floor(np.log10(max(abs(value), 1e-300))) + 1 - SUM_DIGITS))
