"""Comparison of tables with the expected ones: differences by position, and mistakes such as wrong signs or units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.service.errors import TableContradicts
from abbe.service.formats.model import Compensation, correction_at

REMEDY = "do not load this file"
ALIKE = 0.2
"""Tables are taken as a multiple of the expected ones if they differ from that multiple by less than this share."""
FACTORS = (
    (-1.0, "the sign is wrong: this file would double every error"),
    (1000.0, "1000 times too large: µm were taken for mm"),
    (1e-3, "1000 times too small: mm were taken for µm"),
    (25.4, "25.4 times too large: mm were taken for inches"),
    (1 / 25.4, "25.4 times too small: inches were taken for mm"),
)
SEED = 907
POINTS = 400


@dataclass(frozen=True, slots=True)
class FormatDifference:
    """Largest difference of one axis' correction, mm, with its commanded position and direction of motion."""

    axis: str
    size_mm: float
    at_mm: tuple[float, float, float]
    direction: int


def places_mm(*parts: Compensation) -> F2:
    """Return the positions at which to compare tables, mm, shape (n, 3): each table point, the other axes centred, and random positions."""
    axes: list[list[F1]] = [[], [], []]
    for comp in parts:
        for t in comp.tables:
            axes[AXES.index(t.axis)].append(t.position_mm)
        curves = [c for p in comp.products for c in (p.angle, p.lever)] + list(comp.motions.curves.values() if comp.motions else ())
        for c in curves:
            axes[AXES.index(c.axis)].append(c.position_mm)
        if comp.lattice is not None:
            for k in range(3):
                axes[k].append(comp.lattice.position_mm[k])
    points = [np.unique(np.concatenate(a)) if a else np.zeros(1) for a in axes]
    low, high = (np.array([f(p) for p in points]) for f in (np.min, np.max))
    rng = np.random.default_rng(SEED)
    random = rng.uniform(low, high, (POINTS, 3))
    lines = [np.where(np.arange(3) == a, points[a][:, None], 0.5 * (low + high)) for a in range(3)]
    return np.concatenate([random, *lines])


def differences(found: Compensation, expected: Compensation) -> tuple[FormatDifference, ...]:
    """Return the largest difference per axis, over both directions."""
    p = places_mm(found, expected)
    out = []
    for a, axis in enumerate(AXES):
        best = FormatDifference(axis, 0.0, (0.0, 0.0, 0.0), 1)
        for way in (1, -1):
            size = np.abs(_moving(found, p, way) - _moving(expected, p, way))[:, a]
            k = int(size.argmax())
            if size[k] > best.size_mm:
                best = FormatDifference(axis, float(size[k]), (float(p[k, 0]), float(p[k, 1]), float(p[k, 2])), way)
        out.append(best)
    return tuple(out)


def check_same(found: Compensation, expected: Compensation, tolerance_mm: float) -> tuple[FormatDifference, ...]:
    """Return the differences if all are within the tolerance.

    Raises
    ------
    TableContradicts
        A difference is larger. The message states its place and, if recognized, the mistake (wrong sign or unit, swapped directions, ...).
    """
    found_differences = differences(found, expected)
    worst = max(found_differences, key=lambda d: d.size_mm)
    if worst.size_mm <= tolerance_mm:
        return found_differences
    place = ", ".join(f"{a} {v:g}" for a, v in zip(AXES, worst.at_mm, strict=True))
    size = (
        f"the correction of {worst.axis} differs by {worst.size_mm * 1e3:.2f} µm at {place} moving in {'+' if worst.direction > 0 else '−'}"
    )
    raise TableContradicts(f"{_mistake(found, expected) or 'the tables are not the expected ones'} ({size})", REMEDY)


def _moving(comp: Compensation, p: F2, way: int) -> F2:
    return correction_at(comp, p, np.full(p.shape, float(way)))


def _mistake(found: Compensation, expected: Compensation) -> str:
    """Return the known mistake that turns the expected tables into the found ones; empty if none does."""
    p = places_mm(found, expected)
    have, want = (np.stack([_moving(c, p, way) for way in (1, -1)]) for c in (found, expected))
    size = np.linalg.norm(want)
    if size == 0.0:
        return ""
    swapped = want[::-1]
    if np.linalg.norm(swapped - want) > 1e-3 * size and np.linalg.norm(have - swapped) < ALIKE * np.linalg.norm(swapped - want):
        return "the columns of the two directions are exchanged"
    for factor, text in FACTORS:
        if np.linalg.norm(have - factor * want) < ALIKE * abs(factor) * size:
            return text
    for a in range(3):
        rest = [k for k in range(3) if k != a]
        one, other = np.linalg.norm(have[..., a] + want[..., a]), np.linalg.norm(want[..., a])
        if other > 0 and one < ALIKE * other and np.linalg.norm((have - want)[..., rest]) < ALIKE * size:
            return f"the sign of {AXES[a]} is wrong: this file would double the error of that axis"
        turned = np.arange(3)
        turned[rest] = rest[::-1]
        exchanged = np.stack([_moving(found, p[:, turned], way)[:, turned] for way in (1, -1)])
        if np.linalg.norm(exchanged - want) < ALIKE * size:
            return f"the tables of {AXES[rest[0]]} and {AXES[rest[1]]} are exchanged"
    return ""
