"""Yang and Kim: the numbers of Tables 1 to 6 as printed, in the paper's units (um or mm; slopes without a unit)."""

from __future__ import annotations

from abbe.service.reference.printed import Printed, printed

NAMES = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")

SAMPLES = 10000
"""N of Table 1: 100 points, 100 times."""

TABLE1: dict[str, tuple[Printed, ...]] = {
    "Dx": printed("1.7", "1.8", "1.66472", "1.73528"),
    "Dy": printed("5.3", "2.5", "5.251", "5.349"),
    "Dz": printed("-5.4", "1.9", "-5.43724", "-5.36276"),
}
"""Mean, standard deviation, lower and upper end of the 95 % interval, um."""

TABLE2: dict[str, tuple[Printed, ...]] = {
    "dxx": printed("-8.5619E-05", "-8.7176E-05", "1.5571E-06"),
    "dyy": printed("-1.2229E-04", "-1.1482E-04", "-7.4623E-06"),
    "dzz": printed("-8.9221E-05", "-8.2013E-05", "-7.2078E-06"),
    "Sxy": printed("-2.6575E-05", "-1.9447E-05", "-7.1272E-06"),
    "Sxz": printed("3.8588E-05", "4.5772E-05", "-7.1843E-06"),
    "Syz": printed("-1.1094E-04", "-1.1912E-04", "-8.1715E-06"),
}
"""Parameter by laser, by ball bar, and their difference: mm/mm or rad."""

TABLE3_X = printed(
    *("0", "25.4", "63.5", "101.6", "139.7", "177.8", "215.9", "4", "292.1", "330.2", "368.3", "406.4", "444.5", "482.6", "520.7"),
    *("558.8", "596.9", "635", "673.1", "711.2", "749.3", "787.4", "812.8"),
)
"""Positions, mm; the eighth is damaged."""

_ZERO = Printed("0", last="0.1")
"""First number of the columns of Table 3, which continue in tenths."""

TABLE3_LASER = (
    _ZERO,
    *printed(
        *("-6.5", "-9.2", "-9.9", "-4.5", "-7.1", "-15.4", "-18.1", "-26.2", "-30.8", "-32.5", "-36.9", "-38.2", "-40.8", "-43.0"),
        *("-43.6", "-48.3", "-52.7", "-56.0", "-62.0", "-63.5", "-70.2", "-76.8"),
    ),
)
TABLE3_BAR = (
    _ZERO,
    *printed(
        *("-2.2", "-5.5", "-8.9", "-12.2", "-15.5", "-18.8", "-22.1", "-25.5", "-28.8", "-32.1", "-35.4", "-38.7", "-42.1", "-45.4"),
        *("-48.7", "-52.0", "-55.4", "-58.7", "-62.0", "-65.3", "-68.6", "-70.9"),
    ),
)
TABLE3_DIFFERENCE = (
    _ZERO,
    *printed(
        *("-4.3", "-3.7", "-1.0", "7.7", "8.4", "3.4", "4.0", "-0.7", "-2.0", "-0.4", "-1.5", "0.5", "1.3", "2.4"),
        *("5.1", "3.7", "2.7", "2.7", "0.0", "1.8", "-1.6", "-5.9"),
    ),
)
"""Laser, bar, and laser minus bar at `TABLE3_X`, um."""

DAMAGED = 7
"""Index of the damaged position of Table 3."""

TABLE3_MAX, TABLE3_MEAN, LINES_AT_END = printed("8.4", "2.8", "1.3")
"""Largest and mean absolute difference; difference of the two lines at the end of the travel (text of 3.3), um."""

TABLE4: dict[str, tuple[Printed, ...]] = {"dyy": printed("-5.1", "127", "2.9"), "dzz": printed("-6.4", "254", "3.3")}
"""Largest difference (um), its position (mm), mean difference (um)."""

TABLE5: dict[str, tuple[Printed, ...]] = {"Sxy": printed("-2.65746E-05", "-1.94474E-05", "495", "-0.0132", "-0.0096", "-3.6")}
TABLE6: dict[str, tuple[Printed, ...]] = {
    "Sxz": printed("3.85878E-05", "4.57721E-05", "813", "0.0314", "0.0372", "-5.8"),
    "Syz": printed("-1.1094E-04", "-1.19116E-04", "495", "-0.0549", "-0.0590", "-4.1"),
}
"""Laser and bar (rad), travel (mm), laser and bar times travel (mm), difference (um)."""

BAR_RADII = printed("175", "100")
"""Radii of the helices, mm (3.2)."""

POINTS = 63
"""Readings of a helix (3.2)."""
