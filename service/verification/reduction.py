"""Reduction of a test of an axis or a diagonal to 20 °C: temperature and coefficients from sensors and machine file, or why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.iso230_2 import Approaches, ScaleBudget
from abbe.models.evaluation.reduction import DiagonalExpansion, Expansion, Strain, reduced
from abbe.models.machine import AXES
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.service.config_schema import COLDEST_C, WARMEST_C
from abbe.service.domain.machine import AxisMaterial
from abbe.service.domain.run import Run
from abbe.service.rendering.numbers import plain, tidy, with_uncertainty

PER_UM = 1e6
AIR_APART_K = 2.0
"""Largest difference between air and scale, K, that needs no remark in the report."""
AT_20, DIAGONAL_AT_20 = "ISO 230-2 at 20 °C", "ISO 230-6 at 20 °C"
"""Prefix of the condition that states how a test was reduced."""
REDUCTION_STATEMENT = (
    "Reduction to 20 °C (ISO 230-2 and 230-6, nominal differential expansion): deviation as measured - (scale - laser) (t - 20 °C) "
    "travel, where the laser's coefficient is the one set in its own compensation of material, 0 if that is off; on a diagonal each axis "
    "counts with the square of its share of the direction. U of the figures as measured includes the uncertainty of t, and of "
    "the laser's own sensor if its compensation is on; U of the reduced figures also includes the uncertainty of the scale's coefficient "
    "(ISO/TR 16015). Each figure is evaluated again with the deviations tilted by plus and minus this uncertainty. The reduced figures "
    "are the result by the standard. Figures of a workpiece use its coefficient instead of the scale's: they are the deviations at 20 °C "
    "of parts made at the temperature of the scales."
)
UNKNOWN = "unknown: no temperature of the scales is on record or stated"


@dataclass(frozen=True, slots=True)
class ScaleTemperature:
    """Temperature of a scale, °C, with its standard uncertainty, K, and its origin as text."""

    value_c: float
    u_k: float
    origin: str

    @property
    def text(self) -> str:
        """The temperature as text, with U (k = 2)."""
        return f"{_pm(self.value_c, self.u_k)} °C"


@dataclass(frozen=True, slots=True)
class Reduction:
    """Reduction of a test to 20 °C.

    ``expansion``: coefficient of the scales, None if the test is not reduced; ``workpiece``: coefficient of the workpieces, None if not
    stated; ``at``: temperature of the scales as text; ``of_workpiece``: coefficient as text; ``text``: the values used, or why the test
    is not reduced; ``notes``: remarks on its temperature.
    """

    expansion: Strain | None
    text: str
    notes: tuple[str, ...] = ()
    at: str = ""
    workpiece: Strain | None = None
    of_workpiece: str = ""


@dataclass(frozen=True, slots=True)
class Way:
    """One evaluation of a test: its name, the uncertainty that repeats do not show, and what is subtracted first."""

    text: str
    method: str
    budget: ScaleBudget
    taken_off: Strain | None = None

    def of(self, readings: Approaches) -> Approaches:
        """The readings of the test, evaluated this way."""
        return readings if self.taken_off is None else reduced(readings, self.taken_off)


def scale_temperature(runs: Sequence[Run], axis: str, material: AxisMaterial | None) -> ScaleTemperature | None:
    """Temperature of an axis' scale during a test: mean of its sensor if every run recorded it, or as the machine file states it.

    The recorded range is added to the stated uncertainty, as a rectangular distribution. None: neither is known, or the sensor was out of
    bounds.
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
    """Temperature of the scales at which the results of these runs hold, e.g. ``"X 24.00 ± 0.40 °C"``; `UNKNOWN` if none is known."""
    out = []
    for axis in AXES:
        at, bad = scale_temperature(runs, axis, materials.get(axis)), _out_of_bounds(runs, axis)
        if at is not None or bad:
            out.append(f"{axis} unknown ({bad})" if at is None else f"{axis} {at.text} ({at.origin})")
    return ", ".join(out) or UNKNOWN


def _pm(value: float, u: float) -> str:
    return " ± ".join(with_uncertainty(value, u)) if u > 0.0 else tidy(value)


def _recorded(run: Run, column: str) -> F1:
    values = np.asarray(run.columns.further.get(column, ()), dtype=np.float64)
    return values[np.isfinite(values)]


def _column(axis: str) -> str:
    return f"temp_{axis.lower()}_C"


def _out_of_bounds(runs: Sequence[Run], axis: str) -> str:
    """Return a text about a recorded scale temperature outside `COLDEST_C` to `WARMEST_C`; empty if there is none."""
    for run in runs:
        values = _recorded(run, _column(axis))
        beyond = values[(values < COLDEST_C) | (values > WARMEST_C)]
        if beyond.size:
            return f"{_column(axis)} of run {run.run_id} has {beyond[0]:g}, outside of {COLDEST_C:g} to {WARMEST_C:g} °C"
    return ""


def _notes(runs: Sequence[Run], axis: str, at: ScaleTemperature | None, material: AxisMaterial | None) -> tuple[str, ...]:
    """Remarks on a temperature that is not from the sensors: only some runs have a sensor, or the air differs much."""
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
        By axis, from the machine file; empty without a machine file.
    """
    material = materials.get(axis)
    bad = _out_of_bounds(runs, axis)
    if bad:
        return Reduction(None, f"not reduced to 20 °C: {bad}")
    at = scale_temperature(runs, axis, material)
    notes = _notes(runs, axis, at, material)
    if at is None:
        return Reduction(None, "not reduced to 20 °C: the temperature of the scales is neither recorded nor stated", notes)
    if material is None or material.scale_per_k is None or material.u_scale_per_k is None:
        holds = f"the figures hold at {at.text} ({at.origin})"
        return Reduction(None, f"not reduced to 20 °C: no expansion coefficient of the scale; {holds}", notes)
    expansion = Expansion(material.scale_per_k, material.u_scale_per_k, at.value_c, at.u_k, material.laser_per_k)
    laser = "off" if not expansion.laser_per_k else f"{plain(expansion.laser_per_k * PER_UM)} µm/m/K"
    text = (
        f"reduced from {at.text} ({at.origin}) with {_coefficient(expansion)} of the scale; the laser's compensation of material: {laser}"
    )
    found = Reduction(expansion, f"{text}. The reduced figures are the result", notes, at.text)
    if material.workpiece_per_k is None or material.u_workpiece_per_k is None:
        return found
    workpiece = replace(expansion, scale_per_k=material.workpiece_per_k, u_scale_per_k=material.u_workpiece_per_k)
    return replace(found, workpiece=workpiece, of_workpiece=_coefficient(workpiece))


def diagonal_reduction_of(runs: Sequence[Run], materials: Mapping[str, AxisMaterial]) -> Reduction:
    """Decide whether and how the test along a diagonal in these runs is reduced: as its axes are, or not at all."""
    way = runs[0].laser.span_mm
    shares = {axis: float(share) for axis, share in zip(AXES, way**2 / (way @ way), strict=True) if share > 0.0}
    each = {axis: reduction_of(runs, axis, materials) for axis in shares}
    notes = tuple(dict.fromkeys(note for one in each.values() for note in one.notes))
    why = [f"{axis}: {one.text}" for axis, one in each.items() if one.expansion is None]
    if why:
        return Reduction(None, f"not reduced to 20 °C: {why[0].replace(': not reduced to 20 °C', '')}", notes)
    at = ", ".join(f"{axis} {one.at}" for axis, one in each.items())
    text = "; ".join(f"{axis} {one.text}" for axis, one in each.items())
    of_axes = [one.workpiece for one in each.values()]
    return Reduction(
        _combined([one.expansion for one in each.values()], shares),
        text,
        notes,
        at,
        None if None in of_axes else _combined(of_axes, shares),
        next(iter(each.values())).of_workpiece,
    )


def _combined(axes: Sequence[Strain | None], shares: Mapping[str, float]) -> DiagonalExpansion:
    return DiagonalExpansion(tuple(one for one in axes if isinstance(one, Expansion)), tuple(shares.values()))


def _coefficient(expansion: Expansion) -> str:
    return f"{_pm(expansion.scale_per_k * PER_UM, expansion.u_scale_per_k * PER_UM)} µm/m/K"


def ways(budget: ScaleBudget, reduction: Reduction, standard: str, u_wavelength: float) -> list[Way]:
    """The evaluations of a test, the result first: at 20 °C, as measured, and for the workpieces; without a reduction only as measured.

    ``budget``: budget of a test that is not reduced; ``u_wavelength``: relative standard uncertainty of the laser's wavelength.
    """
    if reduction.expansion is None:
        return [Way(f", {standard}", standard, budget)]

    def sure(u: float) -> ScaleBudget:
        return ScaleBudget(float(np.hypot(u_wavelength, u)), budget.reading_mm)

    one, part = reduction.expansion, reduction.workpiece
    found = [
        Way(f" at 20 °C, {standard}", f"{standard}, at 20 °C", sure(one.u_reduced), one),
        Way(f" as measured at {reduction.at}", f"{standard}, as measured", sure(one.u_as_measured)),
    ]
    if part is not None:
        text = f" at 20 °C of a workpiece with {reduction.of_workpiece}"
        found.append(Way(text, f"{standard}, of a workpiece at 20 °C", sure(part.u_reduced), part))
    return found


def laser_inputs(instruments: dict[str, Any]) -> StatedInputs:
    """Stated inputs of a laser: the defaults, or larger uncertainties that the campaign file states."""
    laser, usual = instruments.get("laser") or {}, StatedInputs()
    wave, kelvin = laser.get("u_wavelength", usual.u_wavelength), laser.get("u_scale_temperature_k", usual.u_scale_temperature_k)
    return replace(usual, u_wavelength=float(wave), u_scale_temperature_k=float(kelvin))
