"""yang_helix.json: helix points, ball-bar readings of a six-parameter machine, and its fits by eq (9)."""

from __future__ import annotations

from abbe.models.arrays import F1, F2
from abbe.models.notation.yang import workpiece_mm
from abbe.models.papers.yang.ballbar import reading_eq6, reading_eq8
from abbe.models.papers.yang.simplified import SixParameters, ZConvention, delta_eq2, fit_eq9
from abbe.models.paths.helix import Law, helix_points
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks

NAMES = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")
READINGS: dict[str, ZConvention] = {"paper": "workpiece", "workpiece": "workpiece", "physical": "slide", "slide": "slide"}
COORDINATES = "the parameter of 5 turns and coordinates of 600 mm, six units in the last place"
LAWS: dict[str, Law] = {"angle": "angle", "area": "area"}


def read(case: VectorCase, checks: Checks) -> None:
    """Every set: points, exact and linear reading, both fits."""
    truth = SixParameters(*(case.number("truth", k) for k in NAMES))
    origin, turns = case.array("origin", shape=(3,)), case.number("turns")
    spacing = case.text("spacing")
    if spacing not in LAWS:
        raise FileFormatError(f"{case.label}: spacing {spacing!r} is unknown", "use angle or area")
    for part in case.at("sets").parts():
        name = part.text("z_reading")
        if name not in READINGS:
            raise FileFormatError(f"{part.label}: z_reading {name!r} is unknown", f"use one of {', '.join(READINGS)}")
        radius, n = part.number("R"), len(part.at("points").parts())
        points = helix_points(origin, radius, turns=turns, n=n, law=LAWS[spacing])
        checks.compare("points", points, part.at("points"), unit="mm", floor=7e-13, relative=0.0, rounding=COORDINATES)
        _readings(part, checks, truth, points, origin)


def _readings(part: VectorCase, checks: Checks, truth: SixParameters, points: F2, origin: F1) -> None:
    """Both readings of one set and what eq (9) makes of the exact one."""
    reading, radius = READINGS[part.text("z_reading")], part.number("R")
    d = points - origin
    nominal = d if reading == "workpiece" else workpiece_mm(d)
    error = delta_eq2(truth, points) - delta_eq2(truth, origin[None])
    exact, rounding = reading_eq6(nominal, error), "difference of two lengths of up to 175 mm"
    checks.compare("dR, eq (6)", exact, part.at("dR_nonlinear"), unit="mm", floor=1.2e-13, rounding=rounding)
    checks.compare("dR, eq (8)", reading_eq8(nominal, error), part.at("dR_linear"), unit="mm")
    fits: tuple[tuple[str, ZConvention], ...] = (("lsq_own_reading", reading), ("lsq_printed_eq9", "workpiece"))
    for key, convention in fits:
        fit = fit_eq9(points, origin, exact, radius, z_convention=convention).parameters.array()
        for k, name in enumerate(NAMES):
            checks.compare(key, fit[k], part.at(key, name), unit="rad", floor=1e-15, rounding="rounding of dR over the radius")
