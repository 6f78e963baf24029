"""Deviation at points from a campaign of artefacts, in the frame that it determines."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import Fine
from abbe.models.solvers.artefact_motion import above_orders_mm2, fine_of, motion_rows
from abbe.models.solvers.artefact_shares import field_shares, shares_text
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.poses import are_tilted, pose_rank
from abbe.models.solvers.plate_fit import plate_fit

SENSED = 1e-3
"""An axis is not sensed if no reading of the campaign has a larger direction cosine along it."""
COVERAGE = 2.0
ONE_PLANE_MM = 5.0
"""Points lie in one plane if consecutive heights, in order of size, differ by no more than this."""
WHOLE_TO, NOTHING_FROM = 0.35, 1.0
"""Ratios of mean squared uncertainty to mean squared deviation: up to the first the whole map is offered, from the second on none."""
TILTED = "The artefact lay tilted: Abbe does not list the errors that its poses hide, but U of the deviation includes them."
MOTION = "best-fit rigid motion{plane}{scale} over these points removed"
NO_LENGTH = "; no length is calibrated: the scale is not observable"
NOT_SENSED = "; the third direction was not sensed"


def artefact_lines(joint: JointSolution) -> list[str]:
    """Return sentences: errors that the poses of an artefact hide, and the pose that would show them; the shares of artefact and machine
    in the named error fields; and the separate fit of every workpiece."""
    rank = pose_rank(joint.data)
    poses = [TILTED] * are_tilted(joint.data) if rank is None else [rank.text, shares_text(field_shares(joint, rank), rank)]
    return poses + [fit.text for run in joint.data if (fit := plate_fit(run)) is not None]


def without_length(joint: JointSolution) -> bool:
    """Whether the scale is undetermined: probed artefacts only, none with a calibrated length."""
    return all(run.points is not None and run.points.source == "probe" for run in joint.data)


def unsensed_axis(joint: JointSolution) -> int | None:
    """Return the machine axis along which no point was sensed; None if all were."""
    runs = [run for run in joint.data if run.points is not None and run.points.source != "length"]
    along = [np.abs(run.points.matrix.T[run.points.component]).max(axis=0) for run in runs if run.points is not None]
    hidden = np.flatnonzero(np.max(along, axis=0) < SENSED)
    return int(hidden[0]) if hidden.size else None


def deviation_of_artefacts(joint: JointSolution, points_mm: F2) -> tuple[F2, F2, str]:
    """Return deviation and expanded uncertainty (k = 2) at points, mm, shape (n, 3) each, NaN where not sensed, and the frame in words."""
    tool = next(run.tool_mm for run in joint.data if run.points is not None and run.points.source != "length")
    waves, scatter_mm = _fine(joint, points_mm)
    at = motion_rows(joint, tool, points_mm, waves)
    axis, free = unsensed_axis(joint), without_length(joint)
    keep = [k for k in range(3) if k != axis]
    rows = at[:, keep].reshape(-1, at.shape[2])
    basis, _ = np.linalg.qr(_frame(points_mm, keep, scale=free))
    rows = rows - basis @ (basis.T @ rows)
    u: F1 = np.sqrt(np.maximum(np.sum(rows @ joint.estimate.covariance * rows, axis=1), 0.0))
    deviation, expanded = np.full((2, len(points_mm), 3), np.nan)
    value, spread = (rows @ joint.estimate.theta).reshape(-1, len(keep)), np.hypot(u.reshape(-1, len(keep)), scatter_mm[keep])
    share = _offered(value, spread)
    deviation[:, keep], expanded[:, keep] = share * value, COVERAGE * np.hypot(spread, (1.0 - share) * value)
    plane, scale = (" in the plane", NOT_SENSED) if axis is not None else ("", ""), (" and common scale", NO_LENGTH) if free else ("", "")
    return deviation, expanded, MOTION.format(plane=plane[0], scale=scale[0]) + scale[1] + plane[1]


def touched_boxes_mm(joint: JointSolution) -> tuple[F2, ...]:
    """Return boxes around all points, mm, shape (3, 2) each: lowest and highest position of each axis.

    One box; if the direction of an axis was not sensed, one box for each position of that axis.
    """
    places = np.concatenate([run.axes_mm for run in joint.data if run.points is not None and run.points.source != "length"])
    box, axis = np.stack([places.min(axis=0), places.max(axis=0)], axis=1), unsensed_axis(joint)
    if axis is None:
        return (box,)
    heights = np.sort(places[:, axis])
    planes = np.split(heights, np.flatnonzero(np.diff(heights) > ONE_PLANE_MM) + 1)
    return tuple(np.where(np.arange(3)[:, None] == axis, plane.mean(), box) for plane in planes)


def _offered(value_mm: F2, u_mm: F2) -> float:
    """Return the share of a map that is offered: all of it if it is clearly larger than its uncertainty, nothing if it is smaller.

    A map that the readings hardly show is often worse than none.
    """
    size = float(np.mean(value_mm**2))
    doubt = float(np.mean(u_mm**2)) / size if size > 0.0 else 1.0
    return float(np.clip((NOTHING_FROM - doubt) / (NOTHING_FROM - WHOLE_TO), 0.0, 1.0))


def _fine(joint: JointSolution, points_mm: F2) -> tuple[tuple[Fine, ...], F1]:
    """Return the waves of the machine's motions, and for each direction the variation from one position to the next, mm."""
    fine = fine_of(joint)
    scatter = np.zeros(3)
    for one in fine:
        if not one.period_mm:
            scatter[one.component] = joint.prior_sd[joint.estimate.names.index(one.name)]
    moving = np.ptp(points_mm, axis=0) > SENSED
    return tuple(one for one in fine if one.period_mm), np.hypot(scatter, np.sqrt(moving @ above_orders_mm2(joint)))


def _frame(points_mm: F2, keep: list[int], *, scale: bool) -> F2:
    """Return the rigid motions in the kept directions (and a common scale) at points, shape (n * kept, motions)."""
    away, unit = points_mm - points_mm.mean(axis=0), np.eye(3)
    turns = [k for k in range(3) if len(keep) == 3 or k not in keep]
    columns = [np.tile(unit[k], (len(away), 1)) for k in keep] + [np.cross(unit[k], away) for k in turns]
    columns += [away] if scale else []
    return np.stack(columns, axis=-1)[:, keep].reshape(-1, len(columns))
