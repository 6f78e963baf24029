"""Pahk: the numbers of sections 3.2 and 4 as printed (the figures with the curves and maps are not in the text)."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.service.papers.printed import Printed, printed


@dataclass(frozen=True, slots=True)
class Cmm:
    """Printed numbers of one machine.

    Attributes
    ----------
    name, type_name : str
        The paper's name, and its type among the ten.
    volume_mm : three numbers
    squareness_urad : mapping
        XY, XZ, YZ.
    diagonals_um : four numbers
        Deviations of the diagonal lengths, in printed order; the paper does not name the diagonals.
    random_um : up to four numbers
        Random errors of the diagonals.
    bands : mapping
        Width of the band and repeatability of single errors, with their unit.
    """

    name: str
    type_name: str
    volume_mm: tuple[Printed, ...]
    squareness_urad: dict[str, Printed]
    diagonals_um: tuple[Printed, ...]
    random_um: tuple[Printed, ...]
    bands: dict[str, tuple[str, Printed, Printed]]


CMM_A = Cmm(
    "CMM A",
    "MB1",
    printed("900", "575", "400"),
    dict(zip(("XY", "XZ", "YZ"), printed("14.1", "56.4", "-32"), strict=True)),
    printed("-24.0", "21.3", "25.9", "-35.9"),
    (),
    {
        "EXX, Fig. 4(a)": ("µm", Printed("6.15"), Printed("10.75")),
        "EYY, Fig. 4(b)": ("µm", Printed("23.0"), Printed("21.0")),
        "pitch along X, Fig. 4(c)": ("µrad", Printed("11.18"), Printed("12.30")),
    },
)
CMM_B = Cmm(
    "CMM B",
    "MH2",
    printed("1100", "1100", "1100"),
    dict(zip(("XY", "YZ", "XZ"), printed("43.2", "-48.9", "108.9"), strict=True)),
    printed("-42.1", "-45.1", "-83.3", "102.7"),
    printed("3.5", "4.5", "5.7", "3.6"),
    {
        "EXX, Fig. 6(a)": ("µm", Printed("71.0"), Printed("3.1")),
        "EZZ, Fig. 6(b)": ("µm", Printed("14.5"), Printed("1.9")),
        "pitch along Y, Fig. 6(c)": ("µrad", Printed("39.0"), Printed("4.3")),
    },
)
CMMS = (CMM_A, CMM_B)

SPHERE_MM, BALL_MM, EFFECTIVE_MM = printed("25.006", "1", "0.997")
"""3.2: radius of the master sphere, nominal and effective radius of the probe's ball."""

PROBE_LARGEST, PROBE_SMALLEST, PROBE_RMS = printed("6.6", "-9.0", "4.0")
"""3.2: probe error, printed as mm; only um makes sense."""

PATTERN_STEP_DEG, PATTERN_POINTS, PATTERN_CIRCLES, PATTERN_ON_CIRCLES = printed("18", "101", "5", "100")

# Numbers of math.md 8 about the two machines, with all its digits.
MATH_DIAGONAL_MM: dict[str, Printed] = {"CMM A": Printed("1140.449"), "CMM B": Printed("1905.256")}
MATH_MEAN_UM: dict[str, Printed] = {"CMM A": Printed("-3.2"), "CMM B": Printed("-16.95")}
MATH_ALONE_UM: dict[str, tuple[Printed, ...]] = {
    "CMM A": printed("-17.8", "30.7", "-17.9", "5.0"),
    "CMM B": printed("-65.5", "127.7", "-72.8", "10.7"),
}
"""Diagonals ppp, npp, pnp, ppn of squareness alone."""

MATH_MISFIT_URAD: dict[str, Printed] = {"CMM A": Printed("32"), "CMM B": Printed("42")}
"""Smallest misfit of any order of the printed diagonals to the printed squareness."""
