"""A solution without the scales of the axes, for runs that do not determine them.

A ball-bar of unknown length cannot separate a common scale from its length; a laser along diagonals cannot separate the scales of the axes
from the tilt of its mirror. All other errors may be known well. So the best-fit scale over the volume is projected out of the coefficients,
together with the best-fit rigid motion (`abbe.models.geometry.volume`), and out of every source of their uncertainty.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from abbe.models.arrays import F2
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import AXES, Machine

if TYPE_CHECKING:
    from abbe.models.uncertainty.sources import ErrorSources

Scales = Literal["common", "axes"]
"""The common scale of all axes, or the scale of each axis."""
SCALE_TEXTS: dict[Scales, str] = {"common": "the common scale", "axes": "the scales of the axes"}
NODES = 5


def scale_projection(machine: Machine, terms: tuple[Term, ...], scales: Scales) -> F2:
    """Return the matrix that removes the best-fit scale over the volume from a map: coefficients to coefficients, shape (terms, terms).

    Scale and rigid motion are fitted together over an even grid over the strokes. The rigid motion stays in the map.

    Raises
    ------
    ValueError
        The model has no scale errors.
    """
    points = volume_grid(machine.stroke_mm, NODES)
    away = points - points.mean(axis=0)
    field = design(machine, terms, points).reshape(-1, len(terms))
    stretch = np.stack([np.outer(away[:, a], np.eye(3)[a]) for a in range(3)], axis=2)  # (m, 3, axes)
    stretch = stretch if scales == "axes" else stretch.sum(axis=2, keepdims=True)
    columns = np.concatenate([rigid_design(points), stretch], axis=2)
    fitted = np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), field, rcond=None)[0][6:]
    unit = np.stack([_one_scale(machine, terms, a) for a in range(3)], axis=1)
    return np.asarray(np.eye(len(terms)) - (unit if scales == "axes" else unit.sum(axis=1, keepdims=True)) @ fitted)


def _one_scale(machine: Machine, terms: tuple[Term, ...], axis: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the coefficients that stretch one axis by 1 mm/mm."""
    name = f"E{AXES[axis]}{AXES[axis]}.1"
    found = [i for i, t in enumerate(terms) if t.name == name]
    if not found:
        raise ValueError(f"scales: the model has no term {name}")
    ends = np.tile(machine.centre_mm, (2, 1))
    ends[:, axis] = machine.stroke_mm[axis]
    moved = design(machine, (terms[found[0]],), ends)[:, axis, 0]
    out = np.zeros(len(terms))
    out[found[0]] = machine.length_mm[axis] / (moved[1] - moved[0])
    return out


def without_scales(sources: ErrorSources, scales: Scales) -> ErrorSources:
    """Return a solution's map and all sources of its uncertainty without its scales.

    The ``solution`` of the result has the map's coefficients and covariance; its readings, priors and information are still those of the
    whole solution, so its sources must not be computed again.
    """
    solution, n = sources.solution, len(sources.solution.terms)
    whole = scale_projection(solution.machine, sources.terms, scales)
    estimate, turn = solution.estimate, np.eye(len(solution.estimate.theta))
    turn[:n, :n] = scale_projection(solution.machine, solution.terms, scales)
    free = replace(estimate, theta=turn @ estimate.theta, covariance=turn @ estimate.covariance @ turn.T)
    shares = tuple(
        replace(s, factor=whole @ s.factor, subtracted=None if s.subtracted is None else whole @ s.subtracted) for s in sources.sources
    )
    return replace(sources, solution=replace(solution, estimate=free), coefficients=whole @ sources.coefficients, sources=shares)
