"""What the page of a solution says, as plain values. Lengths in µm, positions in mm; every ``u`` is a standard uncertainty (k = 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.model import Contribution, ParameterRow, ResidualSeries, RunRow

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MotionCurve:
    """One error motion over its stroke. ``value`` and ``u`` in ``unit`` (µm or µrad); ``status``: whether these runs show it by itself."""

    name: str
    axis: str
    position_mm: Array
    value: Array
    u: Array
    unit: str
    status: str


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """Values over one plane of the volume: ``values`` in µm, shape (len(y), len(x)); ``at`` says where the plane is."""

    x_axis: str
    y_axis: str
    at: str
    x_mm: Array
    y_mm: Array
    values: Array


@dataclass(frozen=True, slots=True)
class MotionShare:
    """One error motion: share of what is known of it that comes from the readings, 0 to 1, and its status in words."""

    name: str
    share: float
    status: str


@dataclass(frozen=True, slots=True, eq=False)
class Correlations:
    """Correlation matrix of some parameters, shape (n, n)."""

    names: Sequence[str]
    matrix: Array


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """One source of uncertainty over the volume: rms of its standard uncertainty, and its share of the variance."""

    words: str
    u_um: float
    share: float


@dataclass(frozen=True, slots=True)
class TableLine:
    """What a kind of table leaves of the errors of distances: value and standard uncertainty, µm."""

    kind: str
    entries: int
    rms_um: tuple[float, float]
    q95_um: tuple[float, float]
    max_um: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SolutionPage:
    """All that the page says.

    ``gains``: noise gain in µm per µm, as slices; ``verdict``: sign ("ok", "open", "bad"), word and text; ``facts`` and ``provenance``:
    name and value; ``left_out``: motions not drawn in the ranking, because these runs do not show them by themselves; the other
    texts are lines.
    """

    title: str
    facts: Mapping[str, str]
    verdict: tuple[str, str, str]
    flags: Sequence[str]
    parameters: Sequence[ParameterRow]
    setup: Sequence[ParameterRow]
    motions: Sequence[MotionCurve]
    contributions: Sequence[Contribution]
    slices: Sequence[Slice]
    shares: Sequence[MotionShare]
    gains: Sequence[Slice]
    worst: str
    budget: Sequence[BudgetRow]
    correlations: Correlations
    residuals: Sequence[ResidualSeries]
    runs: Sequence[RunRow]
    noise: Sequence[str]
    outliers: Sequence[str]
    tests: Sequence[str]
    not_observable: Sequence[str]
    advice: Sequence[str]
    provenance: Mapping[str, str]
    layout: str = ""
    left_out: Sequence[str] = ()
    tables: Sequence[TableLine] = ()
    check: str = ""
    lang: str = "en"
