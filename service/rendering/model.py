"""What a report says, as plain values. Lengths in µm, positions in mm; every ``u`` is a standard uncertainty (k = 1) in the row's unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = Sequence[float] | NDArray[np.float64]
Source = Literal["measured", "sealed truth of the simulator"]

SETUP_NOTE = "set-up"
"""Note of a parameter that belongs to the set-up (cup, bar, mirror) and not to the machine: the report folds these away."""


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """One figure before and after the correction. ``factor``: how many times smaller it became."""

    name: str
    unit: str
    before: float | None
    after: float | None
    factor: float | None = None
    u_before: float | None = None
    u_after: float | None = None
    source: Source = "measured"


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One identified parameter. ``note``: a word about it; ``SETUP_NOTE`` for those of the set-up."""

    name: str
    value: float | None
    u: float | None
    unit: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class RunRow:
    """One measured run: what it was for, how well the model explains it, how noisy the reading itself is."""

    label: str
    test: str
    role: str
    points: int
    residual_rms_um: float | None
    noise_um: float | None
    outliers: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSeries:
    """Measured minus modelled along one run; ``x_label`` names the abscissa with its unit. ``label`` as in the run's row."""

    label: str
    x_label: str
    x: Floats
    residual_um: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TableCurve:
    """One of the nine one-axis tables: correction of output ``axis_out`` against the position of ``axis_in``."""

    axis_in: str
    axis_out: str
    position_mm: Floats
    correction_um: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ArrowField:
    """Deviation vectors over the volume, rigid motion removed. Both arrays have the shape (n, 3)."""

    grid_mm: NDArray[np.float64]
    deviation_um: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PolarTrace:
    """Radial deviation around a circle or helix."""

    label: str
    angle_deg: Floats
    deviation_um: Floats


@dataclass(frozen=True, slots=True)
class Contribution:
    """Share of one error source in the whole, e.g. its part of the volumetric error."""

    name: str
    value_um: float | None
    u_um: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DemoReport:
    """All that the report of one measure-correct-verify cycle says.

    ``accepted`` decides only the sign before the verdict: True, False, or None for "undecided".
    """

    title: str
    machine: Mapping[str, object]
    created_utc: str
    seed: int | None
    versions: Mapping[str, str]
    verdict: str
    accepted: bool | None = None
    summary: Sequence[SummaryRow] = ()
    parameters: Sequence[ParameterRow] = ()
    not_observable: Sequence[str] = ()
    runs: Sequence[RunRow] = ()
    residuals: Sequence[ResidualSeries] = ()
    tables: Sequence[TableCurve] = ()
    table_lsb_um: float | None = None
    arrows_before: ArrowField | None = None
    arrows_after: ArrowField | None = None
    diagonals_before: Mapping[str, tuple[Floats, Floats]] = field(default_factory=dict)
    diagonals_after: Mapping[str, tuple[Floats, Floats]] = field(default_factory=dict)
    polar: Sequence[PolarTrace] = ()
    contributions: Sequence[Contribution] = ()
    push_log: Sequence[str] = ()
    warnings: Sequence[str] = ()
    lang: str = "en"
