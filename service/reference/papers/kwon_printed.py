"""Kwon: the numbers of section 4 and of Tables 1 and 2 as printed; lengths in mm in the tables, in um in the text."""

from __future__ import annotations

from abbe.service.reference.printed import Printed, printed

COMPONENTS = ("e_x", "e_y", "e_z")

TABLE1: dict[str, tuple[Printed, ...]] = {
    "e_x": printed(
        *("3.186e-14", "1.859e-10", "-3.486e-10", "3.110e-12", "-1.795e-7", "1.815e-8", "-3.403e-8", "-3.032e-6", "-5.865e-7", "3.036e-10"),
        *("-1.752e-3", "-8.525e-3", "-2.959e-4", "8.890e-4", "1.772e-6", "-5.725e-5", "-3.321e-6", "9.494e-5", "1.314e-2", "2.964e-8"),
    ),
    "e_y": printed(
        *("1.328e-14", "-2.837e-10", "2.018e-10", "1.297e-12", "7.304e-8", "-2.769e-8", "1.970e-8", "2.818e-7", "1.411e-6", "1.266e-10"),
        *("7.130e-6", "-2.385e-5", "2.751e-5", "1.274e-3", "-2.703e-6", "1.377e-4", "1.923e-6", "-1.094e-2", "-3.426e-2", "1.236e-8"),
    ),
    "e_z": printed(
        *(
            "3.995e-14",
            "-1.506e-10",
            "-1.182e-10",
            "3.899e-12",
            "-3.820e-7",
            "-1.470e-8",
            "-1.154e-8",
            "2.417e-6",
            "-4.796e-7",
            "3.806e-10",
        ),
        *("-3.728e-5", "-1.315e-2", "2.359e-4", "4.163e-3", "-1.435e-6", "-4.682e-5", "-1.127e-6", "2.064e-3", "2.120e-2", "3.715e-8"),
    ),
}
"""beta_0 .. beta_19 as printed; beta_10 of e_x has the wrong power of ten."""

DAMAGED = ("e_x", 10)
RESTORED = Printed("-1.752e-5")
"""beta_10 of e_x with the exponent that follows from the quotients of Table 1."""

PADDED = "the last 0 is padding: all six sums of regression and total in Table 2 end in 0, so they may have three digits only"


def _padded(text: str) -> Printed:
    return Printed(text, digits=3, padding=PADDED)


TABLE2_SUMS: dict[str, tuple[Printed, ...]] = {
    "e_x": (_padded("4.240e-2"), Printed("1.317e-4"), _padded("4.250e-2")),
    "e_y": (_padded("4.520e-2"), Printed("3.155e-4"), _padded("4.550e-2")),
    "e_z": (_padded("1.230e-2"), Printed("1.020e-4"), _padded("1.240e-2")),
}
"""Sums of squares: regression, residual, total. Assumed: the fourth digit of regression and total is padding, which can make a row
consistent but not reproduced."""

TABLE2_MEAN_SQUARES: dict[str, tuple[Printed, ...]] = {
    "e_x": printed("2.099e-3", "2.160e-6"),
    "e_y": printed("2.301e-3", "5.258e-6"),
    "e_z": printed("6.151e-4", "1.701e-6"),
}
"""Mean squares of regression and residual."""

TABLE2_F: dict[str, Printed] = dict(zip(COMPONENTS, printed("981.08", "437.40", "361.61"), strict=True))
DOF_REGRESSION, DOF_RESIDUAL, POINTS = printed("20", "60", "82")
CRITICAL_F = Printed("2.20")
"""F(20, 60, 0.01), the value that chance exceeds in one of 100 cases."""

PLANE_Z_MM = Printed("113.61")
LARGEST_UM: dict[str, Printed] = dict(zip(COMPONENTS, printed("51.2", "63.8", "65.4"), strict=True))
STEP_MM, TURN_BEFORE_DEG, TURN_AFTER_DEG, RESIDUAL_UM = printed("0.25", "2.1", "0.06", "2.0")
REPEATABILITY_UM: dict[str, Printed] = dict(zip("xyz", printed("1.94", "2.05", "2.12"), strict=True))

# Numbers of math.md 6: in-plane form of Table 1 at the implied plane, sums on the 9 x 9 grid, an example of the kinematics.
MATH_PLANE_MM, MATH_SPREAD_MM = printed("97.616", "0.018")
MATH_IN_PLANE: dict[str, tuple[Printed, ...]] = {
    "e_x": printed(
        *(".027574", ".016887", "-.031649", "-.001710", "-.028888", "-.005589", "-.008525", ".000889", ".000095", ".013140"),
    ),
    "e_y": printed(
        *(".011498", "-.025760", ".018326", ".000696", ".002686", ".013443", "-.000024", ".001274", "-.010940", "-.034260"),
    ),
    "e_z": printed(
        *(".034560", "-.013676", "-.010740", "-.003640", ".023030", "-.004571", "-.013150", ".004163", ".002064", ".021200"),
    ),
}
"""Coefficients of 1, x, y, xy, x^2, y^2, x^2 y, x y^2, x^3, y^3, mm."""

MATH_SUMS: dict[str, Printed] = dict(zip(COMPONENTS, printed("4.2385e-2", "4.5149e-2", "1.2110e-2"), strict=True))
MATH_SUMS_PRINTED_Z: dict[str, Printed] = dict(zip(COMPONENTS, printed("7.8e-2", "6.8e-2", "1.9e-2"), strict=True))
MATH_LARGEST_UM: dict[str, Printed] = dict(zip(COMPONENTS, printed("50.1", "79.7", "74.5"), strict=True))
MATH_F: dict[str, Printed] = dict(zip(COMPONENTS, printed("2540", "1130", "951"), strict=True))
MATH_CRITICAL_F = Printed("2.668")

GEOMETRY_MM = {"R": 100.0, "r": 30.0, "l": 101.26, "l_up": 8.0, "l_dw": 8.0, "le": 20.0}
GEOMETRY_DEG = 35.0
"""Dimensions that math.md 6 assumes; the paper prints none."""

EXAMPLES: tuple[tuple[tuple[float, ...], tuple[Printed, ...]], ...] = (
    ((1.0, 1.0, 1.0), (Printed("0", last="0.00001"), Printed("0", last="0.00001"), Printed("113.61357"))),
    ((0.4, 1.1, 1.7), printed("0.665228790", "0.348486460", "113.655994154")),
)
"""Commands and ball centre, mm."""

EXAMPLE_WITHOUT_HALF = printed("1.330", "0.697", "114.090")
LINKS_WITHOUT_HALF = printed("101.26", "101.65", "101.97")
SQUARE_COMMANDS_MM = printed("-0.37", "2.37")
"""Smallest and largest command for a square of +-1 mm."""
