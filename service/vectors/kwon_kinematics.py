"""`kwon_kinematics.json`: kinematics, Jacobians, parameter sensitivities and frames of the 3-PUU machine (math.md 6)."""

from __future__ import annotations

import numpy as np

from abbe.models.papers.kwon.frames import best_fit_errors, nearest_rotation, three_point_errors, three_point_frame
from abbe.models.papers.kwon.geometry import PER_LEG, Geometry
from abbe.models.papers.kwon.kinematics import forward, forward_as_printed, inverse, jacobian, square_commands
from abbe.models.papers.kwon.sensitivity import parameter_jacobian
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks

HALF_MM = 1.0
MIDDLE_MM = 1.0
"""The workspace is the square of +-1 mm at the height that all three drives at 1 mm give (math.md 6, "Stroke")."""

ROOTS = "roots of 1e4 mm2"


def read(case: VectorCase, checks: Checks) -> None:
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
    """Check that the placement of the measured points is a rotation; its position depends on unknown machine errors."""
    rotation = part.array(shape=(4, 4))[:3, :3]
    for i, row in enumerate(nearest_rotation(rotation)):
        for k, value in enumerate(row):
            checks.check_form("placement is a rotation", value, part.at(i, k), floor=5e-16)
        checks.leave_out(
            "shift of the placement", part.at(i, 3), "the points carry the machine's own errors, which no input separates from it"
        )
    checks.check_form("last row of the placement", np.array([0.0, 0.0, 0.0, 1.0]), part.at(3))
