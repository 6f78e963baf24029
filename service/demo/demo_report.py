"""The demonstration's result as a report and as JSON. Sealed-truth figures are always marked as such."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any, Literal

from abbe.models.compensation.tables import NineTables
from abbe.models.solvers.assessment import observability_of
from abbe.models.solvers.joint import JointSolution
from abbe.service.compensation.correct import Correction
from abbe.service.demo.demo import DemoResult, measured_figures
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
from abbe.service.verification.verify import VerificationFigures

TRUTH: Literal["sealed truth of the simulator"] = "sealed truth of the simulator"
DIAGONALS_TOLD = (
    "A body diagonal is the range of the mean of both ways (M_d of ISO 230-6), without reversal. Both figures, measured and true, begin "
    "and end 10 mm inside the strokes."
)
ALL_OBSERVABLE = (
    "nothing in the model: these runs determine every parameter. Errors outside the model remain possible: look at the residuals"
)
TRUTH_TITLES = {
    "max_body_diagonal_um": "Largest body diagonal",
    "volumetric_rms_um": "Volumetric error, rms",
    "volumetric_max_um": "Volumetric error, maximum",
}


@dataclass(frozen=True, slots=True)
class TableFactor:
    """Factor by which the tables reduced the volumetric rms, largest factor possible with nine one-axis tables, and their ratio."""

    reached: float
    bound: float
    share: float


def table_factor(result: DemoResult) -> TableFactor:
    """Return by how much the tables of a demonstration improved its machine, according to the sealed truth."""
    before, after = result.truths
    best, rms0, rms1 = before.best_nine_tables_rms_um, before.volumetric_rms_um, after.volumetric_rms_um
    return TableFactor(rms0 / rms1, rms0 / best, best / rms1)


def demo_json(result: DemoResult) -> dict[str, Any]:
    """Return the JSON output of `abbe demo --json`: figures of the sealed truth, the best that nine tables can do, measured figures."""
    c, (before, after) = result.corrected, result.truths
    best, rms0, rms1 = before.best_nine_tables_rms_um, before.volumetric_rms_um, after.volumetric_rms_um
    return {
        "format": "abbe-demo/1",
        "seed": result.seed,
        "speed": result.speed,
        **{key: {"before": getattr(before, key), "after": getattr(after, key)} for key in TRUTH_TITLES},
        "best_nine_tables_rms_um": best,
        "volumetric_factor": asdict(table_factor(result)),
        "volumetric_reduction_share": (rms0 - rms1) / (rms0 - best),
        "source_of_the_above": TRUTH + ", rigid motion removed",
        "measured": {f.name: f.to_document() for f in measured_figures(c)},
        "predicted_rms_um": {
            "before": c.predicted.before_mm * 1e3, "after": c.predicted.after_mm * 1e3, "u_model": c.predicted.u_model_mm * 1e3,
        },
        "kept": c.decision.keep,
        "verdict": c.decision.text,
        "holdout_misfit_um": c.holdout_misfit_um,
        "duration_s": round(result.duration_s, 1),
    }  # fmt: skip


def summary_rows(result: DemoResult) -> list[SummaryRow]:
    """Return the figures before and after: measured ones first, then the sealed truth."""
    measured = [SummaryRow(_title(f.name), "µm", f.before, f.after, f.u_before, f.u_after) for f in measured_figures(result.corrected)]
    before, after = result.truths
    true = [SummaryRow(title, "µm", getattr(before, key), getattr(after, key), source=TRUTH) for key, title in TRUTH_TITLES.items()]
    return measured + true


def _title(name: str) -> str:
    if name == "helix_rms_um":
        return "Helix, rms (other centre and radius)"
    if name == "body_diagonal_um":
        return "Largest body diagonal"
    if name == "reversal_um":
        return "Largest mean reversal of a body diagonal"
    return f"Body diagonal {name.removeprefix('diagonal_').removesuffix('_um')}"


def _curves(found: VerificationFigures) -> dict[str, tuple[Sequence[float], Sequence[float]]]:
    return {k: (f.position_mm.tolist(), (f.deviation_mm * 1e3).tolist()) for k, f in found.diagonals.items()}


def _tables(t: NineTables) -> list[TableCurve]:
    return [
        TableCurve("XYZ"[a], "XYZ"[i], t.position_mm[a].tolist(), (t.correction_mm[a][:, i] * 1e3).tolist())
        for a in range(3)
        for i in range(3)
    ]


def demo_report(result: DemoResult) -> Document:
    """Return the report of the demonstration: before and after, parameters, tables, residuals."""
    c = result.corrected
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
    before, after = (ArrowField(truth.grid_mm, truth.deviation_um) for truth in result.truths)
    vectors = volume_pair(before, after)
    caption = "Error vectors over the volume, rigid motion removed; both pictures share one exaggeration and one colour scale."
    diagonals = (
        "Deviation along the body diagonals. Before: dashed; after: solid; all on one ordinate. Where a curve has two branches, they are "
        "the way out and the way back."
    )
    return [
        summary_table(summary_rows(result)),
        f"± is the expanded uncertainty U = k·u with k = {tidy(COVERAGE)} (about 95 %). A figure without ± has no stated uncertainty. "
        "Volumetric figures: best-fit rigid motion removed. “Sealed truth” rows come from the simulator's own error functions; the "
        f"measurement never saw them. {DIAGONALS_TOLD}",
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
