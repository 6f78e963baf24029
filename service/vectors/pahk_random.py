"""`pahk_random.json`: random errors of the ten types by quadrature, and P (5) as printed (math.md 2.2)."""

from __future__ import annotations

from abbe.models.notation.pahk import pahk_type
from abbe.models.papers.pahk.random_errors import RandomErrors, parameter_jacobian, printed_eq5_mm, quadrature_mm
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks
from abbe.service.vectors.pahk_parameters import pair, squareness

FLOAT64 = 4e-15
"""Tolerance of a root of a sum of 21 squares: nothing cancels, so it is a few units in the last place."""

PRINTED_TYPE = "MB1"
"""Machine with a printed P (5), which its cases must hold."""


def read(case: VectorCase, checks: Checks) -> None:
    """Compare RX, RY, RZ of every case, with the coverage factor of the inputs."""
    for name, part in case.at("types").items():
        for point in part.parts():
            axes, probe, given = point.array("X", shape=(3,))[None], point.array("probe", shape=(3,)), point.at("R")
            random = RandomErrors(pair(given, "d"), pair(given, "E"), squareness(given), coverage=1.0)
            found = quadrature_mm(parameter_jacobian(pahk_type(name), axes, probe), random)[0]
            checks.compare("RX, RY, RZ", found, point.at("RX_RY_RZ"), unit="mm", floor=2e-17, relative=1e-14)
            if name == PRINTED_TYPE or point.has("printed_eq5"):
                printed = printed_eq5_mm(axes, probe, random)[0]
                checks.compare("eq (5) as printed", printed, point.at("printed_eq5"), unit="mm", floor=2e-17, relative=1e-14)
