"""`paper_tables.json`: tables of the papers, and results derived from them.

Lengths that the file gives in um stay in um, with floors in um and the unit "1".
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1
from abbe.models.functions.polynomial import slope_through_origin, straight_line
from abbe.models.papers.pahk.diagonals import squareness_diagonals_mm
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import VectorCase

DECIMALS_UM = 1
"""Yang's Table 3 is printed to 0.1 um."""

DIGITS = 5
"""Significant digits of Yang's Table 2."""

REVERSED = ("Syz",)
"""Rows of Table 2 whose difference is printed with the sign reversed."""

ROWS = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")
"""Rows of Table 2; its columns are laser, bar, difference."""

TYPES = {"pahk_A": "MB1", "pahk_B": "MH2"}
"""Types of Pahk's machines (section 4). For squareness alone, all types with X on the tool side have the same diagonals."""


def read(case: VectorCase, checks: Checks) -> None:
    """Compare everything that the file's own inputs determine."""
    _table3(case, checks)
    _table2(case.at("table2"), checks)
    others = [name for name, _ in case.items() if name.startswith("pahk_") and name not in TYPES]
    for name in (*TYPES, *others):
        _pahk(case.at(name), TYPES.get(name, "MB1"), checks)


def _table3(case: VectorCase, checks: Checks) -> None:
    x, laser, bar = (case.array(key, shape=(None,)) for key in ("x", "laser_um", "ballbar_um"))
    slope_bar = case.number("table2", "dxx", 1)
    column = np.round(slope_bar * x * 1e3, DECIMALS_UM)
    why = "decimal um as float64"
    checks.compare("bar column, um", column, case.at("ballbar_um"), unit="1", floor=2e-14, rounding=why)
    checks.compare("laser - bar, um", laser - bar, case.at("diff_um"), unit="1", floor=2e-14, rounding=why)
    slope, intercept = straight_line(x, laser)
    checks.compare("slope through the origin", slope_through_origin(x, laser * 1e-3), case.at("slope_origin"), unit="1", floor=2e-19)
    checks.compare("slope of the ordinary line", slope * 1e-3, case.at("slope_ols"), unit="1", floor=2e-19)
    sums = "sums of 23 products"
    checks.compare("intercept of the ordinary line, um", intercept, case.at("intercept_um"), unit="1", floor=5e-14, rounding=sums)


def _table2(table: VectorCase, checks: Checks) -> None:
    for name, row in table.named(*ROWS):
        laser, bar, difference = row.array(shape=(3,))
        sign = -1.0 if name in REVERSED else 1.0
        # Each printed number is rounded to half a unit of its fifth digit, which limits a difference of two.
        floor = max(_unit(np.array([laser, bar, difference])).sum() / 2, 1e-12)
        checks.compare(f"difference {name}", sign * (laser - bar), row.at(2), unit="1", floor=floor, rounding="5 digits are printed")
        checks.check_form("five digits as printed", _as_printed(row.array()), row, floor=1e-20, rounding="decimal as float64")


def _pahk(part: VectorCase, type_name: str, checks: Checks) -> None:
    volume, squareness = part.array("volume", shape=(3,)), part.array("squareness_xy_xz_yz", shape=(3,))
    diagonals = squareness_diagonals_mm(type_name, volume, squareness)
    for name, stored in part.at("squareness_only_um").named(*diagonals):
        why = "coordinates of 1000 mm times angles, in um"
        checks.compare("diagonals of squareness alone, um", diagonals[name] * 1e3, stored, unit="1", floor=3e-13, rounding=why)
    mean = part.array("printed_diag_um", shape=(4,)).mean()
    checks.compare("mean of the printed diagonals, um", mean, part.at("mean_um"), unit="1", floor=2e-14, rounding="decimal um as float64")


def _unit(values: F1) -> F1:
    """Return one unit of the fifth significant digit."""
    size: F1 = 10.0 ** (np.floor(np.log10(np.maximum(np.abs(values), 1e-300))) - DIGITS + 1)
    return size


def _as_printed(values: F1) -> F1:
    """Round numbers to the digits of Table 2."""
    return np.array([float(f"{v:.{DIGITS - 1}e}") for v in values])
