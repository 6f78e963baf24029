"""A solution as sections of its campaign's report: parameters, error motions, uncertainty in the volume, residuals, runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.additive import SCALE_NOTE, mean_linear
from abbe.models.geometry.bases import Term, term_values
from abbe.models.machine import AXES
from abbe.models.solvers.joint import JointSolution
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.identification.solve_report import (
    HIDDEN_NOTE,
    Assessment,
    layout_line,
    noise_lines,
    outlier_lines,
    residual_lines,
    worst_line,
)
from abbe.service.rendering.document import Block, Lines, PictureBlock, Section, TextTable
from abbe.service.rendering.model import (
    SETUP_NOTE,
    Contribution,
    Correlations,
    MotionCurve,
    MotionShare,
    ParameterRow,
    ResidualSeries,
    Slice,
)
from abbe.service.rendering.plots.bars import share_plot
from abbe.service.rendering.plots.maps import cell_map, common_step, correlation_plot, gain_map
from abbe.service.rendering.plots.tables import motion_bands
from abbe.service.report.artefact_sections import artefact_sections
from abbe.service.report.blocks import U_OF, RunRow, parameter_pictures, parameter_table, residual_picture, run_table, setup_section, stated

CURVE_NODES = 61
SLICE_NODES = 15
MOST_CORRELATED = 14
PLANES = ((0, 1, 2), (0, 2, 1))
"""Axes across and up of each slice, and the axis that stands in the middle of its stroke."""


def solution_sections(found: Assessment, solution: SolutionFile) -> list[Section]:
    """Sections of a solution, printed before the figures of the report.

    ``found``: a new solution; ``solution``: its document, with tables and Monte Carlo if requested.
    """
    shares = [MotionShare(m.name, m.share, m.status) for m in found.observability.motions]
    return [
        *artefact_sections(found.joint),
        Section("Parameters", _parameters(found)),
        Section("Error motions", _motions(found)),
        Section("Information of these runs about each error motion", _observability(found, shares)),
        Section("Uncertainty in the volume", _volume(found)),
        *_tables(solution),
    ]


def residual_sections(found: Assessment) -> list[Section]:
    """Sections of the residuals of a solution, run by run."""
    return [Section("Residuals", _residuals(found)), Section("Runs of the solution", [run_table(solution_runs(found.joint))])]


def _parameters(found: Assessment) -> list[Block]:
    rows = solution_rows(found)
    hidden = {m.name for m in found.observability.motions if m.status == "not observable"}
    ranked = contributions(found.joint)
    out = parameter_pictures(rows, [c for c in ranked if c.name not in hidden])
    left = [c.name for c in ranked if c.name in hidden]
    if left:
        out.append(f"Not in the ranking, because these runs do not show them by themselves: {', '.join(left)}.")
    return [*out, parameter_table([r for r in rows if r.note != SETUP_NOTE]), *setup_section(rows)]


def solution_rows(found: Assessment) -> list[ParameterRow]:
    """Rows of parameters; a motion that is not observable by itself carries a note (its value holds for this tool only)."""
    status = {m.name: m.status for m in found.observability.motions}
    rows = parameter_rows(found.joint)
    return [replace(r, note=f"{r.note}; {HIDDEN_NOTE}") if status.get(r.name) == "not observable" else r for r in rows]


def _motions(found: Assessment) -> list[Block]:
    curves = motion_curves(found)
    units = list(dict.fromkeys(c.unit for c in curves))
    caption = (
        f"Line: what was found; band: {U_OF}. Dashed: these runs do not show this motion by itself, only together with others; its curve "
        "rests on what machines usually do."
    )
    return [
        PictureBlock(caption, [motion_bands([c for c in curves if c.unit == u], key=f"motions-{i}") for i, u in enumerate(units)], "wide")
    ]


def _observability(found: Assessment, shares: Sequence[MotionShare]) -> list[Block]:
    caption = (
        "Filled: these runs show the motion by itself. Outline only: in every reading, part of the motion looks like another error, however"
        " long the bar; do not put it into a compensation table of its own."
    )
    out: list[Block] = [layout_line(found.observability.number), PictureBlock(caption, [share_plot(shares)])]
    if found.observability.advice:
        out.append(Section("What would show more", [Lines([a.text for a in found.observability.advice])]))
    pairs = _correlations(found)
    if len(pairs.names) > 1:
        caption = (
            "Parameters whose errors go together: orange, both too large or both too small; blue, one makes up for the other. Near ± 1 "
            "only their sum or difference is known."
        )
        out.append(PictureBlock(caption, [correlation_plot(pairs)]))
    return out


def _volume(found: Assessment) -> list[Block]:
    slices = [_slice(found, plane) for plane in PLANES]
    step = common_step(slices)
    maps = [cell_map(s, step, key=f"slice-{i}", heading=f"U of the predicted vector, {s.at}") for i, s in enumerate(slices)]
    gains = [gain_map(_gain(found, fixed), key=f"gain-{i}") for i, (_, _, fixed) in enumerate(PLANES)]
    return [
        worst_line(found),
        PictureBlock(
            "Half-axis of the 95 % region of the predicted deviation vector, best-fit rigid motion removed. One colour scale.", maps
        ),
        PictureBlock(
            "Predicted deviation, µm, per µm of reading noise: high where readings are few or far away. More or better readings help "
            "there; elsewhere the assumptions about machines decide.",
            gains,
        ),
    ]


def _tables(solution: SolutionFile) -> list[Section]:
    out = [] if solution.monte_carlo is None else [Section("Monte Carlo trials", [solution.monte_carlo.text])]
    if solution.tables:
        cells = [
            (t.kind, str(t.entries), stated(t.rms_um, t.u_rms_um), stated(t.q95_um, t.u_q95_um), stated(t.max_um, t.u_max_um))
            for t in solution.tables
        ]
        text = (
            f"Remaining errors of distances over the inner 80 % of the strokes, µm, with {U_OF}. Every row includes what is unknown about "
            "this machine."
        )
        table = TextTable(("Table", "Numbers", "rms", "95 % below", "Largest"), cells)
        out.append(Section("What each kind of table can reach", [text, table]))
    return out


def _residuals(found: Assessment) -> list[Block]:
    joint = found.joint
    return [
        Section("Not noise", [Lines(residual_lines(joint) or ["No test of the residuals found more than noise."])]),
        Section("Noise found", [Lines(noise_lines(joint) or ["No noise was estimated."])]),
        Section("Outliers", [Lines(outlier_lines(found.solved) or ["No reading was set aside."])]),
        *residual_picture(residual_series(joint), solution_runs(joint)),
    ]


def motion_curves(found: Assessment) -> list[MotionCurve]:
    """Every error motion of a solution except squareness."""
    joint = found.joint
    status = {m.name: m.status for m in found.observability.motions}
    return curves_of(joint.terms, joint.coefficients, joint.term_covariance, joint.machine.stroke_mm, status)


def curves_of(terms: tuple[Term, ...], coefficients: F1, covariance: F2, stroke_mm: F2, status: Mapping[str, str]) -> list[MotionCurve]:
    """Every error motion except squareness as a function over its stroke, with its standard uncertainty, µm or µrad."""
    nodes = np.stack([np.linspace(lo, hi, CURVE_NODES) for lo, hi in stroke_mm], axis=1)
    values = term_values(terms, nodes, stroke_mm)
    out = []
    for name in dict.fromkeys(t.motion for t in terms if t.order):
        at = [i for i, t in enumerate(terms) if t.motion == name]
        axis, turns = terms[at[0]].axis, terms[at[0]].component >= 3
        scale, unit = (1e6, "µrad") if turns else (1e3, "µm")
        basis = values[:, at]
        u = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", basis, covariance[np.ix_(at, at)], basis), 0.0))
        curve = MotionCurve(name, AXES[axis], nodes[:, axis], basis @ coefficients[at] * scale, u * scale, unit, status.get(name, ""))
        out.append(curve)
    return out


def _slice(found: Assessment, plane: tuple[int, int, int]) -> Slice:
    across, up, fixed = plane
    stroke = found.joint.machine.stroke_mm
    x, y = (np.linspace(stroke[a, 0], stroke[a, 1], SLICE_NODES) for a in (across, up))
    points = np.empty((SLICE_NODES**2, 3))
    points[:, across], points[:, up] = np.tile(x, SLICE_NODES), np.repeat(y, SLICE_NODES)
    points[:, fixed] = stroke[fixed].mean()
    values = found.predict(points).expanded_vector_mm.reshape(SLICE_NODES, SLICE_NODES) * 1e3
    return Slice(AXES[across], AXES[up], f"{AXES[fixed]} = {stroke[fixed].mean():.0f} mm", x, y, values)


def _gain(found: Assessment, fixed: int) -> Slice:
    """Noise gain over the plane through the middle of axis number ``fixed``."""
    plane = found.observability.plane(fixed, SLICE_NODES)
    values = plane.volume.gain.reshape(SLICE_NODES, SLICE_NODES)
    at = f"{AXES[fixed]} = {plane.fixed_mm:.0f} mm"
    return Slice(AXES[plane.first], AXES[plane.second], at, plane.first_mm, plane.second_mm, values)


def _correlations(found: Assessment) -> Correlations:
    """Correlations of the most correlated parameters, in the order of the model."""
    e = found.joint.estimate
    chosen: list[str] = []
    for pair in found.observability.correlations:
        new = [n for n in (pair.first, pair.second) if n not in chosen]
        if len(chosen) + len(new) > MOST_CORRELATED:
            break
        chosen += new
    names = sorted(chosen, key=e.names.index)
    at = [e.names.index(n) for n in names]
    covariance = e.covariance[np.ix_(at, at)]
    u = np.sqrt(np.diag(covariance))
    return Correlations(names, np.asarray(covariance / np.outer(u, u)).reshape(len(names), len(names)))


def residual_series(joint: JointSolution) -> list[ResidualSeries]:
    """Residuals of every run against the number of the reading."""
    return [ResidualSeries(r.label, "reading", np.arange(float(r.residual_mm.size)), r.residual_mm * 1e3) for r in joint.runs]


def solution_runs(joint: JointSolution) -> list[RunRow]:
    """Runs used by a solution."""
    counts = {r.label: sum(o.run == r.label for o in joint.outliers) for r in joint.runs}
    return [
        RunRow(r.label, r.kind, "identify", r.residual_mm.size, r.rms_mm * 1e3, r.expected_mm * 1e3, counts[r.label]) for r in joint.runs
    ]


def parameter_rows(joint: JointSolution) -> list[ParameterRow]:
    """Parameters with standard uncertainty: scales, squareness, lost motion, then cups, bars and mirrors."""
    e = joint.estimate
    rows = []
    for p in mean_linear(joint):
        scale = p.name[0] == "E"
        unit, note = ("µm/m", f"scale error, mean over the volume, {SCALE_NOTE}") if scale else ("µrad", "squareness, mean over the volume")
        rows.append(ParameterRow(p.name, p.value * 1e6, p.u * 1e6, unit, note))
    rows += [
        ParameterRow(f"backlash {a}", v * 1e3, u * 1e3, "µm", "lost motion, not compensated") for a, (v, u) in joint.backlash_mm().items()
    ]
    for n in e.names:
        if n.startswith(("cup_", "bar_length_")):
            rows.append(ParameterRow(n.replace("_", " "), e.value(n) * 1e3, e.u(n) * 1e3, "µm", SETUP_NOTE))
        elif n.startswith("tilt_"):
            rows.append(ParameterRow(n.replace("_", " "), e.value(n) * 1e6, e.u(n) * 1e6, "µrad", SETUP_NOTE))
    return rows


def contributions(joint: JointSolution) -> list[Contribution]:
    """Rms of each translation and squareness over its stroke, half of each lost motion; largest first. Angles appear in the map only."""
    weights: dict[str, list[tuple[int, float]]] = {}
    for k, term in enumerate(joint.terms):
        if term.order == 0:
            weights.setdefault(term.motion, []).append((k, float(joint.machine.length_mm[term.axis]) ** 2 / 12.0))
        elif term.component < 3:
            weights.setdefault(term.motion, []).append((k, 1.0 / (2 * term.order + 1)))
    found = [_rms_of(joint, name, parts) for name, parts in weights.items()]
    found += [Contribution(f"backlash {a}", abs(v) / 2 * 1e3, u / 2 * 1e3) for a, (v, u) in joint.backlash_mm().items()]
    return sorted(found, key=lambda c: -(c.value_um or 0.0))


def _rms_of(joint: JointSolution, name: str, parts: list[tuple[int, float]]) -> Contribution:
    """Rms = sqrt(sum w c^2) and its standard uncertainty by propagation."""
    index, w = [k for k, _ in parts], np.array([v for _, v in parts])
    c = joint.coefficients[index]
    rms = float(np.sqrt(np.sum(w * c**2)))
    gradient = w * c / rms if rms > 0 else np.zeros_like(c)
    u = float(np.sqrt(gradient @ joint.term_covariance[np.ix_(index, index)] @ gradient))
    return Contribution(name, rms * 1e3, u * 1e3)
