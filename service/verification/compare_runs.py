"""Comparison of runs of one kind: whether they are comparable, their curves on one scale, and differences with uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.models.verification import U_REPEAT_MM, helix_figure
from abbe.service.domain.run import Run
from abbe.service.rendering.document import ReportFigure
from abbe.service.rendering.numbers import COVERAGE, finite
from abbe.service.runs.coverage import about_axis, helix_axis, not_judged, path_axis

MOST = 4
NEAR_RAD = 0.05
"""Two ball-bar readings within this angle belong to the same place: the deviation of a machine is smooth over it."""
SAME_PLACE_MM = 0.5
SAME_FEED = 0.01
"""Feeds that differ by less than this share count as equal."""
KIND = ("plane", "axis", "diagonal", "face", "order")
"""Fields of a set-up that must agree for two runs to be comparable."""
PLACE = ("centre_mm", "radius_mm", "start_mm", "end_mm")
UM = 1e3


@dataclass(frozen=True)
class LoadedRun:
    """A run to compare: name of its machine, readings for the solvers, and figures."""

    label: str
    machine: str
    run: Run
    data: RunData
    figures: Sequence[ReportFigure]


@dataclass(frozen=True, eq=False)
class ComparedCurve:
    """Deviation along a run, µm, with the standard uncertainty from noise, repeatability and calibration (NaN: unknown).

    ``round``: whether it is a ball-bar path. ``x``: degrees about the axis of a ball-bar path, mm along a laser line. ``place``: unit
    vector of the bar, shape (n, 3), or ``x`` again, shape (n, 1).
    """

    round: bool
    x: F1
    deviation_um: F1
    u_um: F1
    place: F2


@dataclass(frozen=True, eq=False)
class RunDifference:
    """The second run minus the first at places that both runs read: abscissa, difference, standard uncertainty."""

    x: F1
    difference_um: F1
    u_um: F1

    @property
    def largest(self) -> int:
        """Index of the largest difference."""
        return int(np.argmax(np.abs(self.difference_um)))

    @property
    def beyond(self) -> float:
        """Share of the places whose difference exceeds its U; NaN if no U is known."""
        known = np.isfinite(self.u_um) & (self.u_um > 0.0)
        return float((np.abs(self.difference_um) > COVERAGE * self.u_um)[known].mean()) if known.any() else float("nan")


@dataclass(frozen=True, slots=True)
class FigureRow:
    """One figure of all runs (value, standard uncertainty), and last minus first: difference, u, whether it exceeds U."""

    symbol: str
    name: str
    unit: str
    values: Sequence[tuple[float | None, float | None]]
    difference: float | None
    u: float | None
    sure: bool | None


def incomparable_reason(first: LoadedRun, other: LoadedRun) -> str:
    """Reason why two runs are not comparable, in one line; empty if they are."""
    if first.machine != other.machine:
        names = f"{other.label} was measured on machine {other.machine}, {first.label} on {first.machine}"
        return f"{names}: runs of two machines cannot be compared"
    if first.run.test != other.run.test:
        return f"{other.label} is {other.run.test}, {first.label} is {first.run.test}: only runs of one test can be compared"
    for key in KIND:
        a, b = (_kind(r, key) for r in (first, other))
        if a != b:
            return f"{key} of {other.label} is {b or 'none'}, of {first.label} {a or 'none'}: they ran along different paths"
    for one in (first, other):
        if why := not_judged(one.run):
            return f"{one.label}: {why}; a part of a path cannot be compared"
    return ""


def _kind(one: LoadedRun, key: str) -> str:
    """Return a set-up's field as text; the axis of a helix, if not stated, is derived from its path."""
    if key == "axis" and one.run.test == "ballbar_helix":
        axis = helix_axis(one.run.setup.axis, one.data.axes_mm)
        return "" if axis is None else AXES[axis]
    return getattr(one.run.setup, key, None) or ""


def _feed(mm_min: float) -> str:
    return f"{mm_min:g} mm/min"


def remarks(loaded: Sequence[LoadedRun], feed: Callable[[float], str] = _feed) -> list[str]:
    """Return remarks on places, tables in force, directions and feeds that differ from those of the first run. ``feed`` formats mm/min
    with its unit."""
    out = []
    first = loaded[0]
    for other in loaded[1:]:
        apart = [key for key in PLACE if not _same(getattr(first.run.setup, key, None), getattr(other.run.setup, key, None))]
        if apart:
            out.append(f"{other.label} was measured elsewhere than {first.label} ({', '.join(apart)}): the difference includes this")
        tables = [r.run.table.crc for r in (first, other)]
        if tables[0] != tables[1]:
            out.append(f"{other.label} was measured with another compensation table in force than {first.label}")
        ways = [set(r.run.columns.direction.tolist()) for r in (first, other)]
        if ways[0] != ways[1]:
            out.append(f"{other.label} was driven in another direction than {first.label}: the difference includes reversal errors")
        feeds = [float(np.median(r.run.columns.feed_mm_min)) for r in (first, other)]
        if abs(feeds[1] - feeds[0]) > SAME_FEED * abs(feeds[0]):
            feeds_text = f"{feed(feeds[1])}, {first.label} with {feed(feeds[0])}"
            out.append(f"{other.label} was driven with {feeds_text}: the difference includes effects of the feed")
    return out


def _same(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    first, second = np.atleast_1d(np.asarray(a, dtype=np.float64)), np.atleast_1d(np.asarray(b, dtype=np.float64))
    return first.shape == second.shape and bool(np.abs(first - second).max() <= SAME_PLACE_MM)


def curve(one: LoadedRun) -> ComparedCurve:
    """Deviation along a run, prepared for a comparison.

    Ball-bar: a fit removes centre and length of the bar; u from noise (second differences) and from remounting the bar. Laser: mean of all
    readings of a position; u from the scatter of half the difference out minus back (its mean is lost motion) and from the wavelength.
    """
    return _bar(one) if one.data.kind == "bar" else _laser(one)


def _bar(one: LoadedRun) -> ComparedCurve:
    data = one.data
    assert data.centre_mm is not None
    left = helix_figure(data).deviation_mm
    at = data.axes_mm - data.centre_mm
    noise = 1.4826 * float(np.median(np.abs(left[2:] - 2 * left[1:-1] + left[:-2]))) / np.sqrt(6.0)
    angle = np.degrees(about_axis(at, path_axis(one.run, data.axes_mm)))
    place = at / np.linalg.norm(at, axis=1, keepdims=True)
    return ComparedCurve(True, angle, left * UM, np.full(left.size, np.hypot(noise, U_REPEAT_MM) * UM), place)


def _laser(one: LoadedRun) -> ComparedCurve:
    data = one.data
    assert data.beam is not None
    s = np.round((data.axes_mm - data.axes_mm[0]) @ data.beam, 2)
    order = np.argsort(s, kind="stable")
    groups = [(p, [data.deviation_mm[i] for i in rows]) for p, rows in groupby(order, key=lambda i: float(s[i]))]
    x = np.array([p for p, _ in groups])
    mean = np.array([np.mean(v) for _, v in groups])
    half = np.array([(v[0] - v[1]) / 2 for _, v in groups if len(v) == 2])
    scatter = float(np.std(half, ddof=1)) if half.size > 2 else float("nan")
    return ComparedCurve(False, x, mean * UM, np.hypot(scatter, U_WAVELENGTH * np.abs(x)) * UM, x[:, None])


def difference(first: ComparedCurve, second: ComparedCurve) -> RunDifference | None:
    """Return the second run minus the first at those places of the first that both runs read; None for fewer than three places."""
    far = NEAR_RAD if first.round else 0.05
    distance, at = scipy.spatial.cKDTree(second.place).query(first.place)
    near = distance <= far
    if int(near.sum()) < 3:
        return None
    at = at[near]
    apart = second.deviation_um[at] - first.deviation_um[near]
    return RunDifference(first.x[near], apart, np.hypot(first.u_um[near], second.u_um[at]))


def figure_rows(loaded: Sequence[LoadedRun]) -> list[FigureRow]:
    """Figures with a unit that all runs have, in the order of the first run.

    The uncertainty of a difference treats both values as independent. This is safe: a shared laser or bar makes the true one smaller.
    """
    tables = [{(f.symbol, f.name): f for f in one.figures if f.unit} for one in loaded]
    out = []
    for key, head in tables[0].items():
        found = [t[key] for t in tables if key in t]
        if len(found) < len(loaded) or all(f.value is None for f in found):
            continue
        values = [(f.value, f.u) for f in found]
        out.append(FigureRow(head.symbol, head.name, head.unit, values, *_apart(values[0], values[-1])))
    return out


def _apart(a: tuple[float | None, float | None], b: tuple[float | None, float | None]) -> tuple[float | None, float | None, bool | None]:
    if not (finite(a[0]) and finite(b[0])):
        return None, None, None
    apart = b[0] - a[0]
    if not (finite(a[1]) and finite(b[1])):
        return apart, None, None
    u = float(np.hypot(a[1], b[1]))
    return apart, u, abs(apart) > COVERAGE * u
