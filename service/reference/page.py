"""The papers as a report: printed and computed numbers, and the papers' pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version

import numpy as np

from abbe.models.arrays import F1
from abbe.models.geometry.chain import deviation_mm
from abbe.models.notation.pahk import motions_from_pahk, pahk_machine, pahk_type
from abbe.models.papers.kwon.forensics import square_grid
from abbe.models.papers.kwon.layout import IN_PLANE, regressors
from abbe.service.reference.comparison import STATUSES, Comparison
from abbe.service.reference.paper_results import Paper, PaperResult
from abbe.service.reference.papers import kwon_printed, pahk, yang_printed
from abbe.service.reference.papers.kwon import in_plane, plane
from abbe.service.reference.papers.pahk import EXAMPLE, Cmm, example, machine_inputs
from abbe.service.reference.papers.yang import bar_line_um, restored_x_mm
from abbe.service.reference.printed import values
from abbe.service.reference.text import NONE, line_of, minus, short
from abbe.service.rendering.document import Document, Lines, PictureBlock, Section, TextTable
from abbe.service.rendering.plots.curves import ComparedReadings, comparison_plot
from abbe.service.rendering.plots.isometric import lobing_plot, surface_plot
from abbe.service.rendering.plots.maps import SignedScale, Surface, contour_plot
from abbe.service.rendering.plots.volume import deformed_grid

NODES = 5
SURFACE_NODES = 41
"""Nodes per side of Kwon's square in the pictures of a surface: the paper's nine, and four between neighbours."""


def figures(paper: Paper) -> list[PictureBlock]:
    """Return the pictures of one paper, in printed order."""
    if paper == "pahk":
        return [_probe(), _machines()]
    if paper == "yang":
        return [_laser_and_bar()]
    if paper == "kwon":
        return _surfaces()
    return []


def _surfaces() -> list[PictureBlock]:
    z = plane().z_mm
    drawn = {c: _surface(c, z) for c in kwon_printed.COMPONENTS}
    scale = SignedScale.around(*(s.values for s in drawn.values()))
    text = (
        f"response surfaces of the position error from the coefficients of Table 1 on the plane that they imply, Z = {z:.3f} mm (the paper"
        f" states {kwon_printed.PLANE_Z_MM.text} mm; β10 of e_x restored). The readings are not printed."
        f" The square of ± 1 mm is an assumption from the text: {kwon_printed.POINTS.text} points {kwon_printed.STEP_MM.text} mm apart,"
        f" stroke of 2 mm. One scale for all three, extremes over {SURFACE_NODES} × {SURFACE_NODES} points."
    )
    spatial = tuple(surface_plot(s, scale, key=f"surface-{c}", heading=f"{c} over the plane") for c, s in drawn.items())
    flat = tuple(contour_plot(s, scale, key=f"contour-{c}", heading=f"{c}, level lines") for c, s in drawn.items())
    return [
        PictureBlock(f"Kwon, Fig. 11: {text}", spatial),
        PictureBlock(f"Kwon, Fig. 12: level lines of the same {text}", flat),
    ]


def _surface(component: str, z_mm: float) -> Surface:
    line = np.linspace(-1.0, 1.0, SURFACE_NODES)
    points = square_grid(1.0, 2.0 / (SURFACE_NODES - 1), z_mm)
    values_um = 1e3 * (regressors(points, IN_PLANE) @ in_plane(component, z_mm))
    return Surface(line, line, values_um.reshape(SURFACE_NODES, SURFACE_NODES).T, "X in mm", "Y in mm", "µm")  # square_grid runs y fastest


def _hemisphere(step_deg: float) -> tuple[F1, F1]:
    """Return colatitudes and longitudes of the upper half of a sphere, rad, including equator and full turn."""
    low, around = (np.deg2rad(np.arange(0.0, end + step_deg / 2, step_deg)) for end in (90.0, 360.0))
    return low, around


def _probe() -> PictureBlock:
    found = example()
    coarse, fine = _hemisphere(6.0), _hemisphere(2.0)
    relief, chart = found.values_um(*coarse), found.values_um(*fine)
    scale = SignedScale.around(relief, chart)
    flat = Surface(np.rad2deg(fine[1]), np.rad2deg(fine[0]), chart, "longitude θ in degrees", "colatitude φ in degrees", "µm")
    dots = [(float(np.rad2deg(b)), float(np.rad2deg(a))) for a, b in found.calibration.directions_rad]
    pictures = (
        lobing_plot(*coarse, relief, scale, key="lobing-3d", heading="Probe error in space, EXAMPLE"),
        contour_plot(flat, scale, key="lobing-2d", heading="Probe error in plan, EXAMPLE", dots=dots),
    )
    caption = (
        "Pahk, Figs. 3(a) and 3(b), EXAMPLE: the paper's map is not printed. Master sphere, effective ball radius and the 101 directions"
        f" (dots) are the printed ones (Rs {pahk.SPHERE_MM.text} mm, Reff {pahk.EFFECTIVE_MM.text} mm, every"
        f" {pahk.PATTERN_STEP_DEG.text}°); the lobing is assumed: {EXAMPLE}. The picture shows the map that the calibration recovers"
        f" (Reff {found.calibration.effective_radius_mm:.4f} mm, map within {short(1e3 * found.largest_mm)} µm of the assumed one),"
        " bilinear between the touches. Positive: the probe triggers late. Dashed: equator of the ball without error."
    )
    return PictureBlock(caption, pictures)


def _machines() -> PictureBlock:
    caption = (
        "Pahk, Figs. 5 and 7(a): volumetric error of CMM A and CMM B, 5 × 5 × 5 nodes, tool relative to workpiece, Y line as datum"
        " as in the paper. It contains only the three printed squareness errors: the positional, straightness and angular curves of Figs. 4"
        " and 6 are lost, so these are not the paper's maps. Dashed: as commanded; solid: with the errors magnified as each picture states."
    )
    return PictureBlock(caption, tuple(_machine(cmm) for cmm in pahk.CMMS))


def _machine(cmm: Cmm) -> str:
    volume, squareness = machine_inputs(cmm)
    kind = pahk_type(cmm.type_name)
    machine = pahk_machine(kind, np.stack([np.zeros(3), volume], axis=1))
    lines = [np.linspace(0.0, v, NODES) for v in volume]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    nodes = grid.reshape(-1, 3)
    nothing = np.zeros((len(nodes), 3, 3))
    deviation = deviation_mm(machine, nodes, motions_from_pahk(kind, nodes, nothing, nothing, squareness)).reshape(grid.shape)
    heading = f"{cmm.name} ({cmm.type_name}), squareness only"
    return deformed_grid(grid, 1e3 * deviation, key=f"pahk-{cmm.type_name}", heading=heading)


def _laser_and_bar() -> PictureBlock:
    x = np.array(restored_x_mm())
    laser, bar, _ = yang_printed.TABLE2["dxx"]
    data = ComparedReadings(
        "X in mm",
        x,
        "laser, Table 3",
        np.array(values(yang_printed.TABLE3_LASER)),
        (
            (f"line of the ball bar, slope {minus(bar.text)}", np.array(bar_line_um())),
            (f"line of the laser, slope {minus(laser.text)}", laser.value * x * 1e3),
        ),
    )
    caption = (
        "Yang and Kim, Fig. 7: δxx (EXX) by laser (Table 3, the eighth position restored to 254.0 mm) with the two first-order lines of"
        " Table 2. Below: laser minus the ball bar's line."
    )
    return PictureBlock(caption, (comparison_plot(data, key="yang-dxx", heading="δxx: laser against ball bar"),), "wide")


MARKS = {"reproduced": "✔", "consistent": "≈", "differs": "≠", "input": "▷", "not reproducible": "○", "holds": "✔", "fails": "✘"}
INTRODUCTION = (
    "Every number below stands in print; beside it is the number computed from the paper's own inputs. The status follows from the two."
    " Reproduced: computed from independent inputs and equal to the last printed digit. Consistent: not equal to that digit, but no farther"
    " apart than the rounding of the printed inputs allows (column “within”), or a bound that holds, or equal only under an assumption that"
    " the row names. Differs: farther apart. Input: given, or zero by construction, so there is nothing to compute. Not reproducible: the"
    " paper does not print the necessary inputs. Rows “math.md” compare numbers of the mathematical specification that comes with the"
    " vector files. These rows and own checks are not counted."
)
CHECKS = "An own check puts numbers of the paper into Abbe's functions and computes them back: it tests these functions, not the paper."
_UNIT_AFTER = re.compile(r"(?<=\d) (?=(?:µm|mm|nm|µrad|mrad|rad|°|%)(?!\w))")
"""Space between a number and its unit, where a line must not break."""


def papers_report(found: Sequence[PaperResult]) -> Document:
    """Return the report of papers; equal results give equal bytes."""
    summary = [(f.title, *(str(n) for n in f.counts().values())) for f in found]
    return Document(
        kind="papers",
        title="The four papers, recomputed",
        about={"abbe": version("abbe")},
        sections=(
            Section("Printed numbers", (INTRODUCTION, TextTable(("Paper", *STATUSES["paper"]), summary))),
            *(_paper(f) for f in found),
        ),
        signatures=(),
    )


def _paper(found: PaperResult) -> Section:
    notes: dict[str, int] = {}
    pictures = [replace(p, caption=_unbroken(p.caption)) for p in figures(found.paper)]
    numbers = _table("Printed", found.numbers, notes)
    checks = found.of("own check")
    own = [Section("Own checks on its numbers", (CHECKS, _table("Given", checks, notes)))] if checks else []
    return Section(found.title, (*pictures, numbers, *own, Section("How and why", (Lines(tuple(notes), numbered=True),))))


def _table(expected: str, comparisons: Sequence[Comparison], notes: dict[str, int]) -> TextTable:
    """Return the table of comparisons, and add its notes to ``notes``, the numbered notes of the section."""
    rows = []
    for comparison in comparisons:
        line = line_of(comparison)
        location = f"math.md, {line.location}" if comparison.source == "math.md" else line.location
        text = _unbroken(". ".join(part for part in (comparison.how, line.note) if part))
        cells = ("" if cell == NONE else cell for cell in (line.expected, line.computed, line.difference, line.within))
        status = f"{MARKS[line.status]} {line.status}".replace(" ", "\u00a0")
        rows.append((location, _unbroken(line.quantity), *cells, status, str(notes.setdefault(text, len(notes) + 1))))
    return TextTable(("Where", "Quantity", expected, "Computed", "Off by", "Within", "Status", "Note"), rows)


def _unbroken(text: str) -> str:
    """Put non-breaking spaces between numbers and units."""
    return _UNIT_AFTER.sub("\u00a0", text)
