"""Data of the pictures of a report. Lengths in µm, positions in mm; every ``u`` is a standard uncertainty (k = 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = Sequence[float] | NDArray[np.float64]

SETUP_NOTE = "set-up"
"""Note of a parameter that belongs to the set-up (cup, bar, mirror), not to the machine; the report collapses these."""


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One identified parameter. ``note``: a remark; ``SETUP_NOTE`` for parameters of the set-up."""

    name: str
    value: float | None
    u: float | None
    unit: str
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSeries:
    """Measured minus modelled along one run. ``x_label``: name and unit of the abscissa; ``label``: as in the table of runs."""

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
    """Contribution of one error source, e.g. to the volumetric error."""

    name: str
    value_um: float | None
    u_um: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MotionCurve:
    """One error motion over its stroke. ``value`` and ``u`` in ``unit`` (µm or µrad); ``status``: its observability."""

    name: str
    axis: str
    position_mm: NDArray[np.float64]
    value: NDArray[np.float64]
    u: NDArray[np.float64]
    unit: str
    status: str


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """Values over one plane of the volume: ``values`` in µm, shape (len(y), len(x)); ``at``: position of the plane as text."""

    x_axis: str
    y_axis: str
    at: str
    x_mm: NDArray[np.float64]
    y_mm: NDArray[np.float64]
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionShare:
    """One error motion: share of its information that comes from the readings, 0 to 1, and its observability."""

    name: str
    share: float
    status: str


@dataclass(frozen=True, slots=True, eq=False)
class Correlations:
    """Correlation matrix of some parameters, shape (n, n)."""

    names: Sequence[str]
    matrix: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTrace:
    """Measured minus simulated along one run, before and after the found effects are added to the simulation; arrays of shape (n,).

    ``why``: reason for showing this run.
    """

    label: str
    x_label: str
    x: NDArray[np.float64]
    before_um: NDArray[np.float64]
    after_um: NDArray[np.float64]
    noise_um: float
    why: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMap:
    """Size of the gap (measured minus simulated) over one plane of the volume.

    ``x_mm``, ``y_mm``: centres of measured cells, shape (n,); ``times_noise``: rms of the gap divided by the noise; ``spot``: centre and
    radius of the located area, mm.
    """

    x_axis: str
    y_axis: str
    x_mm: NDArray[np.float64]
    y_mm: NDArray[np.float64]
    times_noise: NDArray[np.float64]
    spot: tuple[float, float, float] | None = None
