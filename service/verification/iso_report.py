"""ISO 230-2, 230-4 and 230-6 evaluations of runs as figures and pictures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np

from abbe.models.evaluation.iso230_2 import Positioning, ScaleBudget, Value, positioning
from abbe.models.evaluation.iso230_4 import OnePath, both_ways, centred, circular
from abbe.models.evaluation.iso230_6 import BODY, FACE, Diagonals, diagonals
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.verification import U_REPEAT_MM
from abbe.service.domain.machine import AxisMaterial
from abbe.service.domain.run import Run
from abbe.service.rendering.document import PictureBlock, ReportFigure, Section, TextTable
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.numbers import plain, tidy
from abbe.service.rendering.plots.curves import PositioningCurves, positioning_plot
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.runs.coverage import not_judged
from abbe.service.verification.far_readings import far_readings
from abbe.service.verification.iso_readings import AxisTest, CircleTest, circle_tests, diagonal_tests, linear_tests
from abbe.service.verification.reduction import (
    AT_20,
    DIAGONAL_AT_20,
    REDUCTION_STATEMENT,
    Reduction,
    Way,
    diagonal_reduction_of,
    laser_inputs,
    reduction_of,
    ways,
)

UM = 1e3
POLAR_POINTS = 720
LASER_STATEMENT = (
    "U of ISO 230-2 and 230-6 figures includes the scatter of the cycles, as far as repeats show it, the wavelength ({wave:.2g} µm/m), the "
    "temperature of the scales ({kelvin:.2g} K at {expansion:g} µm/m/K, or as stated for a reduced test) and the resolution, propagated "
    "through the figure's own formula (idea of ISO/TR 230-9). Deviations are as measured, except in groups that say at 20 °C. Where there "
    "is one cycle, the scatter is the scatter of the reversals about their mean."
)
BAR_STATEMENT = (
    "U of ISO 230-4 figures includes the noise of a reading, {repeat:g} µm for remounting the bar (an assumption) and, for F alone, "
    "the length of the bar. G takes extremes of single readings: noise makes it larger, never smaller."
)


@dataclass
class Evaluated:
    """Results of evaluated runs for a report.

    ``targets``: deviations at each position of a test; ``statements`` are part of the uncertainty statement; ``conditions`` state for each
    test how it was reduced to 20 °C.
    """

    figures: list[ReportFigure] = field(default_factory=list)
    pictures: list[PictureBlock] = field(default_factory=list)
    targets: list[Section] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    not_observable: list[str] = field(default_factory=list)
    statements: list[str] = field(default_factory=list)
    conditions: dict[str, str] = field(default_factory=dict)

    def add(self, other: Evaluated) -> None:
        """Append the results of ``other``."""
        for one in ("figures", "pictures", "targets", "remarks", "not_observable", "statements"):
            getattr(self, one).extend(getattr(other, one))
        self.conditions.update(other.conditions)


def evaluate(
    runs: Sequence[Run], instruments: dict[str, Any] | None = None, materials: Mapping[str, AxisMaterial] | None = None
) -> Evaluated:
    """Evaluate every run that is a test of ISO 230-2, 230-4 or 230-6.

    Parameters
    ----------
    runs : sequence of Run
        As measured.
    instruments : dict, optional
        ``instruments`` of the campaign file, for their resolutions.
    materials : mapping, optional
        Expansion of the scales by axis, from the machine file; without it nothing is reduced to 20 °C.
    """
    out = Evaluated()
    known = laser_inputs(instruments or {})
    budget = scale_budget(instruments or {})
    refused = [f"run {run.run_id}: {why}" for run in runs if (why := not_judged(run))]
    runs = [run for run in runs if not not_judged(run)]
    linear, along, circles = linear_tests(runs, refused), diagonal_tests(runs, refused), circle_tests(runs, refused)
    out.remarks += far_readings(runs)
    out.not_observable += [f"figures by ISO 230 of {line}" for line in refused]
    for test in linear:
        its_runs = [run for run in runs if run.run_id in test.runs]
        _axis(out, test, (budget, known), reduction_of(its_runs, test.name, materials or {}))
    for plane, tests in along.items():
        found = {t.name: diagonal_reduction_of([run for run in runs if run.run_id in t.runs], materials or {}) for t in tests}
        _diagonals(out, plane, tests, (budget, known), found)
    if linear or along:
        numbers = {"wave": known.u_wavelength * 1e6, "kelvin": known.u_scale_temperature_k, "expansion": known.scale_expansion_per_k * 1e6}
        out.statements.append(LASER_STATEMENT.format(**numbers))
    if circles:
        _circles(out, circles)
        out.statements.append(BAR_STATEMENT.format(repeat=U_REPEAT_MM * UM))
    return out


def scale_budget(instruments: dict[str, Any]) -> ScaleBudget:
    """Uncertainty that repeats do not show, from the budget's stated inputs and the instrument's resolution."""
    known = laser_inputs(instruments)
    scale = float(np.hypot(known.u_wavelength, known.u_scale_temperature_k * known.scale_expansion_per_k))
    return ScaleBudget(scale, float((instruments.get("laser") or {}).get("resolution_mm", 0.0)) / np.sqrt(12.0))


def _axis(out: Evaluated, test: AxisTest, budget: tuple[ScaleBudget, StatedInputs], reduction: Reduction) -> None:
    found = _axis_ways(out, test, budget, reduction)
    runs = ", ".join(test.runs)
    if found.lowest != found.most:
        out.remarks.append(f"axis {test.name} ({runs}): positions have {found.lowest} to {found.most} approaches from one side")
    out.remarks += [f"axis {test.name} ({runs}): {note}" for note in (*found.departures(), *test.notes, *reduction.notes)]
    if found.R is None:
        out.not_observable.append(f"repeatability and accuracy of axis {test.name}: every position was approached once from each side")


def _axis_ways(out: Evaluated, test: AxisTest, stated: tuple[ScaleBudget, StatedInputs], reduction: Reduction) -> Positioning:
    """Add the figures of every way to evaluate a test; return the figures of the first way."""
    budget, known = stated
    label = f"{test.name} {test.setup}"
    _tell(out, f"{AT_20}, axis {label}", reduction)
    if reduction.expansion is None:
        out.remarks.append(f"axis {test.name} ({', '.join(test.runs)}): {reduction.text}")
    found = []
    for way in ways(budget, reduction, "ISO 230-2", known.u_wavelength):
        one = positioning(way.of(test.readings), way.budget)
        group = f"Axis {test.name}, set-up {test.setup}: positioning{way.text}"
        out.figures += [_figure(group, *row, way.method) for row in positioning_rows(one)]
        out.pictures.append(_positioning(f"{label}{_short(way)}", f"position of {test.name} in mm", one))
        out.targets.append(Section(f"Deviation at each position: {label}{_short(way)}", [_target_table(one)]))
        found.append(one)
    return found[0]


def _tell(out: Evaluated, test: str, reduction: Reduction) -> None:
    out.conditions[test] = reduction.text
    if reduction.expansion is not None and REDUCTION_STATEMENT not in out.statements:
        out.statements.append(REDUCTION_STATEMENT)


def _short(way: Way) -> str:
    """Return the name of a way in a picture's title; empty for a test that is not reduced."""
    return way.method.partition(", ")[2] and f" {way.method.partition(', ')[2]}"


def positioning_rows(p: Positioning) -> list[tuple[str, str, Value | None]]:
    """Symbol, name and value of every figure of a test in both directions."""
    return [
        ("A", "accuracy of positioning, both directions", p.A),
        ("A+", "accuracy of positioning, moving in +", p.A_forward),
        ("A-", "accuracy of positioning, moving in -", p.A_backward),
        ("E", "systematic deviation, both directions", p.E),
        ("E+", "systematic deviation, moving in +", p.E_forward),
        ("E-", "systematic deviation, moving in -", p.E_backward),
        ("M", "range of the mean bidirectional deviations", p.M),
        ("B", "reversal, largest", p.B),
        ("B mean", "reversal, mean over the positions (signed)", p.B_mean),
        ("R", "repeatability, both directions", p.R),
        ("R+", "repeatability, moving in +", p.R_forward),
        ("R-", "repeatability, moving in -", p.R_backward),
    ]


def _figure(group: str, symbol: str, name: str, value: Value | None, method: str) -> ReportFigure:
    if value is None:
        return ReportFigure(group, symbol, name, None, None, "µm", method)
    return ReportFigure(group, symbol, name, value.value_mm * UM, value.u_mm * UM, "µm", method)


def _target_table(p: Positioning) -> TextTable:
    """Mean deviations of both directions, their mean, reversal and standard deviations at each position, as ISO 230-2 lists them."""
    head: tuple[str, ...] = ("Position, mm", "Mean +, µm", "Mean -, µm", "Mean, µm", "Reversal B, µm")
    columns = [p.mean_forward_mm, p.mean_backward_mm, p.mean_mm, p.reversal_mm]
    if p.s_forward_mm is not None and p.s_backward_mm is not None:
        head = (*head, "s +, µm", "s -, µm")
        columns += [p.s_forward_mm, p.s_backward_mm]
    places = (tidy(float(one)) for one in p.position_mm)
    return TextTable(head, [[place, *(plain(float(one) * UM) for one in row)] for place, *row in zip(places, *columns, strict=True)])


def _positioning(label: str, x_label: str, p: Positioning) -> PictureBlock:
    s = [None if v is None else v * UM for v in (p.s_forward_mm, p.s_backward_mm)]
    curves = PositioningCurves(label, x_label, p.position_mm, p.mean_forward_mm * UM, p.mean_backward_mm * UM, *s)
    text = ", ".join(f"{n} {plain(v.value_mm * UM)} µm" for n, v in (("E", p.E), ("B", p.B), ("R", p.R), ("A", p.A)) if v is not None)
    bars = "; bars are two standard deviations to both sides" if p.s_forward_mm is not None else ""
    caption = f"{label}: mean deviation of both directions{bars}. {text}."
    return PictureBlock(caption, [positioning_plot(curves, key=f"positioning-{label}", figures=text)], "wide")


def _diagonals(
    out: Evaluated, plane: str, tests: list[AxisTest], stated: tuple[ScaleBudget, StatedInputs], reductions: Mapping[str, Reduction]
) -> None:
    """Add the figures of diagonals; ``reductions``: the reduction of each by its name. All of them are reduced, or none."""
    what = "Body diagonals" if plane == "body" else f"Face diagonals {plane}"
    for name, one in reductions.items():
        _tell(out, f"{DIAGONAL_AT_20}, diagonal {name}", one)
    unreduced = next((one for one in reductions.values() if one.expansion is None), None)
    if unreduced is not None:
        reductions = dict.fromkeys(reductions, unreduced)
        out.remarks.append(f"{what.lower()}: {unreduced.text}")
    budget, known = stated
    each = {name: ways(budget, one, "ISO 230-6", known.u_wavelength) for name, one in reductions.items()}
    names, found = [t.name for t in tests], []
    for same in zip(*(each[name] for name in names), strict=True):
        readings = {t.name: way.of(t.readings) for t, way in zip(tests, same, strict=True)}
        budgets = {name: way.budget for name, way in zip(names, same, strict=True)}
        found.append(diagonals(readings, BODY if plane == "body" else FACE, budgets))
        _diagonal_figures(out, f"{what}: displacement{same[0].text}", same[0], found[-1])
    result = found[0]
    if result.missing:
        out.not_observable.append(f"{what}: {', '.join(result.missing)} not measured, so the figures are lower bounds")
    first = next(iter(result.each.values()))
    notes = (note for one in reductions.values() for note in one.notes)
    out.remarks += [f"{what.lower()}: {note}" for note in dict.fromkeys((*first.departures(), *tests[0].notes, *notes))]


def _diagonal_figures(out: Evaluated, group: str, way: Way, found: Diagonals) -> None:
    rows = [
        ("E_d", "systematic deviation, both directions, of diagonal {}", found.E_d),
        ("M_d", "range of the mean bidirectional deviations, of diagonal {}", found.M_d),
        ("B_d", "reversal, of diagonal {}", found.B_d),
    ] + ([("R_d", "repeatability, of diagonal {}", found.R_d)] if found.R_d is not None else [])
    out.figures += [_figure(group, symbol, text.format(name), value, way.method) for symbol, text, (name, value) in rows]
    out.figures += [_figure(group, f"E {n}", f"systematic deviation of diagonal {n}", p.E, way.method) for n, p in found.each.items()]
    out.pictures += [_positioning(f"diagonal {n}{_short(way)}", "along the diagonal in mm", p) for n, p in found.each.items()]


def _circles(out: Evaluated, tests: list[CircleTest]) -> None:
    key = lambda t: (t.plane, t.setup, t.radius_mm)  # noqa: E731 - a key and its sort belong together
    for (plane, setup, radius), several in groupby(sorted(tests, key=key), key):
        same = list(several)
        group = f"Plane {plane}, radius {radius:g} mm, set-up {setup}: circles, ISO 230-4"
        for test in same:
            _circle(out, group, test)
        pair = [next((t for t in same if t.sense == s), None) for s in (1, -1)]
        if pair[0] is not None and pair[1] is not None:
            _pair(out, group, pair[0], pair[1])
        else:
            out.not_observable.append(f"G(b) and H of plane {plane}, set-up {setup}: the circle was driven in one sense only")
        traces = [_trace(t) for t in same]
        caption = f"Plane {plane}, set-up {setup}: radial deviation about the least squares centre."
        out.pictures.append(PictureBlock(caption, [polar_plot(traces, key=f"polar-{plane}-{setup}", heading=f"Circle {plane}")]))


def _sense(test: CircleTest) -> str:
    """The path as ISO 230-4 writes it: the axis at the start first, XY from X to Y."""
    return test.plane if test.sense > 0 else test.plane[::-1]


def _circle(out: Evaluated, group: str, test: CircleTest) -> None:
    one = circular(test.path)
    u = _u(one)
    u_f = None if test.u_length_mm is None else float(np.hypot(u, test.u_length_mm))
    sub = _sense(test)
    rows: list[tuple[str, str, float, float | None]] = [
        (f"G_{sub}", f"circular deviation, run {test.run}", one.G_mm, np.sqrt(2.0) * u),
        (f"G_{sub} (zone)", f"circular deviation by the minimum zone, run {test.run}", one.G_zone_mm, np.sqrt(2.0) * u),
        (f"F_{sub},max", f"radial deviation about the set-up's centre, largest, run {test.run}", one.F_max_mm, u_f),
        (f"F_{sub},min", f"radial deviation about the set-up's centre, smallest, run {test.run}", one.F_min_mm, u_f),
        (f"F_{sub},max (LSC)", f"about the least squares centre, largest, run {test.run}", one.F_max_centred_mm, u_f),
        (f"F_{sub},min (LSC)", f"about the least squares centre, smallest, run {test.run}", one.F_min_centred_mm, u_f),
    ]
    out.figures += [ReportFigure(group, s, n, v * UM, None if w is None else float(w) * UM, "µm", "ISO 230-4") for s, n, v, w in rows]
    if not one.is_whole:
        out.remarks.append(
            f"circle {test.run}: an arc of {np.degrees(one.covered_rad):.0f}°, no whole circle: its centre is less well known"
        )
    if test.u_length_mm is None:
        out.not_observable.append(f"U of F of run {test.run}: the length of the bar has no certificate in the data")


def _pair(out: Evaluated, group: str, forward: CircleTest, backward: CircleTest) -> None:
    both = both_ways(forward.path, backward.path)
    u = float(np.sqrt(2.0) * max(_u(circular(t.path)) for t in (forward, backward)))
    runs = f"runs {forward.run} and {backward.run}"
    out.figures.append(
        ReportFigure(
            group, f"G(b)_{forward.plane}", f"bidirectional circular deviation, {runs}", both.G_b_mm * UM, u * UM, "µm", "ISO 230-4"
        )
    )
    name = f"circular hysteresis, at {np.degrees(both.at_rad):.0f}°, {runs}"
    out.figures.append(ReportFigure(group, f"H_{forward.plane}", name, both.H_mm * UM, u * UM, "µm", "ISO 230-4"))


def _u(one: OnePath) -> float:
    """Standard uncertainty of one reading of a circle's shape, from noise and repeatability, mm."""
    return float(np.hypot(one.noise_mm, U_REPEAT_MM))


def _trace(test: CircleTest) -> PolarTrace:
    y = centred(test.path) * UM
    step = max(1, y.size // POLAR_POINTS)
    return PolarTrace(f"{test.run} ({_sense(test)})", np.degrees(test.path.angle_rad)[::step], y[::step])
