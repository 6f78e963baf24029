"""The demonstration's result as the report's data and as JSON. Sealed-truth figures are always marked as such."""

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
from abbe.service.rendering.model import (
    ArrowField,
    DemoReport,
    ResidualSeries,
    RunRow,
    SummaryRow,
    TableCurve,
)
from abbe.service.report.solve_pages import contributions, parameter_rows
from abbe.service.verification.verify import VerificationFigures, figure_rows

TRUTH = "sealed truth of the simulator"
TRUTH_KEYS = ("max_body_diagonal_um", "volumetric_rms_um", "volumetric_max_um")


def demo_json(result: DemoResult) -> dict[str, Any]:
    """What `abbe demo --json` prints: sealed-truth figures, the bound of nine tables, measured figures with uncertainty."""
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
    """Before and after, measured figures first, then the sealed truth."""
    rows = []
    c = result.correction
    for name, (v, u), (a, ua) in _measured(c.before, c.after) if c is not None else []:
        title = _title(name)
        rows.append(SummaryRow(title, "µm", v, a, v / a if a > 0 else None, u, ua, "measured"))
    for key, title in zip(TRUTH_KEYS, ("Largest body diagonal", "Volumetric error, rms", "Volumetric error, maximum"), strict=True):
        if key in result.truth_before and key in result.truth_after:
            old, new = float(result.truth_before[key]), float(result.truth_after[key])
            rows.append(SummaryRow(title, "µm", old, new, old / new if new else None, source="sealed truth of the simulator"))
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


def demo_report(result: DemoResult) -> DemoReport:
    """Everything the report shows, from what the demonstration found.

    Raises
    ------
    ValueError
        The demonstration did not get as far as a correction.
    """
    c = result.correction
    if c is None:
        raise ValueError("the demonstration holds no correction to report")
    joint = c.solved.joint
    return DemoReport(
        title=f"Abbe: measure, correct, verify - {result.site.name}",
        machine={"chain": result.site.machine.chain, "stroke_mm": result.site.doc["stroke_mm"], "tool_mm": result.site.doc["tool_mm"]},
        created_utc=result.started_utc,
        seed=result.seed,
        versions={"abbe": version("abbe")},
        verdict=("Table kept: " if c.decision.keep else "Table rolled back: ") + c.decision.text,
        accepted=c.decision.keep,
        summary=summary_rows(result),
        parameters=parameter_rows(joint),
        not_observable=[g.text for g in observability_of(joint).hidden],
        runs=_runs(c),
        residuals=[ResidualSeries(r.label, "reading", list(range(r.residual_mm.size)), (r.residual_mm * 1e3).tolist()) for r in joint.runs],
        tables=_tables(c.tables),
        table_lsb_um=c.lsb_nm * 1e-3,
        arrows_before=_arrows(result.truth_before),
        arrows_after=_arrows(result.truth_after),
        diagonals_before=_curves(c.before),
        diagonals_after=_curves(c.after),
        contributions=contributions(joint),
        push_log=list(c.pushed.log),
        warnings=_warnings(joint),
    )


def _runs(c: Correction) -> list[RunRow]:
    joint = c.solved.joint
    return [RunRow(r.label, r.kind, "identify", r.residual_mm.size, r.rms_mm * 1e3, r.expected_mm * 1e3) for r in joint.runs]


def _warnings(joint: JointSolution) -> list[str]:
    texts = ["Figures marked 'sealed truth' exist only because the machine is simulated; on a real machine only the measured rows exist."]
    factor = joint.estimate.variance_factor
    if factor > 1.5:
        texts.append(f"Residuals exceed the stated noise (variance factor {factor:.1f}): uncertainties are widened.")
    return texts
