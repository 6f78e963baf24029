"""The 21 error motions with U; for a chosen motion, also the runs that show it and the error that a table for it would leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from abbe.models.arrays import F1
from abbe.models.solvers.observability.rank import run_sensitivity
from abbe.service.domain.document import Doc
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import SolutionFile, stored_solution
from abbe.service.errors import AbbeError
from abbe.service.identification.solution_field import StoredField, stored_field
from abbe.service.rendering.model import MotionCurve
from abbe.service.rendering.numbers import COVERAGE, plain, with_uncertainty
from abbe.service.rendering.plots.tables import motion_bands
from abbe.service.report.solution_sections import curves_of
from abbe.service.runs.columns import load_run
from abbe.service.runs.observations import run_data, with_earliest_mounting
from abbe.service.storage.store import Store
from abbe.service.web.frame import current
from abbe.service.web.pages.results import Ranked, ranking

TURNS = {"AX": "roll", "BX": "pitch", "CX": "yaw", "AY": "pitch", "BY": "roll", "CY": "yaw", "CZ": "roll"}
SQUARE = {"C0Y": "XY", "B0Z": "XZ", "A0Z": "YZ"}


@dataclass(frozen=True, slots=True)
class MotionLine:
    """One of the 21 motions: name in words; largest value with its U, and largest U over the stroke.

    ``hidden``: the runs do not show this motion by itself.
    """

    name: str
    text: str
    unit: str
    largest: tuple[str, str]
    u: str
    status: str
    hidden: bool
    contribution: tuple[str, str]


@dataclass(frozen=True, slots=True)
class RunLine:
    """One run and its view of the motion: change of its readings for 10 µm or 10 µrad, their noise, and its share of the information."""

    label: str
    number: int
    readings: int
    change: str
    noise: str
    share: float


@dataclass(frozen=True, slots=True)
class ChosenMotion:
    """A chosen motion. ``series``: its curve for the script, None for a squareness; ``reason``: why it gets no table of its own."""

    line: MotionLine
    series: Doc | None
    runs: Sequence[RunLine]
    reason: str
    alike: Sequence[str]
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class MotionsScreen:
    """All motions of a solution."""

    number: int
    campaign: str
    pictures: Sequence[Markup] = ()
    lines: Sequence[MotionLine] = ()
    chosen: ChosenMotion | None = None
    trouble: str = ""


def motions_screen(store: Store, record: SolutionRecord, motion: str) -> MotionsScreen:
    """The motions of a stored solution; ``motion``: the chosen one, empty for none."""
    campaign = store.campaigns.find(record.campaign_id).name
    try:
        stored, solution = stored_field(store, record), stored_solution(record.doc, record.id)
    except AbbeError as error:
        return MotionsScreen(record.id, campaign, trouble=error.detail)
    assert solution.prediction is not None  # `stored_field` has refused one without
    known = stored.known
    curves = curves_of(known.terms, known.coefficients, known.covariance, known.machine.stroke_mm, stored.statuses)
    ranked = {one.name: one for one in ranking(solution.prediction, solution.motions, known.machine)}
    lines = [_line(name, stored, {c.name: c for c in curves}, ranked[name]) for name in stored.motions]
    link = f"/motions?id={record.id}&motion="
    units = list(dict.fromkeys(c.unit for c in curves))
    # Our own writer has escaped every text.
    pictures = [Markup(motion_bands([c for c in curves if c.unit == u], key=f"motions-{i}", link=link)) for i, u in enumerate(units)]  # noqa: S704
    line = next((one for one in lines if one.name == motion), None)
    chosen = None if line is None else _chosen(store, record, stored, solution, line, next((c for c in curves if c.name == motion), None))
    return MotionsScreen(record.id, campaign, pictures, lines, chosen)


def motion_text(name: str) -> str:
    """An error motion in the reader's words, e.g. "straightness of X in Y"."""
    translate = current().translate
    if name in SQUARE:
        return translate("motion.square", first=SQUARE[name][0], second=SQUARE[name][1])
    what, axis = name[1], name[2]
    if what == axis:
        return translate("motion.positioning", axis=axis)
    if what in "XYZ":
        return translate("motion.straight", axis=axis, out=what)
    turn = TURNS.get(what + axis)
    return translate(f"motion.{turn}", axis=axis) if turn else translate("motion.tilt", axis=axis, about="XYZ"["ABC".index(what)])


def _line(name: str, stored: StoredField, curves: dict[str, MotionCurve], ranked: Ranked) -> MotionLine:
    curve = curves.get(name)
    if curve is None:
        at = next(i for i, t in enumerate(stored.known.terms) if t.motion == name)
        value, u = np.array([stored.known.coefficients[at] * 1e6]), np.sqrt(np.array([stored.known.covariance[at, at]])) * 1e6
        unit = "µrad"
    else:
        value, u, unit = curve.value, curve.u, curve.unit
    where = int(np.argmax(np.abs(value)))
    shown = _with_u(float(value[where]), float(u[where]), unit)
    widest = plain(COVERAGE * float(u.max()) / current().drawn(unit).size, 2)
    contribution = current().with_u(ranked.value_um, ranked.u_um)
    return MotionLine(name, motion_text(name), current().unit(unit), shown, widest, ranked.status, ranked.hidden, contribution)


def _with_u(value: float, u: float, unit: str) -> tuple[str, str]:
    return current().with_u(value, u, unit) if unit == "µm" else with_uncertainty(value, u)


def _chosen(
    store: Store, record: SolutionRecord, stored: StoredField, solution: SolutionFile, line: MotionLine, curve: MotionCurve | None
) -> ChosenMotion:
    series = None if curve is None else _series(curve)
    ours = {t.name for t in stored.known.terms if t.motion == line.name}
    pairs = [(p.first, p.second, p.r) for p in solution.correlations if (p.first in ours) != (p.second in ours)]
    alike = [f"{a if b in ours else b} ({r:+.2f})" for a, b, r in pairs][:6]
    reason = solution.motions[line.name].reason if line.name in solution.motions else ""
    try:
        runs, trouble = _runs(store, record, stored, solution, line.name), ""
    except (AbbeError, ValueError, KeyError) as error:
        runs, trouble = [], error.detail if isinstance(error, AbbeError) else str(error)
    return ChosenMotion(line, series, runs, reason, alike, trouble)


def _runs(store: Store, record: SolutionRecord, stored: StoredField, solution: SolutionFile, motion: str) -> list[RunLine]:
    """The runs of a solution, the most informative first."""
    records = {one.label: one for one in store.runs.all(record.campaign_id)}
    used = [label for label in solution.runs if label in records]
    runs = tuple(run_data(run) for run in with_earliest_mounting([load_run(store, records[label].id) for label in used]))
    names, sensitivity = run_sensitivity(stored.known.machine, stored.known.terms, runs)
    change: F1 = sensitivity[:, names.index(motion)] * (1e-2 if _turns(motion) else 10.0)
    noise = np.array([solution.runs[label].expected_um for label in used])
    count = np.array([solution.runs[label].readings for label in used])
    information = count * (change / noise) ** 2
    share = information / information.sum() if information.sum() > 0.0 else information
    reader = current()
    lines = [
        RunLine(label, records[label].id, int(n), reader.length(plain(float(c), 2)), reader.length(plain(float(s), 2)), float(part))
        for label, n, c, s, part in zip(used, count, change, noise, share, strict=True)
    ]
    return sorted(lines, key=lambda one: -one.share)


def _turns(motion: str) -> bool:
    return motion in SQUARE or motion[1] in "ABC"


def _series(curve: MotionCurve) -> Doc:
    """The curve with U for the script, in the reader's units."""
    frame = current()
    size, place = frame.drawn(curve.unit).size if curve.unit == "µm" else 1.0, frame.drawn("mm")
    unit = frame.unit(curve.unit)
    return {
        "key": curve.name,
        "name": motion_text(curve.name),
        "unit": unit,
        "x_name": f"{curve.axis} [{place.sign}]",
        "x": [float(f"{v:.6g}") for v in curve.position_mm / place.size],
        "y": [float(f"{v:.4g}") for v in curve.value / size],
        "u": [float(f"{v:.4g}") for v in COVERAGE * curve.u / size],
        "shown": [with_uncertainty(float(v), float(u)) for v, u in zip(curve.value / size, curve.u / size, strict=True)],
        "dashed": curve.status == "not observable",
    }
