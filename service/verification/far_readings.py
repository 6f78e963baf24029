"""Readings that lie far from the others of the same position and direction: blunders, such as a mistyped target, that no figure shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.document import Doc
from abbe.service.domain.run import Run
from abbe.service.domain.run_file import OtherReadings
from abbe.service.errors import AbbeError
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.verification.iso_readings import diagonal_groups, linear_groups, readings_along

FAR = 10.0
"""Smallest distance of a far reading from its median, in pooled scatters. Of 20000 simulated tests with normal readings one reached it with
6 groups of 3 readings, none with 10 or more groups; readings in whole steps with a scatter of 0.15 or 0.3 steps never came beyond 2."""
APART = 3.0
"""A far reading is also this many times as far from its median as the other readings of its group span: a position may scatter more."""
LEAST_READINGS = 3
LEAST_GROUPS = 6
"""Fewest groups (a group: one position, one direction) from which a scatter is known well enough."""
QUARTILE, NORMAL = 0.75, 1.15
"""The scatter is this quantile of the distances, divided by its value for a normal distribution: a quarter of them may be blunders."""
LEAST_UM = 0.01
"""Smallest scatter that is believed, µm or µrad: readings nearer than `FAR` times this deserve no remark."""
MOST = 5


@dataclass(frozen=True, slots=True)
class _Row:
    """One reading. ``where``: run or file; ``value``: µm or µrad."""

    where: str
    place_mm: float
    way: int
    value: float


def far_readings(runs: Sequence[Run]) -> list[str]:
    """Name the far readings of positioning tests and diagonals: run, position, direction and size. Nothing is left out."""
    groups = [(name, group) for (name, _), group in linear_groups(runs).items()]
    groups += [(name, group) for (_, name, _), group in diagonal_groups(runs).items()]
    out = []
    for name, group in groups:
        rows = [row for run in group for row in _rows(run, name)]
        out += _lines(rows, "run {}, the reading at " + name + " {} mm", "µm")
    return out


def far_angles(campaign: Doc) -> list[str]:
    """Name the far readings of the angles that an imported campaign holds beside its runs."""
    out = []
    for read in map(OtherReadings.read, campaign.get("readings", ())):
        if read.kind == "angle":
            each = zip(read.position_mm, read.direction, read.deviation, strict=True)
            rows = [_Row(read.file, place, way, 1e6 * value) for place, way, value in each]
            out += _lines(rows, "{}, the reading at " + read.axis + " {} mm", "µrad")
    return out


def _rows(run: Run, name: str) -> list[_Row]:
    try:
        each = zip(*readings_along(run, name), strict=True)
    except (AbbeError, ValueError):  # the evaluation says why it is not used
        return []
    return [_Row(run.run_id, float(place), int(way), 1e3 * float(value)) for place, way, value in each]


def _lines(rows: Sequence[_Row], head: str, unit: str) -> list[str]:
    """One line for each far reading, the farthest first; after `MOST` of them their number. ``head``: pattern with run and place."""
    groups: dict[tuple[float, int], list[_Row]] = {}
    for row in rows:
        groups.setdefault((row.place_mm, row.way), []).append(row)
    several = [group for group in groups.values() if len(group) >= LEAST_READINGS]
    if len(several) < LEAST_GROUPS:
        return []
    off = [_off(group) for group in several]
    usual = _scatter(off, np.array([row.value for row in rows]))
    each = [(d, row, ds) for group, ds in zip(several, off, strict=True) for d, row in zip(ds, group, strict=True)]
    far = [(d, row) for d, row, ds in each if abs(d) > max(FAR * usual, APART * _span_of_others(d, ds))]
    far.sort(key=lambda one: -abs(one[0]))
    rest = f"from the median of this position and direction, where all positions together scatter by {plain(usual, 2)} {unit}"
    out = [
        f"{head.format(row.where, tidy(row.place_mm))}, moving in {'+' if row.way > 0 else '-'}, "
        f"lies {plain(float(d))} {unit} {rest}: every figure uses it, look at it first"
        for d, row in far[:MOST]
    ]
    more = len(far) - MOST
    return [*out, f"{more} more readings lie as far from the others of their position and direction"] if more > 0 else out


def _span_of_others(d: float, all_of_it: F1) -> float:
    """Span of the other readings of a group; ``d``: the reading, ``all_of_it``: the group with it."""
    others = np.delete(all_of_it, int(np.argmin(np.abs(all_of_it - d))))
    return float(np.ptp(others))


def _off(group: Sequence[_Row]) -> F1:
    values = np.array([row.value for row in group])
    return np.asarray(values - np.median(values))


def _scatter(off: Sequence[F1], values: F1) -> float:
    """Robust standard deviation of a reading, pooled over all groups; at least one step of the readings, and `LEAST_UM`.

    The reading in the middle of an odd group is its median, and tells nothing about the scatter.
    """
    apart = np.sort(np.concatenate([np.sort(np.abs(d))[d.size % 2 :] for d in off]))
    steps = np.diff(np.unique(np.delete(values, int(np.argmax(np.abs(values - np.median(values)))))))  # a blunder is no step
    step = float(steps[steps > 1e-4 * LEAST_UM].min(initial=np.inf))
    return max(float(apart[int(QUARTILE * (apart.size - 1))]) / NORMAL, step if np.isfinite(step) else 0.0, LEAST_UM)
