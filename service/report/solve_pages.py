"""A solution as the values of its page."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from abbe.models.compensation.summary import SCALE_NOTE, mean_linear
from abbe.models.geometry.bases import term_values
from abbe.models.machine import AXES
from abbe.models.solvers.joint import JointSolution
from abbe.service.identification.solve_report import HIDDEN_NOTE, Account, judged, noise_lines, outlier_lines, residual_lines, worst_line
from abbe.service.identification.solve_verdict import layout_line
from abbe.service.rendering.model import SETUP_NOTE, Contribution, ParameterRow, ResidualSeries, RunRow
from abbe.service.rendering.solution_model import BudgetRow, Correlations, MotionCurve, MotionShare, Slice, SolutionPage, TableLine
from abbe.service.site import Site

CURVE_NODES = 61
SLICE_NODES = 15
MOST_CORRELATED = 14
PLANES = ((0, 1, 2), (0, 2, 1))
"""Axes across and up of each slice, and the axis that stands in the middle of its stroke."""


def solution_page(told: Account, doc: dict[str, Any], site: Site, made: str) -> SolutionPage:
    """Everything the page shows.

    Parameters
    ----------
    told : Account
    doc : dict
        `abbe.service.identification.solve_report.solution_doc` of it, with the campaign's name.
    site : Site
    made : str
        When, as text.
    """
    joint = told.joint
    rows = [_with_status(told, r) for r in parameter_rows(joint)]
    hidden = frozenset(m.name for m in told.observability.motions if m.status == "not observable")
    return SolutionPage(
        title=f"Campaign {doc['campaign']} - what it says about {site.name}",
        facts={"chain": joint.machine.chain, "model": doc["model"], "runs": str(len(joint.runs)), "made": made},
        verdict=_verdict(told),
        layout=layout_line(told.observability.number),
        flags=doc["flags"],
        parameters=[r for r in rows if r.note != SETUP_NOTE],
        setup=[r for r in rows if r.note == SETUP_NOTE],
        motions=motion_curves(told),
        contributions=[c for c in contributions(joint) if c.name not in hidden],
        left_out=[c.name for c in contributions(joint) if c.name in hidden],
        tables=_tables(doc),
        check=(doc.get("monte_carlo") or {}).get("text", ""),
        slices=[_slice(told, plane) for plane in PLANES],
        shares=[MotionShare(m.name, m.share, m.status) for m in told.observability.motions],
        gains=[_gain(told, fixed) for _, _, fixed in PLANES],
        worst=worst_line(told),
        budget=[BudgetRow(line.words, line.u_mm * 1e3, line.share) for line in told.budget.lines],
        correlations=_correlations(told),
        residuals=[ResidualSeries(r.label, "reading", np.arange(float(r.residual_mm.size)), r.residual_mm * 1e3) for r in joint.runs],
        runs=_runs(joint),
        noise=noise_lines(joint),
        outliers=outlier_lines(told.solved),
        tests=residual_lines(joint),
        not_observable=doc["not_observable"],
        advice=doc["advice"],
        provenance=_provenance(doc, made),
    )


def _verdict(told: Account) -> tuple[str, str, str]:
    found = judged(told)
    return found.sign, found.word[:1].upper() + found.word[1:], found.text


def _with_status(told: Account, row: ParameterRow) -> ParameterRow:
    """A row of a motion that the runs do not show by itself says so, and that its value is right for this tool only."""
    status = next((m.status for m in told.observability.motions if m.name == row.name), "observed")
    return replace(row, note=f"{row.note}; {HIDDEN_NOTE}") if status == "not observable" else row


def _tables(doc: dict[str, Any]) -> list[TableLine]:
    return [
        TableLine(t["kind"], t["entries"], *((t[k], t[f"u_{k}"]) for k in ("rms_um", "q95_um", "max_um"))) for t in doc.get("tables") or []
    ]


def motion_curves(told: Account) -> list[MotionCurve]:
    """Every error motion as a function over its stroke, with its standard uncertainty, µm or µrad."""
    joint = told.joint
    stroke = joint.machine.stroke_mm
    nodes = np.stack([np.linspace(lo, hi, CURVE_NODES) for lo, hi in stroke], axis=1)
    values = term_values(joint.terms, nodes, stroke)
    status = {m.name: m.status for m in told.observability.motions}
    out = []
    for name in dict.fromkeys(t.motion for t in joint.terms if t.order):
        at = [i for i, t in enumerate(joint.terms) if t.motion == name]
        axis, turns = joint.terms[at[0]].axis, joint.terms[at[0]].component >= 3
        scale, unit = (1e6, "µrad") if turns else (1e3, "µm")
        basis = values[:, at]
        variance = np.einsum("ni,ij,nj->n", basis, joint.term_covariance[np.ix_(at, at)], basis)
        u = np.sqrt(np.maximum(variance, 0.0))
        out.append(MotionCurve(name, AXES[axis], nodes[:, axis], basis @ joint.coefficients[at] * scale, u * scale, unit, status[name]))
    return out


def _slice(told: Account, plane: tuple[int, int, int]) -> Slice:
    across, up, fixed = plane
    stroke = told.joint.machine.stroke_mm
    x, y = (np.linspace(stroke[a, 0], stroke[a, 1], SLICE_NODES) for a in (across, up))
    points = np.empty((SLICE_NODES**2, 3))
    points[:, across], points[:, up] = np.tile(x, SLICE_NODES), np.repeat(y, SLICE_NODES)
    points[:, fixed] = stroke[fixed].mean()
    values = told.predict(points).expanded_vector_mm.reshape(SLICE_NODES, SLICE_NODES) * 1e3
    return Slice(AXES[across], AXES[up], f"{AXES[fixed]} = {stroke[fixed].mean():.0f} mm", x, y, values)


def _gain(told: Account, fixed: int) -> Slice:
    """Noise gain over the plane in the middle of one axis."""
    plane = told.observability.plane(fixed, SLICE_NODES)
    values = plane.volume.gain.reshape(SLICE_NODES, SLICE_NODES)
    at = f"{AXES[fixed]} = {plane.fixed_mm:.0f} mm"
    return Slice(AXES[plane.first], AXES[plane.second], at, plane.first_mm, plane.second_mm, values)


def _correlations(told: Account) -> Correlations:
    """The parameters of the strongest pairs, in the order of the model."""
    e = told.joint.estimate
    chosen: list[str] = []
    for pair in told.observability.correlations:
        new = [n for n in (pair.first, pair.second) if n not in chosen]
        if len(chosen) + len(new) > MOST_CORRELATED:
            break
        chosen += new
    names = sorted(chosen, key=e.names.index)
    at = [e.names.index(n) for n in names]
    covariance = e.covariance[np.ix_(at, at)]
    u = np.sqrt(np.diag(covariance))
    return Correlations(names, np.asarray(covariance / np.outer(u, u)).reshape(len(names), len(names)))


def _runs(joint: JointSolution) -> list[RunRow]:
    counts = {r.label: sum(o.run == r.label for o in joint.outliers) for r in joint.runs}
    return [
        RunRow(r.label, r.kind, "identify", r.residual_mm.size, r.rms_mm * 1e3, r.expected_mm * 1e3, counts[r.label]) for r in joint.runs
    ]


def _provenance(doc: dict[str, Any], made: str) -> dict[str, str]:
    out = {"made": made, "model": doc["model"], "readings (SHA-256)": doc["inputs"]["digest"]}
    out |= {("revision" if k == "revision" else f"{k} version"): v for k, v in doc["versions"].items()}
    if "solution_id" in doc:
        out["stored as"] = f"solution {doc['solution_id']}"
        if doc["same_as"]:
            out["same readings and model as"] = "solution " + ", ".join(map(str, doc["same_as"]))
    return out


def parameter_rows(joint: JointSolution) -> list[ParameterRow]:
    """The parameters people ask for, with standard uncertainty: scales, squareness, lost motion, then the cups, bars and mirrors."""
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
            rows.append(ParameterRow(n.replace("_", " "), e.value(n) * 1e3, e.u(n) * 1e3, "µm", "set-up"))
        elif n.startswith("tilt_"):
            rows.append(ParameterRow(n.replace("_", " "), e.value(n) * 1e6, e.u(n) * 1e6, "µrad", "set-up"))
    return rows


def contributions(joint: JointSolution) -> list[Contribution]:
    """Rms over its stroke of every translation and squareness, largest first (angles act through levers and are left to the map)."""
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
