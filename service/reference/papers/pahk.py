"""Pahk, sections 3.2 and 4: the numbers of two machines and a probe.

Most cannot be computed, because the figures with the curves and maps are lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.pahk.diagonals import best_assignment, squareness_diagonals_mm
from abbe.models.papers.probe.calibration import ProbeCalibration, calibrate, master_sphere_pattern, without_absorbed
from abbe.models.papers.probe.model import direction
from abbe.service.reference.comparison import Comparison, Erratum, stated
from abbe.service.reference.printed import Computed, Printed, printed, values
from abbe.service.reference.text import minus


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
MATH_SINGLE_UM: dict[str, tuple[Printed, ...]] = {
    "CMM A": printed("-17.8", "30.7", "-17.9", "5.0"),
    "CMM B": printed("-65.5", "127.7", "-72.8", "10.7"),
}
"""Diagonals ppp, npp, pnp, ppn of squareness alone."""

MATH_MISFIT_URAD: dict[str, Printed] = {"CMM A": Printed("32"), "CMM B": Printed("42")}
"""Smallest misfit of any order of the printed diagonals to the printed squareness."""

URAD = 1e-6
THREE_LOBES_MM, POLE_MM = 0.005, 0.0025
EXAMPLE = "5 µm · sin²φ cos 3θ + 2.5 µm · cos 2φ, less what centre and radius of a sphere absorb"
"""Lobing of an example: the paper's map is not printed."""


def comparisons() -> list[Comparison]:
    """Return the comparisons of every number of the paper, in printed order, and of the numbers that math.md adds."""
    return [*_probe(), *[r for cmm in CMMS for r in _machine(cmm)]]


def _probe() -> list[Comparison]:
    lost = "the 101 readings and the map (Fig. 3) are not printed"
    micrometres = Erratum("printed as mm; a probe error of millimetres is impossible, µm is meant")
    out = [
        Comparison("3.2", "radius of the master sphere", "mm", SPHERE_MM, why="given: input of the calibration", given=True),
        Comparison("3.2", "effective radius of the probe's ball", "mm", EFFECTIVE_MM, why=lost),
    ]
    for name, number in (("largest", PROBE_LARGEST), ("smallest", PROBE_SMALLEST), ("rms", PROBE_RMS)):
        out.append(Comparison("3.2", f"{name} probe error (printed as mm)", "µm", number, why=lost, erratum=micrometres))
    return [*out, *_pattern()]


def _pattern() -> list[Comparison]:
    angles = pattern()
    below = angles[angles[:, 0] > 0.0]
    step = f"master_sphere_pattern with a step of {PATTERN_STEP_DEG.text}°"
    return [
        Comparison("3.2", "circles of latitude", "", PATTERN_CIRCLES, Computed(float(len(np.unique(below[:, 0])))), step),
        Comparison("3.2", "points on the circles", "", PATTERN_ON_CIRCLES, Computed(float(len(below))), step),
        Comparison("3.2", "points of the pattern", "", PATTERN_POINTS, Computed(float(len(angles))), step),
    ]


def machine_inputs(cmm: Cmm) -> tuple[F1, F1]:
    """Return the volume in mm and the squareness XY, XZ, YZ in rad of a machine."""
    return np.array(values(cmm.volume_mm)), np.array([cmm.squareness_urad[k].value for k in ("XY", "XZ", "YZ")]) * URAD


def _machine(cmm: Cmm) -> list[Comparison]:
    location = f"4, {cmm.name}"
    out = [
        Comparison(location, f"squareness {name}", "µrad", number, why="measured: input of the model", given=True)
        for name, number in cmm.squareness_urad.items()
    ]
    curve = "read from a curve that is lost with the figure"
    for name, (unit, band, repeatability) in cmm.bands.items():
        out.append(Comparison(location, f"band of {name}", unit, band, why=curve))
        out.append(Comparison(location, f"repeatability of {name}", unit, repeatability, why=curve))
    why = diagonal_evidence(cmm)
    out += [
        Comparison(location, f"space diagonal {k}, deviation", "µm", number, why=why, series=f"diagonals of {cmm.name}")
        for k, number in enumerate(cmm.diagonals_um, 1)
    ]
    random = "the random errors of the single parameters are printed for three of ten only, and the curves are lost"
    out += [
        Comparison(location, f"space diagonal {k}, random error", "µm", number, why=random, series=f"random errors of {cmm.name}")
        for k, number in enumerate(cmm.random_um, 1)
    ]
    return [*out, *_known(cmm)]


def _known(cmm: Cmm) -> list[Comparison]:
    """Return the comparisons of the numbers of math.md about the machine, the evidence for "not reproducible"."""
    location = f"8, {cmm.name}"
    diagonals_mm, misfit_rad, mean_um = _diagonals(cmm)
    length = float(np.linalg.norm(values(cmm.volume_mm)))
    of_type = f"squareness_diagonals_mm of {cmm.type_name}, printed squareness taken as exact"
    trials = "best_assignment: 24 orders, both senses of angle"
    return [
        stated(location, "length of a diagonal", "mm", MATH_DIAGONAL_MM[cmm.name], length, "norm of the volume"),
        stated(location, "mean of the printed diagonals", "µm", MATH_MEAN_UM[cmm.name], mean_um, "printed diagonals"),
        *(
            stated(location, f"{name} of squareness alone", "µm", number, 1e3 * value, of_type)
            for (name, value), number in zip(diagonals_mm.items(), MATH_SINGLE_UM[cmm.name], strict=True)
        ),
        stated(location, "best order of the diagonals misses by", "µrad", MATH_MISFIT_URAD[cmm.name], misfit_rad / URAD, trials),
    ]


def _diagonals(cmm: Cmm) -> tuple[dict[str, float], float, float]:
    """Return the diagonals by squareness alone (mm), the misfit of the printed diagonals in their best order (rad), and their mean (um)."""
    volume, squareness = machine_inputs(cmm)
    misfit, _ = best_assignment(cmm.type_name, volume, squareness, [d.value * 1e-3 for d in cmm.diagonals_um])
    return squareness_diagonals_mm(cmm.type_name, volume, squareness), misfit, float(np.mean(values(cmm.diagonals_um)))


def diagonal_evidence(cmm: Cmm) -> str:
    """Return the reason why the printed diagonals cannot be reproduced, with the numbers that show it."""
    diagonals_mm, misfit_rad, mean_um = _diagonals(cmm)
    sizes = ", ".join(f"{name} {minus(f'{1e3 * value:.1f}')}" for name, value in diagonals_mm.items())
    return (
        f"only squareness is printed, the curves of the other errors are lost and the paper does not name the diagonals."
        f" Squareness alone gives {sizes} µm (mean 0, printed mean {minus(f'{mean_um:.2f}')}); none of 24 orders and 2 senses of angle"
        f" brings the printed four nearer than {misfit_rad / URAD:.0f} µrad to the printed squareness"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """Calibration of the example, and the largest deviation of its map from the assumed lobing, mm."""

    calibration: ProbeCalibration
    largest_mm: float

    def values_um(self, colatitude_rad: F1, longitude_rad: F1) -> F2:
        """Return the map on a grid, um, shape (colatitudes, longitudes)."""
        grid = np.meshgrid(colatitude_rad, longitude_rad, indexing="ij")
        return np.asarray(1e3 * self.calibration.lobing_map().at_angles(*grid))


def pattern() -> F2:
    """Return the directions of the printed pattern, circles and points every 18 degrees and the pole, shape (101, 2)."""
    step = PATTERN_STEP_DEG.value
    return master_sphere_pattern(round(90.0 / step), round(360.0 / step), float(np.deg2rad(step)))


def example_lobing_mm(directions_rad: F2) -> F1:
    """Return the assumed lobing: the three lobes of a kinematic touch-trigger probe, and a difference between pole and equator."""
    phi, theta = directions_rad.T
    return without_absorbed(directions_rad, THREE_LOBES_MM * np.sin(phi) ** 2 * np.cos(3.0 * theta) + POLE_MM * np.cos(2.0 * phi))


def example() -> Example:
    """Calibrate a probe with the assumed lobing on the printed master sphere with the printed ball and pattern."""
    angles = pattern()
    normal = direction(angles[:, 0], angles[:, 1])
    lobing = example_lobing_mm(angles)
    distance = SPHERE_MM.value + EFFECTIVE_MM.value - lobing
    found = calibrate(normal * distance[:, None], angles, SPHERE_MM.value)
    return Example(found, float(np.abs(found.probe_mm - lobing).max()))
