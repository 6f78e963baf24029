"""A solution as stored (`abbe-solution/1`) and as lines for people, each value with its uncertainty."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.additive import SCALE_NOTE, MeanParameter, mean_linear
from abbe.models.geometry.volume import volume_frame, volume_grid
from abbe.models.machine import AXES
from abbe.models.solvers.assessment import Observability, observability_of
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.volume import GOOD, USABLE, Knowing, Number, observability_number, whole_volume
from abbe.models.solvers.residuals import Outlier
from abbe.models.solvers.roughness import rough_lines
from abbe.models.uncertainty.prediction import (
    Budget,
    BudgetLine,
    CompensableMask,
    Prediction,
    budget_over,
    compensable_mask,
    predict_deviation,
    worst_point,
)
from abbe.models.uncertainty.scales import SCALE_TEXTS, Scales, scale_projection, without_scales
from abbe.models.uncertainty.sources import ErrorSources, error_sources
from abbe.service.campaign_data.provenance import campaign_digest, machine_digest, versions
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Point
from abbe.service.domain.solution_file import (
    BudgetLineValue,
    CorrelationValue,
    Inputs,
    MeanValue,
    MotionValue,
    NoiseFound,
    ObservabilityNumber,
    OutlierFound,
    PackedMatrix,
    ParameterValue,
    Rank,
    ResidualTestResult,
    RunResult,
    SolutionFile,
    StoredPrediction,
    Uncertainty,
    VerdictValue,
    Versions,
    WithoutScale,
    WorstPoint,
    distinct,
)
from abbe.service.identification.artefact_answer import artefact_lines
from abbe.service.identification.removal import with_unknown_table
from abbe.service.identification.solve import HELIX_NOTE, STEP_NOTE, Solved

VERDICTS = ("mostly assumption", "usable with care", "good")
ENOUGH, HALF = 0.8, 0.5
"""Shares of the volume where the error exceeds its uncertainty; a smaller share lowers the verdict."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a solution. ``word``: one of `VERDICTS`; ``text``: its basis in numbers; ``reasons``: why it is not better."""

    word: str
    text: str
    reasons: tuple[str, ...]

    @property
    def sign(self) -> str:
        """Sign of the verdict: ``ok``, ``open`` or ``bad``."""
        return ("bad", "open", "ok")[VERDICTS.index(self.word)]


def verdict(number: Number, prediction: Prediction, share: float, *, flags: int = 0, not_noise: int = 0, beside: str = "") -> Verdict:
    """Judge the usability of a solution.

    The layout of the campaign limits the verdict. If the model does not fit, uncertainties are larger than the layout allows, and limit the
    verdict further.

    Parameters
    ----------
    number : Number
        The observability number: the limit of the layout.
    prediction : Prediction
        Over the volume, rigid motion removed.
    share : float
        Share of the volume where the error exceeds its uncertainty.
    flags : int
        Number of open flags.
    not_noise : int
        Number of runs with residuals that are not noise.
    beside : str
        What is known without the scales (`scale_text`).
    """
    u, error = float(prediction.u_vector_mm.max()), _error_rms_mm(prediction)
    reached = number.before_mm / u if u > 0.0 else np.inf
    level, reasons = VERDICTS.index(number.verdict), []
    if level < VERDICTS.index("good"):
        reasons.append(f"the layout of the campaign can make a typical machine's error at most {number.value:.1f} times smaller")
    if reached < GOOD:
        level = min(level, 1 if reached >= USABLE else 0)
        reasons.append(f"the uncertainty that was reached makes a typical machine's error only {reached:.1f} times smaller")
    if share < ENOUGH:
        level = min(level, 0 if share < HALF and error < u else 1)
        reasons.append(f"in {1.0 - share:.0%} of the volume the error is smaller than its uncertainty and cannot be compensated")
    if flags:
        level = min(level, 1)
        reasons.append(f"{flags} open flag{'s' if flags > 1 else ''}")
    if not_noise:
        level = min(level, 1)
        reasons.append(f"{not_noise} run{'s' if not_noise > 1 else ''} with residuals that are not noise")
    largest = float(prediction.expanded_vector_mm.max())
    text = f"Error of {error * 1e3:.2g} µm rms over the volume, known to ± {largest * 1e3:.2g} µm at the worst (95 %, rigid motion removed)"
    return Verdict(VERDICTS[level], text + beside + (": " + "; ".join(reasons) if reasons else "") + ".", tuple(reasons))


def layout_line(number: Number) -> str:
    """Return the observability number as text: a property of the campaign's layout, not of the readings."""
    return "What the layout of the campaign allows, if the model fits: " + number.text.replace(f" ({number.verdict})", "")


FORMAT: Literal["abbe-solution/1"] = "abbe-solution/1"
Word = Literal["good", "usable with care", "mostly assumption"]
HIDDEN_NOTE = "not observable by itself: the value holds for this tool only"
NODES = 6
"""Nodes per axis of the grid over the strokes on which the uncertainty is evaluated."""
LISTED = 20
"""Number of outliers and correlations in lists for people; the document holds all outliers."""


@dataclass(frozen=True)
class Assessment:
    """A solution with its observability, uncertainty and budget. ``prediction``: over the whole volume, best-fit rigid motion removed.

    ``scale_free``: the assessment without the scales, for tables that do not correct scales; None unless scales are the largest part of
    the uncertainty.
    ``left_out``: the scales that are left out of ``sources`` and of everything computed from them; ``joint`` still has these scales.
    """

    solved: Solved
    observability: Observability
    sources: ErrorSources
    prediction: Prediction
    budget: Budget
    mask: CompensableMask
    mean: tuple[MeanParameter, ...]
    scale_free: Assessment | None = None
    left_out: Scales | None = None

    @property
    def joint(self) -> JointSolution:
        """The joint solution."""
        return self.solved.joint

    def predict(self, points_mm: F2) -> Prediction:
        """Return the deviation and uncertainty at other points, shape (n, 3), with the same rigid motion removed."""
        return predict_deviation(self.sources, points_mm, frame=volume_frame(self.joint.machine))


def assess(solved: Solved, *, unknown_table: bool = False) -> Assessment:
    """Assess a solution: observability, uncertainty over the volume, budget.

    ``unknown_table``: a table acted during the runs and its effect is still in the readings; the uncertainty then includes it.
    """
    if unknown_table:
        solved = replace(solved, joint=with_unknown_table(solved.joint))
    joint = solved.joint
    sources = error_sources(joint, solved.inputs)
    prediction = _over_volume(sources)
    found = Assessment(
        solved,
        observability_of(joint),
        sources,
        prediction,
        budget_over(prediction),
        compensable_mask(prediction),
        mean_linear(joint),
    )
    return found if solved.joint.only_artefacts else replace(found, scale_free=_scale_free(found))


def _over_volume(sources: ErrorSources) -> Prediction:
    machine = sources.solution.machine
    return predict_deviation(sources, volume_grid(machine.stroke_mm, NODES), frame=volume_frame(machine))


LARGEST_PART = 0.5
"""Share of the variance over the volume above which scales are its largest part."""


def _scale_free(found: Assessment) -> Assessment | None:
    """Return the assessment without the common scale if that is the largest part of the uncertainty; else without the scales of the axes
    if those are the largest part; else None."""
    for scales in SCALE_TEXTS:
        sources = without_scales(found.sources, scales)
        prediction = _over_volume(sources)
        if np.sum(prediction.u_mm**2) < (1.0 - LARGEST_PART) * np.sum(found.prediction.u_mm**2):
            o, mask = found.observability, compensable_mask(prediction)
            turn = scale_projection(o.machine, o.model, scales)
            knowing = Knowing(*(turn @ c @ turn.T for c in (o.knowing.prior, o.knowing.posterior, o.knowing.noise)))
            number = observability_number(whole_volume(o.machine, o.model, knowing))
            return replace(
                found,
                observability=replace(o, number=number),
                sources=sources,
                prediction=prediction,
                budget=budget_over(prediction),
                mask=mask,
                left_out=scales,
            )
    return None


def scale_text(found: Assessment) -> str:
    """Return text about the uncertainty without the scales, to end a sentence with; empty unless scales are its largest part."""
    free = found.scale_free
    if free is None or free.left_out is None:
        return ""
    error, largest = _error_rms_mm(free.prediction) * 1e3, float(free.prediction.expanded_vector_mm.max()) * 1e3
    return f"; without {SCALE_TEXTS[free.left_out]}, poorly determined by these runs, {error:.2g} µm rms known to ± {largest:.2g} µm"


def _error_rms_mm(prediction: Prediction) -> float:
    return float(np.sqrt(np.mean(np.sum(prediction.deviation_mm**2, axis=1))))


def model_key(joint: JointSolution) -> str:
    """Return the fitted model and how its order was chosen, e.g. ``rigid21/legendre7+order-by-heldout``."""
    if joint.model == "rigid6":
        return "rigid6" + ("+by-heldout" if joint.order_choice else "")
    return f"{joint.model}/legendre{joint.order}" + ("+order-by-heldout" if joint.order_choice else "+order-given")


def not_observable(found: Assessment) -> list[str]:
    """Return errors that the runs cannot separate, the reason, and the measurement that would separate them."""
    return [g.text for g in found.observability.hidden]


def solution_of(solved: Solved | Assessment) -> SolutionFile:
    """Return the solution as stored: parameters with uncertainty, unobservable motions, residual tests, versions, digests."""
    found = solved if isinstance(solved, Assessment) else assess(solved)
    joint, o, e = found.joint, found.observability, found.joint.estimate
    key = model_key(joint)
    return SolutionFile(
        format=FORMAT,
        model=key,
        order=joint.order,
        versions=Versions(**versions()),
        verdict=_verdict(found),
        inputs=_inputs(found, key.partition("/")[0]),
        parameters={
            p.name: ParameterValue(value=p.value, u=p.u, data_share=p.share, status=p.status) for p in o.parameters if p.value is not None
        },
        mean_over_volume={p.name: MeanValue(value=p.value, u=p.u) for p in found.mean},
        holds_at=found.solved.holds_at,
        reached_mm=dict(zip(AXES, found.solved.reached_mm, strict=False)),
        mean_over_volume_note=f"scales (EXX, EYY, EZZ) hold {SCALE_NOTE}",
        motions={m.name: MotionValue(status=m.status, u=m.u, data_share=m.share, reason=m.reason) for m in o.motions},
        rank=Rank(rank=o.rank, of=len(o.terms), effective_rank=o.observed.effective_rank),
        rough=list(rough_lines(joint)),
        artefacts=artefact_lines(joint) if joint.has_artefacts else [],
        not_observable=not_observable(found),
        advice=[a.text for a in o.advice],
        observability=ObservabilityNumber(
            number=o.number.value, median=o.number.median, verdict=cast(Word, o.number.verdict), text=o.number.text
        ),
        correlations=[CorrelationValue(first=c.first, second=c.second, r=c.r) for c in o.correlations[:LISTED]],
        chi2=e.chi2,
        dof=e.dof,
        variance_factor=e.variance_factor,
        runs=_runs(joint),
        noise=_noise(joint),
        outliers=_outliers(found.solved),
        residual_tests=_residual_tests(joint),
        flags=[f.line for f in found.solved.flags],
        uncertainty=_uncertainty(found),
        prediction=_prediction(found.sources),
        ten_parameter_helix={
            label: {n: MeanValue(value=h.estimate.value(n), u=h.estimate.u(n)) for n in h.estimate.names}
            for label, h in found.solved.helices.items()
        },
        ten_parameter_helix_note=HELIX_NOTE,
        step_diagonals=found.solved.step_totals,
        step_diagonals_note=STEP_NOTE,
    )


def solution_doc(solved: Solved | Assessment) -> Doc:
    """Return `solution_of` as JSON."""
    return as_doc(solution_of(solved))


def as_doc(solution: SolutionFile) -> Doc:
    """Return a solution as JSON, without unset fields."""
    return solution.model_dump(mode="json", by_alias=True, exclude_unset=True)


def solution_verdict(found: Assessment) -> Verdict:
    """Return the verdict on a solution."""
    flagged = len({t.run for t in found.joint.residual_tests if t.flagged})
    number, flags = found.observability.number, len(found.solved.flags)
    return verdict(number, found.prediction, found.mask.share, flags=flags, not_noise=flagged, beside=scale_text(found))


def _verdict(found: Assessment) -> VerdictValue:
    own = solution_verdict(found)
    layout = layout_line(found.observability.number)
    return VerdictValue(word=cast(Word, own.word), text=own.text, reasons=list(own.reasons), layout=layout)


def _inputs(found: Assessment, model: str) -> Inputs:
    machine = machine_digest(found.joint.machine)
    return Inputs(
        digest=campaign_digest(found.solved.digests, "\n".join([model, *found.solved.removed]), machine),
        machine=machine,
        runs=found.solved.digests,
        tables=distinct(found.solved.tables.values()),
    )


def _prediction(sources: ErrorSources) -> StoredPrediction:
    """Return the terms, coefficients in mm and rad, and their covariance from all sources."""
    total = np.zeros((len(sources.terms), len(sources.terms)))
    for s in sources.sources:
        total += s.factor @ s.factor.T
        if s.subtracted is not None:
            total -= s.subtracted @ s.subtracted.T
    return StoredPrediction(
        terms=[(t.motion, t.order, t.axis, t.component) for t in sources.terms],
        coefficients=[float(v) for v in sources.coefficients],
        covariance=PackedMatrix.packed(total),
        scatter_mm=float(np.sqrt(sum(s.scatter_mm**2 for s in sources.sources))),
    )


def _runs(joint: JointSolution) -> dict[str, RunResult]:
    counts = Counter(o.run for o in joint.outliers)
    return {
        r.label: RunResult(readings=r.residual_mm.size, rms_um=r.rms_mm * 1e3, expected_um=r.expected_mm * 1e3, outliers=counts[r.label])
        for r in joint.runs
    }


def _noise(joint: JointSolution) -> dict[str, NoiseFound]:
    return {
        kind: NoiseFound(sigma_um=sigma * 1e3, repeats_um=None if repeats is None else repeats * 1e3)
        for kind, sigma in joint.noise_mm.items()
        for repeats in [joint.noise_repeats_mm.get(kind)]
    }


def _outliers(solved: Solved) -> list[OutlierFound]:
    joint = solved.joint
    return [
        OutlierFound(run=o.run, index=o.index, rows=_rows(solved, o), t_s=_time(joint, o), size_sigma=o.size, weight=o.weight)
        for o in joint.outliers
    ]


def _residual_tests(joint: JointSolution) -> list[ResidualTestResult]:
    return [
        ResidualTestResult(run=t.run, test=t.name, statistic=t.statistic, p=t.p, p_adjusted=t.p_adjusted, flagged=t.flagged, text=t.text)
        for t in joint.residual_tests
    ]


def _uncertainty(found: Assessment) -> Uncertainty:
    p, at = found.prediction, worst_point(found.prediction)
    return Uncertainty(
        frame="best-fit rigid motion over the strokes removed",
        worst_point=WorstPoint(
            at_mm=point(p.points_mm[at]),
            deviation_um=point(p.deviation_mm[at] * 1e3),
            u_um=point(p.u_mm[at] * 1e3),
            expanded_um=point(p.expanded_mm[at] * 1e3),
            expanded_vector_um=float(p.expanded_vector_mm[at]) * 1e3,
        ),
        rms_um=float(np.sqrt(np.mean(p.u_vector_mm**2))) * 1e3,
        budget=[_budget_line(found, line) for line in found.budget.lines],
        compensable_share=found.mask.share,
        without_scale=_without_scale(found.scale_free),
    )


def _without_scale(free: Assessment | None) -> WithoutScale | None:
    if free is None or free.left_out is None:
        return None
    p = free.prediction
    return WithoutScale(
        scales=free.left_out,
        error_um=_error_rms_mm(p) * 1e3,
        rms_um=float(np.sqrt(np.mean(p.u_vector_mm**2))) * 1e3,
        expanded_vector_um=float(p.expanded_vector_mm.max()) * 1e3,
        compensable_share=free.mask.share,
    )


def point(values: F1) -> Point:
    """Convert an array of three numbers to a tuple."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def _budget_line(found: Assessment, line: BudgetLine) -> BudgetLineValue:
    """Describe a source with its evaluation type (A or B) and degrees of freedom, None if infinite."""
    source = found.sources.source(line.name)
    dof = float(source.dof) if np.isfinite(source.dof) else None
    return BudgetLineValue(source=line.name, words=line.text, u_um=line.u_mm * 1e3, share=line.share, type=source.evaluation, dof=dof)


def worst_line(found: Assessment) -> str:
    """Return one line about the point with the largest uncertainty."""
    p, at = found.prediction, worst_point(found.prediction)
    place = ", ".join(f"{v:.0f}" for v in p.points_mm[at])
    return (
        f"Worst known point ({place}) mm: deviation {np.linalg.norm(p.deviation_mm[at]) * 1e3:.1f} µm, "
        f"95 % region of the vector ± {p.expanded_vector_mm[at] * 1e3:.1f} µm (rigid motion removed). {found.mask.text()}"
    )


def noise_lines(joint: JointSolution) -> list[str]:
    """Return the estimated noise of each instrument, and its estimate from repeats alone."""
    names = {"bar": "ball-bar", "laser": "laser"}
    out = []
    for kind, sigma in joint.noise_mm.items():
        repeats = joint.noise_repeats_mm.get(kind)
        more = f", {repeats * 1e3:.2f} µm from repeats alone" if repeats is not None else ", nothing was repeated"
        out.append(f"{names.get(kind, kind)}: {sigma * 1e3:.2f} µm for one reading{more}")
    return out


def _rows(solved: Solved, outlier: Outlier) -> list[int]:
    """Return the first and last row of the run's columns, from 1, that the value was made of."""
    rows = solved.rows.get(outlier.run)
    return [] if rows is None or outlier.index >= len(rows) else [int(v) for v in rows[outlier.index]]


def _time(joint: JointSolution, outlier: Outlier) -> float:
    return float(next(r.t_s[outlier.index] for r in joint.data if r.label == outlier.run))


def outlier_lines(solved: Solved) -> list[str]:
    """Return the outliers with reduced weight, largest first, with their rows in the run's file."""
    joint = solved.joint
    lines = [
        f"run {o.run}, {_rows_text(_rows(solved, o))} (t = {_time(joint, o):.1f} s): {abs(o.size):.1f} sigma, weight {o.weight:.0%}"
        for o in joint.outliers[:LISTED]
    ]
    more = len(joint.outliers) - len(lines)
    return [*lines, f"and {more} more"] if more > 0 else lines


def _rows_text(rows: list[int]) -> str:
    if not rows:
        return "a value"
    first, last = rows
    return f"row {first}" if first == last else f"mean of rows {first} to {last}"


def residual_lines(joint: JointSolution) -> list[str]:
    """Return the flagged residual tests, one line per run, most significant run first."""
    found: dict[str, list[str]] = {}
    for test in sorted((t for t in joint.residual_tests if t.flagged), key=lambda t: t.p_adjusted):
        found.setdefault(test.run, []).append(test.text.removeprefix(f"{test.run}: "))
    return [f"{run}: " + "; ".join(texts) for run, texts in found.items()]
