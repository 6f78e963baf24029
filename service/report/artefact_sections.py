"""Points of artefacts in a report: one pose as it was read, the deviation of the machine where they lay, as arrows, and the poses."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.models.solvers.engine import DEFAULT_SIGMA_MM
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observations import RunData
from abbe.models.uncertainty.coverage import PROBABILITY, vector_factor
from abbe.service.domain.run import Run
from abbe.service.identification.artefact_answer import deviation_of_artefacts, touched_boxes_mm
from abbe.service.rendering.document import PictureBlock, ReportFigure, Section, TextTable
from abbe.service.rendering.numbers import COVERAGE
from abbe.service.rendering.plots.slices import PLANES, SlicePlane, SliceTexts, colour_top, magnification, slice_plot
from abbe.service.verification.iso_report import Evaluated

NODES = 9
MOST = 3
"""Largest number of pictures of planes."""


def artefact_sections(joint: JointSolution) -> list[Section]:
    """Return the section of a solution of artefacts alone; an empty list for other solutions."""
    if not joint.only_artefacts:
        return []
    slices = [one for box in touched_boxes_mm(joint) for one in _planes(joint, box)][:MOST]
    top = colour_top(np.concatenate([np.linalg.norm(s.deviation_um, axis=2).ravel() for s, _ in slices]))
    pictures = [_picture(one, at, top, k) for k, (one, at) in enumerate(slices)]
    frame = deviation_of_artefacts(joint, slices[0][0].grid_mm.reshape(-1, 3))[2]
    ring = "Ring: the deviation is not larger than U (95 %). Shown only where the artefact was touched."
    caption = f"Actual minus commanded; {frame}. {ring}"
    return [Section("Deviation where the artefact lay", [PictureBlock(caption, pictures), _poses(joint)])]


def _planes(joint: JointSolution, box_mm: F2) -> list[tuple[SlicePlane, str]]:
    """Return the plane of a flat box, or the planes through the middle of any other box, with their position as text."""
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


ALONE = "the deviation of the machine: one pose shows machine and form of the artefact together; solve three poses or more (abbe solve)"


def pose_readings(run: Run, data: RunData) -> Evaluated:
    """One pose as it was read, without the motion that fits it best: its features, their rms and their largest deviation.

    ``data``: observations of ``run``. The uncertainty contains the touches alone. U of the arrows and of the largest deviation holds for
    all arrows together (Sidak): noise alone exceeds it somewhere in at most 5 % of all poses.
    """
    p = data.points
    assert p is not None
    visits = list(zip(p.feature, data.t_s.tolist(), strict=True))
    labels = list(dict.fromkeys(visits))
    at = np.array([labels.index(k) for k in visits])
    left, u = _without_motion(data), DEFAULT_SIGMA_MM["artefact"] / np.sqrt(data.weight_n)
    deviation, nominal, largest_u = (np.zeros((len(labels), 3)) for _ in range(3))
    deviation[at, p.component], largest_u[at, p.component], nominal[at] = left, u, p.nominal_mm
    length, count = np.linalg.norm(deviation, axis=1), np.bincount(at)
    factor = np.array([vector_factor(int(k), PROBABILITY ** (1.0 / len(labels))) for k in count])
    expanded, worst = factor * largest_u.max(axis=1), int(np.argmax(length))
    rms, u_rms, noise = float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(u**2) / left.size)), float(np.sqrt(np.mean(u**2)))
    group, method = "Features, without the motion that fits best", "as read"
    figures = [
        ReportFigure(group, "n", "features read", float(len(labels)), None, "", "count"),
        ReportFigure(group, "rms", "rms deviation of machine and artefact together", 1e3 * rms, 1e3 * u_rms, "µm", method),
        ReportFigure(group, "u", "rms that the touches alone would give", 1e3 * noise, None, "µm", "as stated in the run"),
        ReportFigure(
            group, "max", f"largest deviation, at {labels[worst][0]}", 1e3 * float(length[worst]), 1e3 * float(expanded[worst]) / COVERAGE,
            "µm", method,
        ),
    ]  # fmt: skip
    figures += _stylus(run)
    return Evaluated(figures=figures, pictures=_read_features(nominal, deviation, expanded), not_observable=[ALONE])


def _stylus(run: Run) -> list[ReportFigure]:
    """The radius of the stylus as a qualification sphere showed it in this run."""
    radius, u = (run.setup.document.get(key) for key in ("tool_radius_mm", "u_tool_radius_mm"))
    if radius is None or u is None:
        return []
    return [ReportFigure("Stylus", "r", "radius of the stylus with its pre-travel", 1e3 * radius, 1e3 * u, "µm", "qualification sphere")]


def _without_motion(data: RunData) -> F1:
    """Deviations without the best-fit rigid motion, shape (n,), mm; a direction that was not sensed takes no part."""
    assert data.points is not None
    rows, away = data.points.component, data.points.nominal_mm - data.points.middle_mm
    turned = np.stack([np.cross(axis, away) for axis in np.eye(3)], axis=2)
    motion = np.column_stack([np.eye(3)[rows], turned[np.arange(rows.size), rows]])
    return np.asarray(data.deviation_mm - motion @ np.linalg.lstsq(motion, data.deviation_mm, rcond=None)[0])


def _read_features(nominal_mm: F2, deviation_mm: F2, expanded_mm: F1) -> list[PictureBlock]:
    """Arrows at the features, in the plane in which the artefact is widest; none for features on a line."""
    plane = max(PLANES, key=lambda p: np.prod([np.ptp(nominal_mm[:, k]) for k in PLANES[p][:2]]))
    across, up, _ = PLANES[plane]
    if min(np.ptp(nominal_mm[:, across]), np.ptp(nominal_mm[:, up])) <= 0.0:
        return []
    length = np.linalg.norm(deviation_mm, axis=1)
    data = SlicePlane(plane, nominal_mm[None], 1e3 * deviation_mm[None], 1e3 * expanded_mm[None], (length > expanded_mm)[None])
    magnified = magnification(float(np.ptp(nominal_mm, axis=0).max()), 1e3 * float(length.max()))
    texts = SliceTexts(
        "Deviation at the features, axes of the artefact", "", "", "not larger than U", f"errors magnified {magnified:g} times"
    )
    caption = "Measured minus nominal, without the motion that fits best: machine and artefact together. U: touches only."
    return [PictureBlock(caption, [slice_plot(data, colour_top(1e3 * length), magnified, texts, key="features")])]
