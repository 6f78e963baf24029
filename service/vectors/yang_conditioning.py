"""yang_conditioning.json: conditioning of the six, nine and ten parameters of one helix, and of two bars about one origin."""

from __future__ import annotations

import re

import numpy as np

from abbe.models.arrays import F2
from abbe.models.papers.yang.conditioning import common_scale_trace_mm, conditioning, design_eq9, spread, two_radii_design
from abbe.models.paths.helix import Law, helix_points
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import LAYOUT, VectorCase
from abbe.service.vectors.checks import Checks

RADII_MM = (175.0, 100.0)
POINTS = 63
TURNS = 5
"""Layout of the file: 63 points, 175 mm, with two bars also 100 mm; 5 turns unless its key differs."""
KINDS = ("six_angle_", "six_area_", "ten_", "corr9_", "two_radii")
TWO_BARS = tuple(f"centre_{c}_radius_{r}" for c in ("common", "separate") for r in ("common", "separate"))
ORIGIN = np.zeros(3)
PER_UM = 1e-3
"""mm of reading noise in one µm."""
INVERTED = "the vector inverted normal equations of condition up to 1900 squared"
DETERMINED = "last digits of a least-squares solution"


def read(case: VectorCase, checks: Checks) -> None:
    """Every key, at least one of each kind: ``six_<law>_<turns>``, ``ten_<turns>``, ``corr9_<turns>turns`` and ``two_radii``."""
    for kind in KINDS:
        if not any(key.startswith(kind) for key, _ in case.items()):
            raise FileFormatError(f"{case.label}: there is no key {kind}...", LAYOUT)
    checks.assume(f"bars of {RADII_MM[0]:g} and (two bars) {RADII_MM[1]:g} mm, {TURNS} turns with two bars")
    for key, part in case.items():
        if six := re.fullmatch(r"six_(angle|area)_(\d+)", key):
            _six(part, checks, _points("angle" if six[1] == "angle" else "area", int(six[2])))
        elif ten := re.fullmatch(r"ten_(\d+)", key):
            _ten(part, checks, design_eq9(_points("angle", int(ten[1])), ORIGIN))
        elif corr := re.fullmatch(r"corr9_(\d+)turns", key):
            found = spread(design_eq9(_points("angle", int(corr[1])), ORIGIN)[:, :9]).correlation
            checks.compare("correlation, nine", found, part, unit="1", floor=1e-14, rounding=DETERMINED)
        elif key == "two_radii":
            _two(part, checks)
        elif key != "assumptions":
            raise FileFormatError(f"{part.label}: unknown key", f"known: {', '.join(KINDS)}")


def _points(law: Law, turns: int, radius_mm: float = RADII_MM[0]) -> F2:
    return helix_points(ORIGIN, radius_mm, turns=turns, n=POINTS, law=law)


def _six(part: VectorCase, checks: Checks, points: F2) -> None:
    a = design_eq9(points, ORIGIN, setup=False)
    found, sigma = conditioning(a), spread(a)
    checks.compare("rank, six", found.rank, part.at("rank"), unit="1")
    checks.compare("condition, six", found.condition, part.at("cond"), unit="1")
    checks.compare("singular values, six", found.singular_values, part.at("sv"), unit="1")
    checks.compare("largest correlation, six", sigma.largest_correlation, part.at("max_corr"), unit="1")
    checks.compare("sigma per µm, six", sigma.sigma_per_mm * PER_UM, part.at("sigma_factor_per_um"), unit="1", floor=1e-20)


def _ten(part: VectorCase, checks: Checks, a: F2) -> None:
    nine = conditioning(a[:, :9])
    checks.compare("rank, ten", conditioning(a).rank, part.at("rank10"), unit="1")
    checks.compare("rank, nine", nine.rank, part.at("rank9"), unit="1")
    checks.compare("condition, nine", nine.condition, part.at("cond9"), unit="1")
    sigma = spread(a[:, :9]).sigma_per_mm * PER_UM
    checks.compare("sigma per µm, nine", sigma, part.at("sigma9_per_um"), unit="1", floor=1e-20, relative=1e-9, rounding=INVERTED)
    trace = common_scale_trace_mm(a, RADII_MM[0])
    checks.compare(
        "trace of the common scale", trace, part.at("null_residual"), unit="mm", floor=3e-13, rounding="0 but for rounding at 175 mm"
    )


def _two(case: VectorCase, checks: Checks) -> None:
    points = tuple(_points("angle", TURNS, r) for r in RADII_MM)
    for key, part in case.named(*TWO_BARS):
        _, centre, _, radius = key.split("_")
        a = two_radii_design(points, ORIGIN, centre_separate=centre == "separate", radius_separate=radius == "separate")
        found = conditioning(a)
        checks.compare("unknowns, two bars", a.shape[1], part.at("unknowns"), unit="1")
        checks.compare("rank, two bars", found.rank, part.at("rank"), unit="1")
        checks.compare("condition, two bars", found.condition, part.at("cond"), unit="1")
