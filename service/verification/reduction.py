"""From which temperature an axis test is reduced to 20 °C, by the runs' sensors and the machine file, or why it is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.iso230_2 import ScaleBudget
from abbe.models.evaluation.reduction import Expansion
from abbe.models.machine import AXES
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.service.config_schema import COLDEST_C, WARMEST_C
from abbe.service.domain.material import AxisMaterial
from abbe.service.domain.run import Run
from abbe.service.rendering.numbers import plain, tidy, with_uncertainty

PER_UM = 1e6
AIR_APART_K = 2.0
"""By how much air and scale may differ before the report says so."""
AT_20 = "ISO 230-2 at 20 °C"
"""Begins the name of the condition that tells how a test was reduced."""
REDUCTION_STATEMENT = (
    "Reduction to 20 °C (ISO 230-2, nominal differential expansion): deviation as measured - (scale - laser) (t - 20 °C) travel, where the "
    "laser's coefficient is that of its own compensation of material, 0 if it is off. U of the figures as measured includes the "
    "uncertainty of t, and the same of the laser's own sensor if its compensation is on; U of the reduced ones also that of the scale's "
    "coefficient (ISO/TR 16015). Each figure is evaluated again with the deviations tilted by plus and minus this uncertainty. The reduced "
    "figures are the result by the standard."
)


@dataclass(frozen=True, slots=True)
class ScaleTemperature:
    """Temperature of a scale, °C, with its standard uncertainty, K, and its origin as text."""

    value_c: float
    u_k: float
    origin: str

    @property
    def text(self) -> str:
        """For a reader, with U (k = 2)."""
        return f"{_pm(self.value_c, self.u_k)} °C"


@dataclass(frozen=True, slots=True)
class Reduction:
    """How a test is reduced. ``expansion``: None if it is not; ``text``: what was used, or why it is not reduced; ``notes``: on its t."""

    temperature: ScaleTemperature | None
    expansion: Expansion | None
    text: str
    notes: tuple[str, ...] = ()


def scale_temperature(runs: Sequence[Run], axis: str, material: AxisMaterial | None) -> ScaleTemperature | None:
    """Temperature of an axis' scale during a test: mean of its sensor if every run recorded it, else the stated one, else None.

    The recorded range counts as a rectangular distribution on top of the stated uncertainty. None, too, if the sensor was out of bounds.
    """
    if _out_of_bounds(runs, axis):
        return None
    u_k = StatedInputs().u_scale_temperature_k if material is None else material.u_temperature_k
    read = [_recorded(run, _column(axis)) for run in runs]
    if read and all(values.size for values in read):
        every = np.concatenate(read)
        return ScaleTemperature(float(every.mean()), float(np.hypot(u_k, np.ptp(every) / np.sqrt(12.0))), "recorded in the runs")
    if material is None or material.temperature_c is None:
        return None
    return ScaleTemperature(material.temperature_c, u_k, "stated in the machine file")


def holds_at(runs: Sequence[Run], materials: Mapping[str, AxisMaterial]) -> str:
    """At which temperature of the scales what these runs showed holds, e.g. ``"X 24.00 ± 0.40 °C"``; empty if none is known."""
    out = []
    for axis in AXES:
        at, bad = scale_temperature(runs, axis, materials.get(axis)), _out_of_bounds(runs, axis)
        if at is not None or bad:
            out.append(f"{axis} unknown ({bad})" if at is None else f"{axis} {at.text} ({at.origin})")
    return ", ".join(out)


def _pm(value: float, u: float) -> str:
    return " ± ".join(with_uncertainty(value, u)) if u > 0.0 else tidy(value)


def _recorded(run: Run, column: str) -> F1:
    values = np.asarray(run.columns.further.get(column, ()), dtype=np.float64)
    return values[np.isfinite(values)]


def _column(axis: str) -> str:
    return f"temp_{axis.lower()}_C"


def _out_of_bounds(runs: Sequence[Run], axis: str) -> str:
    """Which recorded temperature of an axis' scale is beyond the bounds of a stated one; empty if none is."""
    for run in runs:
        values = _recorded(run, _column(axis))
        beyond = values[(values < COLDEST_C) | (values > WARMEST_C)]
        if beyond.size:
            return f"{_column(axis)} of run {run.run_id} has {beyond[0]:g}, outside of {COLDEST_C:g} to {WARMEST_C:g} °C"
    return ""


def _notes(runs: Sequence[Run], axis: str, at: ScaleTemperature | None, material: AxisMaterial | None) -> tuple[str, ...]:
    """What a reader must know of a temperature that is not the sensors': sensors of some runs only, air that is far from it."""
    out = []
    having = sum(1 for run in runs if _recorded(run, _column(axis)).size)
    if 0 < having < len(runs):
        instead = "it is not used" if at is None else "the stated temperature is used"
        out.append(f"only {having} of {len(runs)} runs recorded {_column(axis)}; {instead}")
    stated = None if material is None or having == len(runs) else material.temperature_c
    air = [float(values.mean()) for run in runs if (values := _recorded(run, "temp_air_C")).size]
    if at is not None and stated is not None and air:
        furthest = max(air, key=lambda value: abs(value - stated))
        if abs(furthest - stated) > AIR_APART_K:
            out.append(
                f"the air on record was at {furthest:.2f} °C, the scale is stated at {stated:.2f} °C: more than {AIR_APART_K:g} K apart"
            )
    return tuple(out)


def reduction_of(runs: Sequence[Run], axis: str, materials: Mapping[str, AxisMaterial]) -> Reduction:
    """Decide whether and how the test of ``axis`` in these runs is reduced.

    Parameters
    ----------
    runs : sequence of Run
        The runs of the test.
    axis : str
        X, Y or Z.
    materials : mapping
        By axis, from the machine file; empty without one.
    """
    material = materials.get(axis)
    bad = _out_of_bounds(runs, axis)
    if bad:
        return Reduction(None, None, f"not reduced to 20 °C: {bad}")
    at = scale_temperature(runs, axis, material)
    notes = _notes(runs, axis, at, material)
    holds = "" if at is None else f"; the figures hold at {at.text} ({at.origin})"
    if at is None:
        return Reduction(None, None, "not reduced to 20 °C: no material temperature", notes)
    if material is None or material.scale_per_k is None or material.u_scale_per_k is None:
        return Reduction(at, None, f"not reduced to 20 °C: no expansion coefficient of the scale{holds}", notes)
    expansion = Expansion(material.scale_per_k, material.u_scale_per_k, at.value_c, at.u_k, material.laser_per_k)
    scale = _pm(expansion.scale_per_k * PER_UM, expansion.u_scale_per_k * PER_UM)
    laser = "off" if not expansion.laser_per_k else f"{plain(expansion.laser_per_k * PER_UM)} µm/m/K"
    text = f"reduced from {at.text} ({at.origin}) with {scale} µm/m/K of the scale; the laser's compensation of material: {laser}"
    return Reduction(at, expansion, f"{text}. The reduced figures are the result", notes)


def budgets(budget: ScaleBudget, expansion: Expansion, u_wavelength: float) -> tuple[ScaleBudget, ScaleBudget]:
    """Uncertainty that repeats do not show: of the figures as measured, and of the reduced ones; ``u_wavelength``: relative."""
    one, other = (float(np.hypot(u_wavelength, u)) for u in (expansion.u_as_measured, expansion.u_reduced))
    return ScaleBudget(0.0, budget.reading_mm, one), ScaleBudget(0.0, budget.reading_mm, other)
