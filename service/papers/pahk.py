"""Pahk, sections 3.2 and 4 (math.md 8): the computable numbers of the two machines and the probe, and why the others are not."""

from __future__ import annotations

import numpy as np

from abbe.models.papers.pahk.squareness_only import best_assignment, squareness_diagonals_mm
from abbe.service.papers import pahk_printed as paper
from abbe.service.papers.compare import Computed
from abbe.service.papers.pahk_printed import Cmm
from abbe.service.papers.printed import values
from abbe.service.papers.probe_example import pattern
from abbe.service.papers.row import Erratum, PaperRow, stated
from abbe.service.papers.text import minus

URAD = 1e-6


def rows() -> list[PaperRow]:
    """Every row of the paper, in printed order."""
    return [*_probe(), *[r for cmm in paper.CMMS for r in _machine(cmm)]]


def _probe() -> list[PaperRow]:
    lost = "the 101 readings and the map (Fig. 3) are not printed"
    micrometres = Erratum("printed as mm; a probe error of millimetres is impossible, µm is meant")
    out = [
        PaperRow("pahk", "3.2", "radius of the master sphere", "mm", paper.SPHERE_MM, why="given: input of the calibration", given=True),
        PaperRow("pahk", "3.2", "effective radius of the probe's ball", "mm", paper.EFFECTIVE_MM, why=lost),
    ]
    for name, number in (("largest", paper.PROBE_LARGEST), ("smallest", paper.PROBE_SMALLEST), ("rms", paper.PROBE_RMS)):
        out.append(PaperRow("pahk", "3.2", f"{name} probe error (printed as mm)", "µm", number, why=lost, erratum=micrometres))
    return [*out, *_pattern()]


def _pattern() -> list[PaperRow]:
    angles = pattern()
    below = angles[angles[:, 0] > 0.0]
    step = f"master_sphere_pattern with a step of {paper.PATTERN_STEP_DEG.text}°"
    return [
        PaperRow("pahk", "3.2", "circles of latitude", "", paper.PATTERN_CIRCLES, Computed(float(len(np.unique(below[:, 0])))), step),
        PaperRow("pahk", "3.2", "points on the circles", "", paper.PATTERN_ON_CIRCLES, Computed(float(len(below))), step),
        PaperRow("pahk", "3.2", "points of the pattern", "", paper.PATTERN_POINTS, Computed(float(len(angles))), step),
    ]


def machine_inputs(cmm: Cmm) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Volume in mm and squareness XY, XZ, YZ in rad of a machine."""
    return np.array(values(cmm.volume_mm)), np.array([cmm.squareness_urad[k].value for k in ("XY", "XZ", "YZ")]) * URAD


def _machine(cmm: Cmm) -> list[PaperRow]:
    where = f"4, {cmm.name}"
    out = [
        PaperRow("pahk", where, f"squareness {name}", "µrad", number, why="measured: input of the model", given=True)
        for name, number in cmm.squareness_urad.items()
    ]
    curve = "read from a curve that is lost with the figure"
    for name, (unit, band, repeatability) in cmm.bands.items():
        out.append(PaperRow("pahk", where, f"band of {name}", unit, band, why=curve))
        out.append(PaperRow("pahk", where, f"repeatability of {name}", unit, repeatability, why=curve))
    why = diagonal_evidence(cmm)
    out += [
        PaperRow("pahk", where, f"space diagonal {k}, deviation", "µm", number, why=why, series=f"diagonals of {cmm.name}")
        for k, number in enumerate(cmm.diagonals_um, 1)
    ]
    random = "the random errors of the single parameters are printed for three of ten only, and their curves are lost"
    out += [
        PaperRow("pahk", where, f"space diagonal {k}, random error", "µm", number, why=random, series=f"random errors of {cmm.name}")
        for k, number in enumerate(cmm.random_um, 1)
    ]
    return [*out, *_known(cmm)]


def _known(cmm: Cmm) -> list[PaperRow]:
    """Rows of math.md's statements about the machine: the evidence for "not reproducible"."""
    where = f"8, {cmm.name}"
    volume, squareness = machine_inputs(cmm)
    alone = squareness_diagonals_mm(cmm.type_name, volume, squareness)
    diagonals = [d.value * 1e-3 for d in cmm.diagonals_um]
    misfit, _ = best_assignment(cmm.type_name, volume, squareness, diagonals)
    length = float(np.linalg.norm(volume))
    mean = float(np.mean(values(cmm.diagonals_um)))
    of_type = f"squareness_diagonals_mm of {cmm.type_name}, printed squareness taken as exact"
    trials = "best_assignment: 24 orders, both senses of angle"
    return [
        stated("pahk", where, "length of a diagonal", "mm", paper.MATH_DIAGONAL_MM[cmm.name], length, "norm of the volume"),
        stated("pahk", where, "mean of the printed diagonals", "µm", paper.MATH_MEAN_UM[cmm.name], mean, "printed diagonals"),
        *(
            stated("pahk", where, f"{name} of squareness alone", "µm", number, 1e3 * value, of_type)
            for (name, value), number in zip(alone.items(), paper.MATH_ALONE_UM[cmm.name], strict=True)
        ),
        stated("pahk", where, "best order of the diagonals misses by", "µrad", paper.MATH_MISFIT_URAD[cmm.name], misfit / URAD, trials),
    ]


def diagonal_evidence(cmm: Cmm) -> str:
    """Reason why the printed diagonals cannot be reproduced, with the numbers that show it."""
    volume, squareness = machine_inputs(cmm)
    alone = squareness_diagonals_mm(cmm.type_name, volume, squareness)
    misfit, _ = best_assignment(cmm.type_name, volume, squareness, [d.value * 1e-3 for d in cmm.diagonals_um])
    sizes = ", ".join(f"{name} {minus(f'{1e3 * value:.1f}')}" for name, value in alone.items())
    mean = float(np.mean(values(cmm.diagonals_um)))
    return (
        f"only squareness is printed, the curves of the other errors are lost and the paper does not name the diagonals."
        f" Squareness alone gives {sizes} µm (mean 0, printed mean {minus(f'{mean:.2f}')}); none of 24 orders and 2 senses of angle brings"
        f" the printed four nearer than {misfit / URAD:.0f} µrad to the printed squareness"
    )
