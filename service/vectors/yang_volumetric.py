"""yang_volumetric.json: the complete model, eq (1), by rule G, and exactly with full rotations and with the paper's matrices."""

from __future__ import annotations

import numpy as np

from abbe.models.geometry.chain import deviation_mm
from abbe.models.notation.yang import YangErrors, iso_motions, machine, workpiece_mm
from abbe.models.papers.yang.complete import delta_eq1, delta_exact
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks

SUBTRACTED = "the vector subtracts coordinates of up to 1000 mm"


def read(case: VectorCase, checks: Checks) -> None:
    """Every case of the file through the model's three forms."""
    for part in case.at("cases").parts():
        errors = errors_of(part)
        slide, tool = part.array("xyz_slide", shape=(3,))[None], part.array("T_plus_L", shape=(3,))
        form = machine(np.array([[0.0, 1.0]] * 3), tool)
        first = part.at("delta_eq1")
        checks.compare("delta, eq (1) as printed", delta_eq1(errors, slide, tool)[0], first, unit="mm", floor=1e-16, relative=1e-14)
        checks.compare(
            "delta, rule G",
            deviation_mm(form, workpiece_mm(slide), iso_motions(errors, slide))[0],
            first,
            unit="mm",
            floor=1e-16,
            relative=1e-14,
        )
        exact = delta_exact(errors, slide, tool)[0]
        checks.compare("delta, full rotations", exact, part.at("delta_exact_rot"), unit="mm", floor=3e-13, rounding=SUBTRACTED)
        matrix = delta_exact(errors, slide, tool, small_angles=True)[0]
        checks.compare("delta, paper's matrices", matrix, part.at("delta_paper_matrix"), unit="mm", floor=3e-13, rounding=SUBTRACTED)


def errors_of(part: VectorCase) -> YangErrors:
    """The 21 errors of one case: d["xy"] = delta_xy, e["zx"] = eps_zx, Sxy, Sxz, Syz."""
    d = np.array([[[part.number("d", i + j) for j in "xyz"] for i in "xyz"]])
    e = np.array([[[part.number("e", i + j) for j in "xyz"] for i in "xyz"]])
    return YangErrors(d, e, part.number("Sxy"), part.number("Sxz"), part.number("Syz"))
