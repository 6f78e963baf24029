"""`pahk_abbe.json`: errors of ten machines as measured on offset lines, and their reduction to the origin (math.md 2.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.line_fit import straight_line
from abbe.models.notation.pahk import pahk_type
from abbe.models.papers.pahk.offset import OffsetSetup, as_measured, refer_to_origin
from abbe.models.papers.pahk.tables import ParameterTables, Triple
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import LAYOUT, VectorCase
from abbe.service.vectors.checks import Checks
from abbe.service.vectors.pahk_parameters import AXES, squareness

SUBTRACTED = "coordinates of up to 900 mm were subtracted"
LINE = "a line was fitted to the values and taken off"
LAST = "last digit of a cubic polynomial"
FLOORS = {"positioning": (1.2e-13, SUBTRACTED, LAST), "straightness": (1e-16, LINE, LINE)}
"""Rounding of the stored number in mm, its reason, and the reason of the rounding of the parameters."""
FLOOR_RAD = 2e-19


def read(case: VectorCase, checks: Checks) -> None:
    """Compare the file's "measured" and "true" values in both directions."""
    length = case.array("L", shape=(3,))
    for name, part in case.at("types").items():
        count = len(part.at("true_translational", "XX").parts())
        if count < 2:
            raise FileFormatError(f"{part.label}/true_translational/XX: expected at least two positions, got {count}", LAYOUT)
        grid = length[:, None] * np.arange(count) / (count - 1)
        _machine(name, part, length, grid, checks)


def _machine(name: str, part: VectorCase, length: F1, grid: F2, checks: Checks) -> None:
    kind, offset = pahk_type(name), part.array("offset", shape=(3,))
    truth = ParameterTables(
        (grid[0], grid[1], grid[2]),
        _three(lambda j: _translations(grid[j], length[j], _coefficients(part, "d", j), j)),
        _three(lambda j: _cubic(grid[j] / length[j], _coefficients(part, "E", j))),
        squareness(part.at("squareness_true")),
    )
    setup = OffsetSetup(offset)
    still = np.stack([_cubic(offset[j : j + 1] / length[j], _coefficients(part, "E", j))[0] for j in range(3)])
    computed = as_measured(kind, truth, setup, still)
    measured = ParameterTables(truth.positions_mm, _tables(part.at("measured")), truth.e_rad, squareness(part.at("squareness_measured")))
    origin = refer_to_origin(kind, measured, setup, still)
    for j, axis in enumerate(AXES):
        for i, direction in enumerate(AXES):
            key = direction + axis
            what = "positioning" if i == j else "straightness"
            floor, why, why_true = FLOORS[what]
            stored, true = part.at("measured", key), part.at("true_translational", key)
            checks.compare(f"{what} of the parameters", truth.d_mm[j][:, i], true, unit="mm", floor=1e-16, rounding=why_true)
            checks.compare(f"{what} as measured", computed.d_mm[j][:, i], stored, unit="mm", floor=floor, rounding=why)
            checks.compare(f"{what} of the origin", origin.d_mm[j][:, i], true, unit="mm", floor=floor, rounding=why)
    for k, key in enumerate(("alpha", "beta1", "beta2")):
        stored, true = part.at("squareness_measured", key), part.at("squareness_true", key)
        checks.compare("squareness as measured", computed.squareness_rad[k], stored, unit="rad", floor=FLOOR_RAD, rounding=LINE)
        checks.compare("squareness of the origin", origin.squareness_rad[k], true, unit="rad", floor=FLOOR_RAD, rounding=LINE)


def _three(of_axis: Callable[[int], F2]) -> Triple:
    return of_axis(0), of_axis(1), of_axis(2)


def _coefficients(part: VectorCase, key: str, axis: int) -> F2:
    """c1, c2, c3 of the three directions of an axis, shape (3 directions, 3)."""
    return np.stack([part.array("coef", key, direction + AXES[axis], shape=(3,)) for direction in AXES])


def _cubic(u: F1, coefficients: F2) -> F2:
    """c1 u + c2 u^2 + c3 u^3, shape (n, 3 directions)."""
    powers: F2 = np.stack([u, u * u, u * u * u], axis=1)
    return np.asarray(powers @ coefficients.T)


def _translations(x: F1, length: float, coefficients: F2, axis: int) -> F2:
    """Positioning unchanged, straightness minus its least-squares line with intercept, as the file's text states."""
    d = _cubic(x / length, coefficients)
    for i in set(range(3)) - {axis}:
        slope, start = straight_line(x, d[:, i])
        d[:, i] -= start + slope * x
    return d


def _tables(part: VectorCase) -> Triple:
    return _three(lambda j: np.stack([part.array(direction + AXES[j], shape=(None,)) for direction in AXES], axis=1))
