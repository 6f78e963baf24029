"""Reports of measurements: one run, or a campaign with its latest stored solution; also what an imported campaign holds beside its
runs (angles, means of both directions, stated figures, what is unknown).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.iso230_2 import ScaleBudget, Value, positioning
from abbe.models.machine import AXES
from abbe.models.solvers.observations import nominal_reading
from abbe.models.verification import helix_figure
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Rules
from abbe.service.domain.run import Run
from abbe.service.domain.run_file import OtherReadings, SourceFile, StatedFigure
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.domain.verification import Verdict
from abbe.service.errors import AbbeError, MeasurementFault
from abbe.service.identification.solve_report import HIDDEN_NOTE, Assessment
from abbe.service.rendering.document import Document, PictureBlock, ReportFigure, Section, Sign, TextTable
from abbe.service.rendering.model import ParameterRow, PolarTrace, ResidualSeries
from abbe.service.rendering.numbers import plain
from abbe.service.rendering.plots.bars import uncertainty_bars
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.rendering.plots.residuals import residual_plot
from abbe.service.report import report_parts as parts
from abbe.service.report.artefact_sections import pose_readings
from abbe.service.report.blocks import picture_section
from abbe.service.report.report_table import NO_TABLE_REMARKS, TableRemarks
from abbe.service.report.solution_sections import residual_sections, solution_sections
from abbe.service.runs.coverage import about_axis, not_judged, path_axis, reached_mm, reached_text
from abbe.service.runs.observations import run_data
from abbe.service.verification.far_readings import far_angles
from abbe.service.verification.iso_readings import approaches_of
from abbe.service.verification.iso_report import UM, Evaluated, evaluate, positioning_rows
from abbe.service.verification.reduction import holds_at
from abbe.service.verification.verify import DIAGONALS, figure_rows, figures

URAD = 1e6
STATED = "as its file states it"
NO_U = "U of the figures that a file states: the file holds no uncertainty"
ANGLE_STATEMENT = (
    "U of angles (rows of ISO 230-2 for the angular deviation of an axis, ISO 230-1) includes the scatter of the approaches and the "
    "resolution, not the calibration of the instrument, which the file does not state."
)


def evaluate_imported(campaign: Doc) -> Evaluated:
    """Evaluate ``origins``, ``readings`` and ``stated`` of a campaign; the result is empty for a campaign that Abbe measured."""
    out = Evaluated()
    out.remarks += far_angles(campaign)
    for doc in campaign.get("readings", ()):
        _readings(out, OtherReadings.read(doc))
    for doc in campaign.get("stated", ()):
        one = StatedFigure.read(doc)
        out.figures.append(ReportFigure(f"{one.group}, {one.file}", one.symbol, one.name, one.value, None, one.unit, STATED))
    out.not_observable += [NO_U] if campaign.get("stated") else []
    for doc in campaign.get("origins", ()):
        origin = SourceFile.read(doc)
        out.remarks += [f"{origin.file} ({origin.format}) does not say: {text}" for text in origin.unknown]
        out.conditions[f"File {origin.file}"] = "; ".join(f"{name}: {value}" for name, value in origin.said.items()) or origin.format
    return out


def _readings(out: Evaluated, read: OtherReadings) -> None:
    if read.kind == "mean":
        _means(out, read)
        return
    cells: dict[tuple[float, int], list[float]] = {}
    for position, way, value in zip(read.position_mm, read.direction, read.deviation, strict=True):
        cells.setdefault((position, way), []).append(value)
    group = f"Axis {read.axis}, set-up {read.setup_id}: angle, ISO 230-1"
    try:
        found = positioning(approaches_of(cells), ScaleBudget(reading_mm=read.resolution / np.sqrt(12.0)))
    except ValueError:
        out.not_observable.append(f"reversal and figures of both directions of {group} ({read.file}): no target was approached from both")
        out.figures += _ranges(read, group)
        return
    out.figures += [_figure(group, symbol, name.replace("positioning", "angle"), v, URAD) for symbol, name, v in positioning_rows(found)]
    out.remarks.append(f"{read.file}: it does not say which angle of axis {read.axis} was measured (pitch, yaw or roll)")
    out.statements += [] if ANGLE_STATEMENT in out.statements else [ANGLE_STATEMENT]


def _ranges(read: OtherReadings, group: str) -> list[ReportFigure]:
    """Range of the mean angle at the targets of a test in one direction."""
    at = np.array(read.position_mm)
    means = [float(np.mean(np.array(read.deviation)[at == p])) for p in np.unique(at)]
    symbol = "E+" if read.direction[0] > 0 else "E-"
    u = read.resolution / np.sqrt(6.0)
    return [_figure(group, symbol, f"systematic deviation, moving in {symbol[1]}", Value(max(means) - min(means), u), URAD)]


def _means(out: Evaluated, read: OtherReadings) -> None:
    """Range of the means of both directions: M of ISO 230-2. The scatter behind a mean is unknown, and so is U."""
    value, group = np.ptp(read.deviation), f"Axis {read.axis}, set-up {read.setup_id}: positioning, ISO 230-2"
    out.figures.append(ReportFigure(group, "M", "range of the mean bidirectional deviations", float(value) * UM, None, "µm", "ISO 230-2"))
    out.not_observable.append(f"U of M of {read.file}: the file holds means, not the readings behind them")


def _figure(group: str, symbol: str, name: str, value: Value | None, factor: float) -> ReportFigure:
    if value is None:
        return ReportFigure(group, symbol, name, None, None, "µrad", "ISO 230-1")
    return ReportFigure(group, symbol, name, value.value_mm * factor, value.u_mm * factor, "µrad", "ISO 230-1")


SOLUTION_SIGNS: dict[str, Sign] = {"good": "ok", "usable with care": "open", "mostly assumption": "bad"}
NOT_JUDGED = "No limit is on record for these figures; a machine file (-m) states limits."


@dataclass(frozen=True)
class SolutionResult:
    """A solution. ``number``: None if it is not stored; ``account``: source of the pictures, only for a new solution."""

    solution: SolutionFile
    number: int | None = None
    account: Assessment | None = None

    @property
    def name(self) -> str:
        """Name in the report."""
        return "solution" if self.number is None else f"solution {self.number}"


@dataclass(frozen=True)
class Measured:
    """Content of a report of a measurement.

    ``facts``: further lines for the head; ``states``: run, test, role, state and reason of every run, also of incomplete ones;
    ``solution``: the new one or the latest stored one; ``table``: remarks about the tables in force; ``days``: as in `Document`.
    """

    campaign: Campaign
    facts: dict[str, str] = field(default_factory=dict)
    states: Sequence[Sequence[str]] = ()
    solution: SolutionResult | None = None
    table: TableRemarks = NO_TABLE_REMARKS
    days: tuple[str, str] | None = None


def campaign_report(found: Measured, rules: Rules) -> Document:
    """Report of a campaign: figures by ISO 230, figures of a verification, the solution."""
    campaign = found.campaign
    evaluated = evaluate(campaign.runs, campaign.doc.get("instruments"), rules.materials)
    evaluated.add(evaluate_imported(campaign.doc))
    checked, verdict = _verification(campaign.runs, rules)
    condition, remarks = parts.conditions(campaign.runs, rules)
    solved = _solution(found.solution)
    used = [run for run in campaign.runs if run.identifies]
    holds = (
        {}
        if found.solution is None
        else {
            "Solution holds at": holds_at(used, rules.materials),
            "Measured positions": reached_text(dict(zip(AXES, reached_mm(used), strict=False))),
        }
    )
    remarks = [*found.table.remarks, *_unfinished(found.states, campaign.runs), *solved.remarks, *evaluated.remarks, *remarks]
    return Document(
        kind="campaign",
        title=f"Campaign {campaign.name}",
        about=parts.machine_facts(campaign.site.doc) | {"Campaign": campaign.name} | holds | found.facts,
        verdict=found.table.verdict(parts.verdict_of(verdict, remarks, _solution_verdict(found.solution))),
        figures=[*checked, *solved.figures, *evaluated.figures],
        instruments=parts.instruments(campaign.runs, campaign.doc, rules),
        conditions=condition | evaluated.conditions,
        not_observable=[*solved.not_observable, *evaluated.not_observable],
        remarks=remarks,
        statements=[*solved.statements, *([parts.VERIFICATION_STATEMENT] if checked else []), *evaluated.statements],
        provenance=parts.provenance(parts.data_digest(campaign.runs), _made(found.solution)) | _same_as(found.solution),
        sections=_sections(found.solution),
        appendix=[
            *picture_section([*solved.pictures, *evaluated.pictures]),
            *evaluated.targets,
            *_residuals(found.solution),
            *_budget(found.solution),
            Section("Runs", [_run_table(found)]),
        ],
        days=found.days,
    )


def run_report(found: Measured, label: str, rules: Rules) -> Document:
    """Report of one run: figures by ISO 230, and its readings."""
    run = next(r for r in found.campaign.runs if r.run_id == label)
    evaluated = evaluate([run], found.campaign.doc.get("instruments"), rules.materials)
    condition, remarks = parts.conditions([run], rules)
    own, why = _own(run), not_judged(run)
    setup = [(k, _value_text(v)) for k, v in sorted(run.setup.document.items())]
    return Document(
        kind="run",
        title=f"Run {found.campaign.name}/{label}",
        about=parts.machine_facts(run.machine) | {"Campaign": found.campaign.name, "Run": label, "Test": run.test} | found.facts,
        verdict=found.table.verdict(("open", "Not judged", f"{why}." if why else NOT_JUDGED)),
        figures=[*own.figures, *evaluated.figures],
        instruments=parts.instruments([run], found.campaign.doc, rules),
        conditions=condition | evaluated.conditions,
        not_observable=[*own.not_observable, *evaluated.not_observable],
        remarks=[*found.table.remarks, *_unfinished(found.states, [run]), *evaluated.remarks, *remarks],
        statements=evaluated.statements,
        provenance=parts.provenance(parts.data_digest([run])),
        appendix=[
            *picture_section([*evaluated.pictures, *own.pictures]),
            *evaluated.targets,
            Section("Set-up", [TextTable(("Name", "Value"), setup)]),
        ],
    )


def _verification(runs: Sequence[Run], rules: Rules) -> tuple[list[ReportFigure], Verdict | None]:
    """Figures of a verification and their verdict, if these runs contain all four body diagonals, measured once out and back."""
    known = [r for r in runs if not r.is_sealed and not r.is_artefact and (r.is_bar or r.laser.cycles == 1) and not not_judged(r)]
    body = {r.laser.diagonal for r in known if r.test == "laser_diagonal" and not r.laser.order}
    if not body >= DIAGONALS:
        return [], None
    try:
        return parts.judged(figure_rows(figures(known)), rules, "Verification")
    except MeasurementFault:  # too few readings: the figures by ISO 230 name the run
        return [], None


def _solution(result: SolutionResult | None) -> Evaluated:
    if result is None:
        return Evaluated(not_observable=["error motions of the machine: this campaign has no stored solution (abbe solve)"])
    solution, worst = result.solution, result.solution.uncertainty.worst_point
    place = ", ".join(f"{v:.0f}" for v in worst.at_mm)
    size = float(np.linalg.norm(worst.deviation_um))
    note = solution.mean_over_volume_note
    name = result.name[:1].upper() + result.name[1:]
    statement = (
        f"{name}: {solution.uncertainty.frame}. At the worst known point ({place}) mm the deviation is {plain(size)} µm, and its 95 % "
        f"region reaches {plain(worst.expanded_vector_um)} µm. {note[:1].upper()}{note[1:]}."
    )
    figures = _parameters(solution, f"Linear errors, mean over the volume ({result.name}, {solution.model})")
    rows = [ParameterRow(f.symbol, f.value, f.u, f.unit) for f in figures]
    drawn = result.account is None  # otherwise the section of the parameters draws them
    return Evaluated(
        figures=figures,
        pictures=[PictureBlock(f"{name}: linear errors with U.", [svg]) for svg in uncertainty_bars(rows)] if drawn else [],
        remarks=[*solution.flags, *solution.rough, *solution.artefacts],
        not_observable=[*solution.not_observable],
        statements=[statement],
    )


def _parameters(solution: SolutionFile, group: str) -> list[ReportFigure]:
    """Scales, squareness and lost motion; parameters that are not observable by themselves carry a note."""
    figures = []
    for name, p in solution.mean_over_volume.items():
        text, unit = ("scale error", "µm/m") if name[0] == "E" else ("squareness", "µrad")
        motion = solution.motions.get(name)
        hidden = f"; {HIDDEN_NOTE}" if motion is not None and motion.status == "not observable" else ""
        figures.append(ReportFigure(group, name, text + hidden, p.value * 1e6, p.u * 1e6, unit, "joint solution"))
    for name, lost in solution.parameters.items():
        if name.startswith("backlash_"):
            text = "lost motion, not compensated"
            figures.append(ReportFigure(group, name.replace("_", " "), text, lost.value * 1e3, lost.u * 1e3, "µm", "joint solution"))
    return figures


def _solution_verdict(solution: SolutionResult | None) -> tuple[Sign, str, str]:
    verdict = None if solution is None else solution.solution.verdict
    if verdict is None:
        return "open", "Not judged", NOT_JUDGED
    return SOLUTION_SIGNS[verdict.word], verdict.word[:1].upper() + verdict.word[1:], verdict.text


def _made(solution: SolutionResult | None) -> dict[str, str] | None:
    if solution is None:
        return None
    number = "" if solution.number is None else f"{solution.number}, "
    programs = solution.solution.versions.model_dump(exclude_none=True)
    return {k: str(v) for k, v in programs.items()} | {"solution": f"{number}inputs SHA-256 {solution.solution.inputs.digest}"}


def _same_as(solution: SolutionResult | None) -> dict[str, str]:
    same = [] if solution is None else solution.solution.same_as or []
    return {"Same readings and model as": f"solution {', '.join(map(str, same))}"} if same else {}


def _sections(solution: SolutionResult | None) -> list[Section]:
    return [] if solution is None or solution.account is None else solution_sections(solution.account, solution.solution)


def _residuals(solution: SolutionResult | None) -> list[Section]:
    return [] if solution is None or solution.account is None else residual_sections(solution.account)


def _budget(solution: SolutionResult | None) -> list[Section]:
    if solution is None:
        return []
    rows = [(b.text, plain(b.u_um, 2), f"{b.share:.0%}") for b in solution.solution.uncertainty.budget]
    title = "Uncertainty budget of the predicted deviation, rms over the volume"
    return [Section(title, [TextTable(("Source", "u in µm", "Share"), rows)])]


def _run_table(found: Measured) -> TextTable:
    head = ("Run", "Test", "Role", "State", "Readings", "SHA-256 (first 16)")
    whole = {r.run_id: r for r in found.campaign.runs}
    states = found.states or [(r.run_id, r.test, r.role, "complete", "") for r in found.campaign.runs]
    rows = []
    for label, test, role, state, _ in states:
        run = whole.get(label)
        readings = "" if run is None else str(len(run.columns))
        rows.append((label, test, role, state, readings, "" if run is None else parts.data_digest([run])[:16]))
    return TextTable(head, rows)


def _unfinished(states: Sequence[Sequence[str]], runs: Sequence[Run]) -> list[str]:
    """Remarks about runs that no figure uses; for a run that was resumed, they name the run that contains its readings."""
    whole = {piece.run: r.run_id for r in runs for piece in r.timing.pieces}
    short = {r.run_id: why for r in runs if (why := not_judged(r))}
    out = []
    for label, _, _, state, why in states:
        reason = f": {why}" if why else ""
        if label in whole:
            out.append(f"run {label} is {state}{reason}; run {whole[label]} continued it and contains its readings")
        elif label in short:
            out.append(f"run {label} is {short.pop(label)}; the figures do not use it{reason}")
        elif state != "complete":
            out.append(f"run {label} is {state}; the figures do not use it{reason}")
    return [*out, *(f"run {label} is {why}; the figures do not use it" for label, why in short.items())]


def _own(run: Run) -> Evaluated:
    """Figures and pictures of any run: its readings and their range; for a helix also its rms."""
    if run.is_sealed:
        return Evaluated(not_observable=["the readings: the run is sealed"])
    try:
        data = run_data(run)
    except AbbeError as error:
        return Evaluated(not_observable=[f"figures of this run: {error.detail}"])
    if run.is_artefact:
        return pose_readings(run, data)
    above = (data.deviation_mm - nominal_reading(data)) * 1e3
    group, columns = "Readings", run.columns
    rows = [ReportFigure(group, "n", f"valid readings of {len(columns)}", float(columns.valid.sum()), None, "", "count")]
    pictures = [_as_read(run, data.label, data.t_s, above)]
    if why := not_judged(run):
        return Evaluated(figures=rows, pictures=pictures, not_observable=[f"any figure of the whole path: {why}"])
    rows += [
        ReportFigure(group, "min", "smallest deviation", float(above.min()), None, "µm", "as read"),
        ReportFigure(group, "max", "largest deviation", float(above.max()), None, "µm", "as read"),
    ]
    if data.test == "helix":
        found = helix_figure(data)
        rows.append(
            ReportFigure(
                group,
                "helix rms",
                "rms about its own centre and length",
                found.value_mm * 1e3,
                found.u_mm * 1e3,
                "µm",
                parts.VERIFICATION,
            )
        )
        try:
            axis = path_axis(run, data.axes_mm)
        except MeasurementFault as error:
            return Evaluated(figures=rows, pictures=pictures, not_observable=[f"the picture of the helix: {error.detail}"])
        angle = np.degrees(about_axis(data.axes_mm - np.asarray(data.centre_mm), axis))
        text = f"Deviation of the helix around its axis ({AXES[axis]}), after a fit of centre and bar length."
        pictures.append(PictureBlock(text, [polar_plot([PolarTrace(data.label, angle, found.deviation_mm * 1e3)], heading="Helix")]))
    return Evaluated(figures=rows, pictures=pictures)


def _as_read(run: Run, label: str, t_s: F1, above_um: F1) -> PictureBlock:
    """The readings of a run over the time, or one after the other if their times are not known."""
    series, caption = ResidualSeries(label, "time of the campaign in s", t_s, above_um), "deviation against time, as read"
    if run.timing.counted:
        series, caption = ResidualSeries(label, "reading", np.arange(float(above_um.size)), above_um), "deviation, reading by reading"
    return PictureBlock(f"Run {label}: {caption}.", [residual_plot(series, noise_um=None, key="readings")], "wide")


def _value_text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_value_text(v) for v in value)
    if isinstance(value, float):
        return f"{value:.9g}"
    return str(value)
