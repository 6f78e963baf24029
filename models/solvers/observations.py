"""Observations of one run as arrays: the only form in which measurements enter a solver."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import ArtefactPoints

Kind = Literal["bar", "laser", "artefact"]
Test = Literal["", "helix", "circle", "diagonal", "linear", "artefact"]

REJECT_SIGMA = 5.0
"""A reading farther from its block's median than this many robust standard deviations is left out of the block's mean."""
LEAST_SPREAD_MM = 1e-4
"""Least robust standard deviation: the resolution of a usual ball-bar, so that rounding makes no outliers."""

LEAST_BAR_MM = 1.0
"""Length of the shortest ball-bar; a position nearer to the cup is a mistake."""


@dataclass(frozen=True)
class RunData:
    """One run, valid readings only.

    Attributes
    ----------
    label, setup : str
        Run name; set-up name (runs with the same set-up share its unknowns).
    kind : "bar" | "laser" | "artefact"
    axes_mm : array, shape (n, 3)
        Commanded coordinates.
    deviation_mm : array, shape (n,)
        Bar length minus radius, displacement since the first record minus nominal, or one component of
        an artefact's point.
    sign : array, shape (n, 3)
        Direction in which each axis last moved (`abbe.models.geometry.chain.travel_sign`).
    t_s : array, shape (n,)
        Campaign clock.
    weight_n : array, shape (n,)
        Number of raw readings in each mean.
    centre_mm, radius_mm : array (3,), float, for a ball-bar
        Nominal cup centre and bar length.
    beam : array, shape (3,), for a laser
        Unit vector of the nominal beam.
    u_length_mm : float, optional
        Stated standard uncertainty of the bar's calibrated length.
    length_calibrated : bool, optional
        Whether the bar's length was calibrated at all; None: the run does not say (`abbe.models.solvers.priors.bar_length_sd`).
    tool_mm : array, shape (3,), optional
        Vector from the spindle reference to the functional point in this run; None: the machine's own tool.
    points : ArtefactPoints, for an artefact
    test : "helix" | "circle" | "diagonal" | "linear" | "artefact" | ""
        Kind of test, for display and to compare runs; the reading depends only on ``kind`` and the positions.
    rejected : int
        Number of raw readings that `block_average` left out.
    start_mm : array, shape (3,), optional, for a laser
        Commanded position at which beam and mirror met at the functional point; None: the first position of this run.
    mirror_turns : bool
        Whether the laser's mirror is on the tool's side and turns with it; False: it stands on the workpiece's side, and the laser moves.
    """

    label: str
    setup: str
    kind: Kind
    axes_mm: F2
    deviation_mm: F1
    sign: F2
    t_s: F1
    weight_n: F1
    centre_mm: F1 | None = None
    radius_mm: float | None = None
    beam: F1 | None = None
    u_length_mm: float | None = None
    length_calibrated: bool | None = None
    tool_mm: F1 | None = None
    points: ArtefactPoints | None = None
    test: Test = ""
    rejected: int = 0
    start_mm: F1 | None = None
    mirror_turns: bool = True

    def __post_init__(self) -> None:
        """Refuse data that no solver can use; the error names the run."""
        _check_columns(self)
        if self.kind == "bar":
            _check_bar(self)
        elif self.kind == "laser":
            _check_beam(self)
        elif self.points is None or len(self.points.feature) != self.deviation_mm.size:
            raise ValueError(f"run {self.label}: a run of an artefact needs a feature for every reading")
        if self.tool_mm is not None and (self.tool_mm.shape != (3,) or not np.isfinite(self.tool_mm).all()):
            raise ValueError(f"run {self.label}: tool_mm must be three finite numbers")
        if self.u_length_mm is not None and not (np.isfinite(self.u_length_mm) and self.u_length_mm >= 0):
            raise ValueError(f"run {self.label}: u_length_mm must be a number of 0 or more")


def _check_columns(run: RunData) -> None:
    """Check that every column is finite and as long as the readings."""
    n = run.deviation_mm.size
    shapes = {"deviation_mm": (n,), "axes_mm": (n, 3), "sign": (n, 3), "t_s": (n,), "weight_n": (n,)}
    if n == 0:
        raise ValueError(f"run {run.label}: no readings")
    for name, shape in shapes.items():
        column = getattr(run, name)
        if column.shape != shape:
            raise ValueError(f"run {run.label}: {name} has shape {column.shape}, expected {shape}")
        bad = np.flatnonzero(~np.isfinite(column).reshape(n, -1).all(axis=1))
        if bad.size:
            raise ValueError(f"run {run.label}: {name} is not a finite number in {bad.size} of {n} readings, first in reading {bad[0] + 1}")
    if not (run.weight_n > 0).all():
        raise ValueError(f"run {run.label}: every weight_n must be above 0")


def _check_bar(run: RunData) -> None:
    """Check cup and bar length, and that no position lies at the cup's centre."""
    if run.centre_mm is None or run.radius_mm is None:
        raise ValueError(f"run {run.label}: a ball-bar run needs centre_mm and radius_mm")
    if run.centre_mm.shape != (3,) or not np.isfinite(run.centre_mm).all():
        raise ValueError(f"run {run.label}: centre_mm must be three finite numbers")
    if not (np.isfinite(run.radius_mm) and run.radius_mm > 0):
        raise ValueError(f"run {run.label}: radius_mm must be above 0, it is {run.radius_mm:g}")
    at = np.flatnonzero(np.linalg.norm(run.axes_mm - run.centre_mm, axis=1) < LEAST_BAR_MM)
    if at.size:
        raise ValueError(f"run {run.label}: reading {at[0] + 1} is on the cup's centre, where the bar has no direction")


def _check_beam(run: RunData) -> None:
    if run.beam is None or run.beam.shape != (3,) or not abs(np.linalg.norm(run.beam) - 1.0) < 1e-6:
        raise ValueError(f"run {run.label}: a laser run needs its nominal beam, a unit vector")


def block_average(run: RunData, blocks: int) -> RunData:
    """Average the run to about ``blocks`` values, each the mean of up to ceil(n / blocks) consecutive readings moving in one direction.

    Blocks never span a reversal, where averaging would hide lost motion; every reversal may add one value to ``blocks``. The averaged value
    is the reading minus the reading of a perfect machine (`nominal_reading`), because the mean of points on a sphere is inside the sphere.
    A run of at most ``blocks`` readings is returned unchanged.

    The mean leaves out a reading that is farther from its block's median than `REJECT_SIGMA` times the largest of three standard
    deviations: the noise of the whole run (second differences), the block's own spread (median absolute deviation; so a steady change
    within a block stays), and `LEAST_SPREAD_MM`. ``rejected`` counts the readings left out, ``weight_n`` those averaged. A block of one or
    two readings keeps them, because it does not show which of them is wrong.
    """
    n = run.deviation_mm.size
    size = max(1, int(np.ceil(n / blocks)))
    if size == 1:
        return run
    turn = np.concatenate([[0], (np.diff(run.sign, axis=0) != 0).any(axis=1).cumsum()])
    key = np.concatenate([[0], ((np.diff(turn) != 0) | (np.arange(1, n) % size == 0)).cumsum()])
    above = run.deviation_mm - nominal_reading(run)
    share = np.where(_belongs(above, key), run.weight_n, 0.0)
    weight: F1 = np.bincount(key, share).astype(np.float64)

    def mean(v: F1) -> F1:
        return np.asarray(np.bincount(key, v * share) / weight)

    def columns(m: F2) -> F2:
        return np.column_stack([mean(m[:, k]) for k in range(m.shape[1])])

    shorter = replace(
        run,
        axes_mm=columns(run.axes_mm),
        deviation_mm=mean(above),
        sign=np.sign(columns(run.sign)),
        t_s=mean(run.t_s),
        weight_n=weight,
        rejected=run.rejected + int((share == 0.0).sum()),
    )
    return replace(shorter, deviation_mm=shorter.deviation_mm + nominal_reading(shorter))


def reading_noise_mm(values_mm: F1) -> float:
    """Standard deviation of one reading of a run, mm, from second differences of neighbours (robust; smooth motion cancels)."""
    second = values_mm[2:] - 2 * values_mm[1:-1] + values_mm[:-2]
    if second.size == 0:
        return 0.0
    return float(np.median(np.abs(second - np.median(second))) * 1.4826 / np.sqrt(6.0))


def _belongs(values_mm: F1, key: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Mask of the readings that are not outliers of their block; ``key``: block number of each reading, never decreasing."""
    away = np.abs(values_mm - _block_median(values_mm, key)[key])
    spread = np.maximum(1.4826 * _block_median(away, key), max(reading_noise_mm(values_mm), LEAST_SPREAD_MM))
    return np.asarray(away <= REJECT_SIGMA * spread[key])


def _block_median(values: F1, key: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> F1:
    """Median of each block, shape (blocks,)."""
    ordered = values[np.lexsort((values, key))]
    count = np.bincount(key)
    first = np.cumsum(count) - count
    return np.asarray(0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2]))


def nominal_reading(run: RunData) -> F1:
    """Reading (mm) of a perfect machine and set-up: for the ball-bar, distance to the cup minus radius; for the laser, zero."""
    if run.centre_mm is None or run.radius_mm is None:
        return np.zeros(run.deviation_mm.size)
    return np.asarray(np.linalg.norm(run.axes_mm - run.centre_mm, axis=1) - run.radius_mm)


def bar_normals(run: RunData) -> F2:
    """Unit vectors from the nominal cup to the commanded positions, shape (n, 3)."""
    assert run.centre_mm is not None
    d = run.axes_mm - run.centre_mm
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))
