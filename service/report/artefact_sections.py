"""Points of artefacts in a report: the deviation of the machine where they lay, as arrows, and the poses."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.machine import AXES
from abbe.models.solvers.joint import JointSolution
from abbe.service.identification.artefact_answer import deviation_of_artefacts, touched_boxes_mm
from abbe.service.rendering.document import PictureBlock, Section, TextTable
from abbe.service.rendering.plots.slices import PLANES, SlicePlane, SliceTexts, colour_top, magnification, slice_plot

NODES = 9
MOST = 3
"""Pictures of planes at most."""


def artefact_sections(joint: JointSolution) -> list[Section]:
    """Return the section of a solution of artefacts alone; none for other solutions."""
    if not joint.only_artefacts:
        return []
    slices = [one for box in touched_boxes_mm(joint) for one in _planes(joint, box)][:MOST]
    top = colour_top(np.concatenate([np.linalg.norm(s.deviation_um, axis=2).ravel() for s, _ in slices]))
    pictures = [_picture(one, at, top, k) for k, (one, at) in enumerate(slices)]
    frame = deviation_of_artefacts(joint, slices[0][0].grid_mm.reshape(-1, 3))[2]
    caption = f"Actual minus commanded; {frame}. Ring: not larger than U (95 %). Only where the artefact was touched."
    return [Section("Deviation where the artefact lay", [PictureBlock(caption, pictures), _poses(joint)])]


def _planes(joint: JointSolution, box_mm: F2) -> list[tuple[SlicePlane, str]]:
    """The plane of a flat box, or the planes through the middle of another one, with their position as text."""
    out = []
    for plane, (across, up, fixed) in PLANES.items():
        if min(np.ptp(box_mm[across]), np.ptp(box_mm[up])) <= 0.0:
            continue
        grid = np.full((NODES, NODES, 3), box_mm.mean(axis=1))
        low, high = box_mm.T
        grid[..., across] = np.linspace(low[across], high[across], NODES)[:, None]
        grid[..., up] = np.linspace(low[up], high[up], NODES)[None]
        value, expanded = (np.nan_to_num(v) for v in deviation_of_artefacts(joint, grid.reshape(-1, 3))[:2])
        length, u = np.linalg.norm(value, axis=1), np.linalg.norm(expanded, axis=1)
        shape = (NODES, NODES)
        data = SlicePlane(plane, grid, 1e3 * value.reshape(*shape, 3), 1e3 * u.reshape(shape), (length > u).reshape(shape))
        out.append((data, f"{AXES[fixed]} = {box_mm[fixed].mean():.0f} mm"))
    return out


def _picture(data: SlicePlane, at: str, top: float, k: int) -> str:
    length = np.linalg.norm(data.deviation_um, axis=2)
    magnified = magnification(float(np.ptp(data.grid_mm.reshape(-1, 3), axis=0).max()), float(length.max()))
    texts = SliceTexts(f"Deviation, {at}", "commanded", "actual, magnified", "not larger than U", f"errors magnified {magnified:g} times")
    return slice_plot(data, top, magnified, texts, key=f"artefact-{k}")


def _poses(joint: JointSolution) -> TextTable:
    head = ("Run", "Artefact", "X mm", "Y mm", "Z mm", "Axes of the artefact in the machine", "Points")
    rows = []
    for run in joint.data:
        if run.points is None or run.points.source == "length":
            continue
        low, high = run.axes_mm.min(axis=0), run.axes_mm.max(axis=0)
        extent = [f"{a:.0f} … {b:.0f}" for a, b in zip(low, high, strict=True)]
        axes = ", ".join(
            f"{name} ({', '.join(f'{v:.3g}' for v in column + 0.0)})" for name, column in zip("xyz", run.points.matrix.T, strict=True)
        )
        rows.append((run.label, run.points.artefact, *extent, axes, str(len(set(zip(run.points.feature, run.t_s.tolist(), strict=True))))))
    return TextTable(head, rows)
