"""Kwon (math.md 6 and 8): kinematics and text; Tables 1 and 2 have their own module."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1
from abbe.models.papers.kwon.geometry import Geometry
from abbe.models.papers.kwon.kinematics import forward, forward_as_printed, inverse, links, square_commands
from abbe.service.papers import kwon_printed as paper
from abbe.service.papers import kwon_tables
from abbe.service.papers.check import PaperCheck
from abbe.service.papers.printed import Printed
from abbe.service.papers.row import PaperRow, stated

IK_BOUND_MM = 1e-7
"""Largest deviation of the inverse from the commands of math.md's example."""


def rows() -> list[PaperRow]:
    """Every row of the paper, in printed order."""
    return [*_kinematics(), *_text(), *kwon_tables.rows()]


def assumed_geometry() -> Geometry:
    """The dimensions that math.md 6 assumes for its example."""
    g = paper.GEOMETRY_MM
    return Geometry(
        R_mm=np.array(g["R"]),
        r_mm=np.array(g["r"]),
        l_mm=np.array(g["l"]),
        l_up_mm=g["l_up"],
        l_dw_mm=g["l_dw"],
        theta_rad=float(np.deg2rad(paper.GEOMETRY_DEG)),
        le_mm=g["le"],
    )


def _kinematics() -> list[PaperRow]:
    geometry = assumed_geometry()
    out = []
    for command, numbers in paper.EXAMPLES:
        at = forward(geometry, np.array([command]))
        how = "forward with the geometry that math.md assumes"
        out += _point(f"ball centre at λ = {_list(command)}", numbers, at[0], how)
    wrong = forward_as_printed(geometry, np.array([paper.EXAMPLES[1][0]]))
    how = "forward_as_printed: eq (4) without the factor 1/2"
    out += _point("ball centre by (4) as printed", paper.EXAMPLE_WITHOUT_HALF, wrong[0], how)
    lengths = np.linalg.norm(links(geometry, np.array([paper.EXAMPLES[1][0]]), wrong)[0], axis=1)
    how = f"links at that point: {paper.GEOMETRY_MM['l']} mm came out unequal, (4) as printed breaks its own constraint"
    out += [
        stated("kwon", "6", f"link {k} at that point", "mm", number, float(value), how)
        for k, (number, value) in enumerate(zip(paper.LINKS_WITHOUT_HALF, lengths, strict=True), 1)
    ]
    ends = square_commands(geometry, 1.0, float(forward(geometry, np.array([paper.EXAMPLES[0][0]]))[0, 2]))
    how = "square_commands with the assumed geometry: more than the stated stroke of 2 mm; the real one cannot be checked"
    return out + [
        stated("kwon", "6", f"{name} λ for a square of ± 1 mm", "mm", number, value, how)
        for name, number, value in zip(("smallest", "largest"), paper.SQUARE_COMMANDS_MM, ends, strict=True)
    ]


def checks() -> list[PaperCheck]:
    """Check that the inverse returns the commands whose ball centre math.md states."""
    command, there = paper.EXAMPLES[1]
    back = inverse(assumed_geometry(), np.array([[p.value for p in there]]))[0]
    why = (
        f"math.md 6: IK returns λ. Bound {IK_BOUND_MM:g} mm: the ball centre has nine decimals in math.md, and its rows show how far the"
        " last ones are off"
    )
    return [
        PaperCheck(
            "kwon",
            "math.md 6",
            f"λ{k} back from the ball centre",
            "mm",
            given,
            float(value),
            IK_BOUND_MM,
            "inverse of the ball centre that math.md states, geometry that it assumes",
            why,
            series="λ back from the ball centre",
        )
        for k, (given, value) in enumerate(zip(command, back, strict=True), 1)
    ]


def _point(name: str, numbers: tuple[Printed, ...], point: F1, how: str) -> list[PaperRow]:
    return [
        stated("kwon", "6", f"{name}, {axis}", "mm", number, float(value), how)
        for axis, number, value in zip("xyz", numbers, point, strict=True)
    ]


def _list(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


def _text() -> list[PaperRow]:
    raw = "the coordinates measured on the CMM (Figs. 9, 10) are not printed"
    repeated = "the repeated readings (Fig. 14) are not printed"
    sd = ", ".join(f"{1e3 * np.sqrt(row[1].value):.1f}" for row in paper.TABLE2_MEAN_SQUARES.values())
    residual = f"the residuals (Fig. 13) are not printed. Consistency only: Table 2's mean squares mean standard deviations of {sd} µm"
    return [
        PaperRow("kwon", "4.2", "turn about Z before referencing", "°", paper.TURN_BEFORE_DEG, why=raw),
        PaperRow("kwon", "4.2", "turn about Z afterwards", "°", paper.TURN_AFTER_DEG, why=raw),
        PaperRow("kwon", "4.2", "residuals within ±", "µm", paper.RESIDUAL_UM, why=residual),
        *(
            PaperRow("kwon", "4.2", f"repeatability of {axis}, ±", "µm", number, why=repeated, series="repeatability ± of x, y, z")
            for axis, number in paper.REPEATABILITY_UM.items()
        ),
    ]
