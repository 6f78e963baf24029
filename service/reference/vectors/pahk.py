"""`pahk_*.json`: ten machines measured on offset lines, deviation in the volume, random errors, space diagonals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.polynomial import straight_line
from abbe.models.notation.pahk import PahkType, motions_from_pahk, pahk_machine, pahk_type
from abbe.models.papers.pahk.diagonals import space_diagonals
from abbe.models.papers.pahk.offset import OffsetSetup, as_measured, refer_to_origin
from abbe.models.papers.pahk.random_errors import RandomErrors, parameter_jacobian, printed_eq5_mm, quadrature_mm
from abbe.models.papers.pahk.volume_map import Form, ParameterTables, Triple, chain_deviation_mm
from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import LAYOUT, VectorCase

AXES = "XYZ"
SUBTRACTED = "coordinates of up to 900 mm were subtracted"
LINE = "a fitted line was subtracted from the values"
LAST = "last digit of a cubic polynomial"
FLOORS = {"positioning": (1.2e-13, SUBTRACTED, LAST), "straightness": (1e-16, LINE, LINE)}
"""Rounding of the stored measured values, mm, its reason, and the reason for the rounding of the stored true values."""
FLOOR_RAD = 2e-19
FORMS: dict[str, tuple[Form, float, str]] = {
    "delta_first_order": ("first", 1e-13, SUBTRACTED),
    "delta_exact_rot": ("zyx", 3e-13, SUBTRACTED),
    "delta_paper_matrix": ("small", 3e-13, SUBTRACTED),
}
"""By key of the file: form of the kinematics, rounding of the stored number, mm, and its reason."""
PRINTED_TYPE = "MB1"
"""Machine for which P (5) is printed; its cases must contain these numbers."""
LENGTHS = "two lengths of 1142 mm were subtracted"


def pair(part: VectorCase, key: str) -> F2:
    """Return nine numbers of ``d`` or ``E`` as an array, shape (3 axes, 3 directions)."""
    return np.array([[part.number(key, direction + axis) for direction in AXES] for axis in AXES])


def squareness(part: VectorCase) -> F1:
    """Return alpha, beta1, beta2, shape (3,)."""
    return np.array([part.number(name) for name in ("alpha", "beta1", "beta2")])


def read_abbe(case: VectorCase, checks: Checks) -> None:
    """Compute "measured" from "true" values of the file, and "true" from "measured" ones, and compare them."""
    length = case.array("L", shape=(3,))
    for name, part in case.at("types").items():
        count = len(part.at("true_translational", "XX").parts())
        if count < 2:
            raise FileFormatError(f"{part.label}/true_translational/XX: expected at least two positions, got {count}", LAYOUT)
        grid = length[:, None] * np.arange(count) / (count - 1)
        _offset_machine(name, part, length, grid, checks)


def _offset_machine(name: str, part: VectorCase, length: F1, grid: F2, checks: Checks) -> None:
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
    """Return c1, c2, c3 of the three directions of an axis, shape (3 directions, 3)."""
    return np.stack([part.array("coef", key, direction + AXES[axis], shape=(3,)) for direction in AXES])


def _cubic(u: F1, coefficients: F2) -> F2:
    """Return c1 u + c2 u^2 + c3 u^3, shape (n, 3 directions)."""
    powers: F2 = np.stack([u, u * u, u * u * u], axis=1)
    return np.asarray(powers @ coefficients.T)


def _translations(x: F1, length: float, coefficients: F2, axis: int) -> F2:
    """Return positioning unchanged and straightness without its least-squares line with intercept, as the file's text states."""
    d = _cubic(x / length, coefficients)
    for i in set(range(3)) - {axis}:
        slope, start = straight_line(x, d[:, i])
        d[:, i] -= start + slope * x
    return d


def _tables(part: VectorCase) -> Triple:
    return _three(lambda j: np.stack([part.array(direction + AXES[j], shape=(None,)) for direction in AXES], axis=1))


def read_volumetric(case: VectorCase, checks: Checks) -> None:
    """Compare every deviation of every type with the computed one."""
    for name, part in case.at("types").items():
        kind = pahk_type(name)
        ours, theirs = kind.chain.replace("-", "").removeprefix("w").removesuffix("t").replace("b", "F"), part.text("chain")
        if ours != theirs:
            raise FileFormatError(f"{part.label}/chain: the chain of {name} is {ours}, but the file says {theirs}", "correct the file")
        checks.compare("sign of alpha", kind.alpha_sign, part.at("alpha_sign"), unit="1")
        for point in part.at("cases").parts():
            _point(kind, point, checks)


def _point(kind: PahkType, point: VectorCase, checks: Checks) -> None:
    axes = point.array("X", shape=(3,))[None]
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3), point.array("probe", shape=(3,)))
    motions = motions_from_pahk(kind, axes, pair(point, "d")[None], pair(point, "E")[None], squareness(point))
    for key, (form, floor, why) in FORMS.items():
        checks.compare(
            key, chain_deviation_mm(machine, axes, motions, form)[0], point.at(key), unit="mm", floor=floor, rounding=why, relative=0.0
        )


def read_random(case: VectorCase, checks: Checks) -> None:
    """Compare RX, RY, RZ of every case with the computed ones, at the coverage factor of the inputs."""
    for name, part in case.at("types").items():
        for point in part.parts():
            axes, probe, given = point.array("X", shape=(3,))[None], point.array("probe", shape=(3,)), point.at("R")
            random = RandomErrors(pair(given, "d"), pair(given, "E"), squareness(given), coverage=1.0)
            found = quadrature_mm(parameter_jacobian(pahk_type(name), axes, probe), random)[0]
            checks.compare("RX, RY, RZ", found, point.at("RX_RY_RZ"), unit="mm", floor=2e-17, relative=1e-14)
            if name == PRINTED_TYPE or point.has("printed_eq5"):
                printed = printed_eq5_mm(axes, probe, random)[0]
                checks.compare("eq (5) as printed", printed, point.at("printed_eq5"), unit="mm", floor=2e-17, relative=1e-14)


def read_diagonals(case: VectorCase, checks: Checks) -> None:
    """Compare both forms of every diagonal with the computed ones.

    Each function is zero at the start of its axis and has the given value at full travel.
    """
    volume = case.array("volume", shape=(3,))
    for name, part in case.at("types").items():
        given = part.at("value_at_full_travel")
        lines = [np.array([0.0, v]) for v in volume]
        tables = ParameterTables((lines[0], lines[1], lines[2]), _ramps(pair(given, "d")), _ramps(pair(given, "E")), squareness(given))
        found = space_diagonals(pahk_type(name), tables)
        exact = space_diagonals(pahk_type(name), tables, form="zyx")
        for key, stored in part.at("diagonals").named(*found):
            first, full = found[key].first_order_mm, exact[key].full_mm
            checks.compare("first order", first, stored.at("first_order"), unit="mm", floor=1e-13, rounding=LENGTHS, relative=0.0)
            checks.compare("full", full, stored.at("full"), unit="mm", floor=5e-13, rounding=LENGTHS, relative=0.0)


def _ramps(ends: F2) -> Triple:
    """Return tables of two rows for each axis: zeros, and the given values."""
    return np.stack([0.0 * ends[0], ends[0]]), np.stack([0.0 * ends[1], ends[1]]), np.stack([0.0 * ends[2], ends[2]])
