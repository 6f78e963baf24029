"""A machine's motion as the points of an artefact show it: smooth terms, fine structure, and what is rougher than the model's orders."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import SMOOTH_ORDER
from abbe.models.geometry.chain import design
from abbe.models.machine import with_tool
from abbe.models.solvers.artefact import SAME_PLACE_MM, Fine
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import ROUGH_LENGTH_MM, Priors, rough_root


def fine_of(joint: JointSolution) -> tuple[Fine, ...]:
    """Fine structure of the machine that the solution includes."""
    return next((run.points.fine for run in joint.data if run.points is not None and run.points.fine), ())


def motion_rows(joint: JointSolution, tool_mm: F1 | None, points_mm: F2, fine: Iterable[Fine]) -> F3:
    """Derivative of the deviation at points by the unknowns, shape (n, 3, unknowns); zero for fine structure that is not in ``fine``."""
    names = {name: i for i, name in enumerate(joint.estimate.names)}
    out = np.zeros((len(points_mm), 3, len(names)))
    out[:, :, : len(joint.terms)] = design(with_tool(joint.machine, tool_mm), joint.terms, points_mm)
    for one in fine:
        out[:, one.component, names[one.name]] = one.values(points_mm)
    return out


def above_orders_mm2(joint: JointSolution) -> F1:
    """Variance of a rough motion of each axis above the orders of the model, mm^2, shape (3,); zero without rough motions."""
    last = max(t.order for t in joint.terms)
    if last <= SMOOTH_ORDER:
        return np.zeros(3)
    size = Priors().rough_mm * joint.size_factors.get("rough", 1.0) * joint.size_factors.get("machine", 1.0)
    shares = []
    for length in joint.machine.length_mm:
        root = rough_root(0, last, ROUGH_LENGTH_MM / float(length))
        inside = float(((root**2).sum(axis=1) / (2.0 * np.arange(last + 1) + 1.0)).sum())
        shares.append(size**2 * max(1.0 - inside, 0.0))
    return np.array(shares)


def unfollowed_mm2(joint: JointSolution, points_mm: F2, weights: F3) -> F1:
    """Variance that motions above the orders add to weighted sums of deviations, mm^2, shape (k,); ``weights``: shape (k, n, 3).

    Such a motion is the same for all points at one position of its axis, and independent elsewhere. Motions whose value at every touched
    position is an unknown add nothing.
    """
    followed = {(one.axis, one.component) for one in fine_of(joint) if not one.period_mm}
    out = np.zeros(len(weights))
    for axis, variance in enumerate(above_orders_mm2(joint)):
        at = np.argsort(points_mm[:, axis])
        starts = np.flatnonzero(np.diff(points_mm[at, axis], prepend=-np.inf) > SAME_PLACE_MM)
        if starts.size < 2:
            continue
        sums = np.add.reduceat(weights[:, at], starts, axis=1)
        free = [k for k in range(3) if (axis, k) not in followed]
        out += variance * (sums[:, :, free] ** 2).sum(axis=(1, 2))
    return out
