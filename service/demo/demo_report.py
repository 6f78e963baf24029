"""The demonstration's result as a report and as JSON. Sealed-truth figures are always marked as such."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from abbe.models.compensation.tables import NineTables
from abbe.models.solvers.assessment import observability_of
from abbe.models.solvers.joint import JointSolution
from abbe.service.compensation.correct import Correction
from abbe.service.demo.demo import DemoResult
from abbe.service.rendering.document import Block, Document, Lines, PictureBlock, Section
from abbe.service.rendering.model import SETUP_NOTE, ArrowField, TableCurve
from abbe.service.rendering.numbers import COVERAGE, tidy
from abbe.service.rendering.plots.curves import diagonal_plot
from abbe.service.rendering.plots.tables import table_plot
from abbe.service.rendering.plots.volume import volume_pair
from abbe.service.report.blocks import (
    SIGNS,
    SummaryRow,
    parameter_pictures,
    parameter_table,
    residual_picture,
    run_table,
    setup_section,
    summary_table,
)
from abbe.service.report.report_parts import machine_facts
from abbe.service.report.solution_sections import contributions, parameter_rows, residual_series, solution_runs
from abbe.service.verification.verify import VerificationFigures, figure_rows

TRUTH = "sealed truth of the simulator"
ALL_OBSERVABLE = (
    "nothing in the model: these runs determine every parameter. Errors outside the model remain possible: look at the residuals"
)
TRUTH_KEYS = ("max_body_diagonal_um", "volumetric_rms_um", "volumetric_max_um")


def demo_json(result: DemoResult) -> dict[str, Any]:
    """Return the JSON output of `abbe demo --json`: figures of the sealed truth, the best that nine tables can do, measured figures."""
    before, after = result.truth_before, result.truth_after
    out: dict[str, Any] = {"format": "abbe-demo/1", "seed": result.seed, "speed": result.speed}
    out |= {key: {"before": before[key], "after": after[key]} for key in TRUTH_KEYS}
    best = before["best_nine_tables_rms_um"]
    rms0, rms1 = before["volumetric_rms_um"], after["volumetric_rms_um"]
    out["best_nine_tables_rms_um"] = best
    out["volumetric_factor"] = {"reached": rms0 / rms1, "bound": rms0 / best, "share": best / rms1}
    out["volumetric_reduction_share"] = (rms0 - rms1) / (rms0 - best)
    out["source_of_the_above"] = TRUTH + ", rigid motion removed"
    c = result.correction
    if c is not None:
        out["measured"] = {
            n: {"before": v, "u_before": u, "after": a, "u_after": ua} for n, (v, u), (a, ua) in _measured(c.before, c.after)
        }
        p = c.predicted
        out["predicted_rms_um"] = {"before": p.before_mm * 1e3, "after": p.after_mm * 1e3, "u_model": p.u_model_mm * 1e3}
        out["kept"], out["verdict"] = c.decision.keep, c.decision.text
        out["holdout_misfit_um"] = c.holdout_misfit_um
    out["duration_s"] = round(result.duration_s, 1)
    return out


def _measured(before: VerificationFigures, after: VerificationFigures) -> list[tuple[str, tuple[float, float], tuple[float, float]]]:
    old, new = figure_rows(before), figure_rows(after)
    return [(k, old[k], new[k]) for k in old if k in new]


def summary_rows(result: DemoResult) -> list[SummaryRow]:
    """Return the figures before and after: measured ones first, then the sealed truth."""
    rows = []
    c = result.correction
    for name, (v, u), (a, ua) in _measured(c.before, c.after) if c is not None else []:
        title = _title(name)
        rows.append(SummaryRow(title, "µm", v, a, u, ua))
    for key, title in zip(TRUTH_KEYS, ("Largest body diagonal", "Volumetric error, rms", "Volumetric error, maximum"), strict=True):
        if key in result.truth_before and key in result.truth_after:
            old, new = float(result.truth_before[key]), float(result.truth_after[key])
            rows.append(SummaryRow(title, "µm", old, new, source="sealed truth of the simulator"))
    return rows


def _title(name: str) -> str:
    if name == "helix_rms_um":
        return "Helix, rms (other centre and radius)"
    if name == "body_diagonal_um":
        return "Largest body diagonal"
    return f"Body diagonal {name.removeprefix('diagonal_').removesuffix('_um')}"


def _arrows(truth: dict[str, Any]) -> ArrowField | None:
    if "grid_mm" not in truth:
        return None
    return ArrowField(np.asarray(truth["grid_mm"], dtype=np.float64), np.asarray(truth["deviation_um"], dtype=np.float64))


def _curves(found: VerificationFigures) -> dict[str, tuple[Sequence[float], Sequence[float]]]:
    return {k: (f.position_mm.tolist(), (f.deviation_mm * 1e3).tolist()) for k, f in found.diagonals.items()}


def _tables(t: NineTables) -> list[TableCurve]:
    return [
        TableCurve("XYZ"[a], "XYZ"[i], t.position_mm[a].tolist(), (t.correction_mm[a][:, i] * 1e3).tolist())
        for a in range(3)
        for i in range(3)
    ]


def demo_report(result: DemoResult) -> Document:
    """Return the report of the demonstration: before and after, parameters, tables, residuals.

    Raises
    ------
    ValueError
        The demonstration ended before a correction.
    """
    c = result.correction
    if c is None:
        raise ValueError("the demonstration holds no correction to report")
    joint = c.solved.joint
    rows, runs = parameter_rows(joint), solution_runs(joint)
    shown = [r for r in rows if r.note != SETUP_NOTE]
    return Document(
        kind="cycle",
        title=f"Abbe: measure, correct, verify - {result.site.name}",
        about=machine_facts(result.site.doc) | {"Made": result.started_utc},
        verdict=("ok" if c.decision.keep else "bad", "Table kept" if c.decision.keep else "Table rolled back", c.decision.text),
        remarks=_warnings(joint),
        sections=(
            Section("Before and after", _before_and_after(result, c)),
            Section(
                "Identified parameters", [*parameter_pictures(rows, contributions(joint)), parameter_table(shown), *setup_section(rows)]
            ),
        ),
        not_observable=[g.text for g in observability_of(joint).hidden] or [ALL_OBSERVABLE],
        appendix=(
            Section("Compensation tables", _compensation(c)),
            Section("Residuals", residual_picture(residual_series(joint), runs)),
            Section("Runs", [run_table(runs)]),
        ),
        provenance={"Seed": str(result.seed), "abbe": version("abbe")},
        signatures=(),
    )


def _before_and_after(result: DemoResult, c: Correction) -> list[Block]:
    vectors = volume_pair(_arrows(result.truth_before), _arrows(result.truth_after))
    caption = "Error vectors over the volume, rigid motion removed; both pictures share one exaggeration and one colour scale."
    diagonals = (
        "Deviation along the body diagonals. Before: dashed; after: solid; all on one ordinate. Where a curve has two branches, they are "
        "the way out and the way back."
    )
    return [
        summary_table(summary_rows(result)),
        f"± is the expanded uncertainty U = k·u with k = {tidy(COVERAGE)} (about 95 %). A figure without ± has no stated uncertainty. "
        "Volumetric figures: best-fit rigid motion removed. “Sealed truth” rows come from the simulator's own error functions; the "
        "measurement never saw them.",
        *([PictureBlock(caption, vectors)] if vectors else []),
        PictureBlock(diagonals, [diagonal_plot(_curves(c.before), _curves(c.after))], "wide"),
    ]


def _compensation(c: Correction) -> list[Block]:
    lsb_um = c.lsb_nm * 1e-3
    caption = (
        f"Correction added to the commanded position, as stored in the controller (unit {tidy(lsb_um)} µm). The controller interpolates "
        "linearly between the points."
    )
    picture = PictureBlock(caption, [table_plot(_tables(c.tables), lsb_um=lsb_um)], "wide")
    return [picture, SIGNS, Section("How they were written", [Lines(c.pushed.log, numbered=True)])]


def _warnings(joint: JointSolution) -> list[str]:
    texts = ["Figures marked 'sealed truth' exist only because the machine is simulated; on a real machine only the measured rows exist."]
    factor = joint.estimate.variance_factor
    if factor > 1.5:
        texts.append(f"Residuals exceed the stated noise (variance factor {factor:.1f}): uncertainties are widened.")
    return texts
