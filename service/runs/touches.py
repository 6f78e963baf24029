"""From the touches of a hole or ball to its centre: the only place where latched positions become columns of an artefact's run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.service.domain.measured import RunStart, TouchedFeature, TouchRecord
from abbe.service.domain.run import ArtefactPose, Columns

LEAST_U_MM = 1e-5
ROUNDS = 6
U_LOBING_MM = 1e-3
"""Standard uncertainty of a qualified radius because pre-travel depends on the direction of the touch, mm: an assumption (touch-trigger
probes show 0.5 to 2 um); the few sides of a sphere do not show it."""


@dataclass(frozen=True, slots=True)
class FoundFeature:
    """Axis position of the centre (3,), distance of the tip's centre from it at the touches, and spread of a single touch, mm.

    ``u_radius_mm``: standard uncertainty of that distance by repeatability and resolution.
    """

    centre_mm: F1
    radius_mm: float
    spread_mm: float
    u_radius_mm: float


def found_feature(touched: TouchedFeature) -> FoundFeature:
    """Fit a circle (hole; the height stays as expected) or a sphere (ball) to the touches of a feature."""
    target, sides = np.asarray(touched.target_mm, dtype=np.float64), np.asarray(touched.sides, dtype=np.float64)
    each = [np.asarray(side, dtype=np.float64) for side in touched.touches_mm]
    means, free = np.array([side.mean(axis=0) for side in each]), _free(sides)
    centre, radius = target.copy(), float(np.einsum("ni,ni->n", means - target, sides).mean())
    slope = np.empty((0, 0))
    for _ in range(ROUNDS):
        away = (means - centre) @ free.T
        distance = np.linalg.norm(away, axis=1)
        slope = np.column_stack([away / distance[:, None], np.ones(len(away))])
        step = np.linalg.lstsq(slope, distance - radius, rcond=None)[0]
        centre, radius = centre + step[:-1] @ free, radius + float(step[-1])
    left = np.concatenate([(side - mean) @ way for side, mean, way in zip(each, means, sides, strict=True)])
    degrees = sum(len(side) - 1 for side in each)
    spread = float(np.sqrt(np.sum(left**2) / max(degrees, 1)))
    u_side = np.hypot(spread / np.sqrt(np.mean([len(side) for side in each])), touched.resolution_mm / np.sqrt(12.0))
    u_radius = float(u_side * np.sqrt(np.linalg.inv(slope.T @ slope)[-1, -1]))
    return FoundFeature(centre, radius, spread, u_radius)


def qualified_mm(records: Sequence[TouchRecord], stated_mm: float) -> tuple[float, float] | None:
    """Return the radius of the stylus with its pre-travel as the qualification sphere showed it in a run, and its standard uncertainty.

    ``stated_mm``: radius that the recipe states; None: no sphere was touched.
    """
    known = [(found_feature(r), r.radius_mm, r.u_sphere_mm) for r in records if r.radius_mm is not None and r.u_sphere_mm is not None]
    if not known:
        return None
    off = float(np.mean([found.radius_mm - expected for found, expected, _ in known]))
    by_touch = float(np.sqrt(np.sum([found.u_radius_mm**2 for found, _, _ in known]))) / len(known)
    return stated_mm + off, float(np.linalg.norm([by_touch, known[0][2], U_LOBING_MM]))


def _free(sides: F2) -> F2:
    """Return the directions in which the touches find the centre, as rows: a plane for a hole, all for a ball."""
    _, size, rows = np.linalg.svd(sides, full_matrices=False)
    return np.asarray(rows[size > 0.1 * size[0]])


def _repeatability_mm(spread_mm: float, repeats: int, resolution_mm: float) -> float:
    """Return the repeatability of the mean of two opposite sides; each resolution is a rectangular distribution (JCGM 100, F.2.2.1)."""
    return max(float(np.hypot(spread_mm / np.sqrt(2.0 * repeats), resolution_mm / np.sqrt(24.0))), LEAST_U_MM)


def touch_columns(records: Sequence[TouchRecord], start: RunStart, pose: ArtefactPose) -> Columns:
    """Convert the records of an artefact's run to columns: one row per touched feature (docs/schemas/artefact-run.schema.json).

    Touches of the qualification sphere give no row (`qualified_mm`).

    ``u_mm`` is the repeatability of a centre along a direction that was touched from both sides: the pooled spread of repeated touches
    divided by the root of their number, combined with the travel between two readings of the probe input, an error that repeated touches
    do not reduce.
    A ball's height comes from one side and the radius, so it is less certain (`abbe.service.runs.artefact_points.POLE`).
    """
    records = [record for record in records if not record.qualifies]
    found = [found_feature(record) for record in records]
    deviation = [(f.centre_mm - pose.origin_mm) @ pose.matrix - np.array(r.nominal_mm) for f, r in zip(found, records, strict=True)]
    spread = float(np.sqrt(np.mean([f.spread_mm**2 for f in found]))) if found else 0.0
    unsensed = {a: [k == 2 and r.inside for r in records] for k, a in enumerate("xyz")}
    return Columns.from_document(
        {"t_s": [start.since_zero_s(r.ctrl_us) for r in records]}
        | {f"{a}_mm": [round(float(f.centre_mm[k]), 7) for f in found] for k, a in enumerate("xyz")}
        | {"feature": [r.feature for r in records]}
        | {
            f"deviation_{a}_mm": [None if u else round(float(d[k]), 7) for d, u in zip(deviation, unsensed[a], strict=True)]
            for k, a in enumerate("xyz")
        }
        | {
            "u_mm": [_repeatability_mm(spread, len(r.touches_mm[0]), r.resolution_mm) for r in records],
            "temperature_C": [r.temperature_C for r in records],
            "touch_start_deg": [r.start_deg for r in records],
        }
    )
