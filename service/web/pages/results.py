"""Solutions and discoveries for the screens: lists, and single results with their pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from abbe.models.arrays import F1, F2
from abbe.models.geometry.volume import unit_deviation, volume_frame, volume_grid
from abbe.models.machine import Machine
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Rules, machine_from_doc
from abbe.service.domain.results import SolutionRecord
from abbe.service.domain.solution_file import MotionValue, SolutionFile, StoredPrediction, stored_solution
from abbe.service.errors import AbbeError
from abbe.service.queries.reader import Reader
from abbe.service.queries.results import DiscoveryDetail, discovery
from abbe.service.rendering.document import Document, Sign
from abbe.service.rendering.model import Contribution
from abbe.service.rendering.numbers import plain, with_uncertainty
from abbe.service.rendering.plots.bars import contribution_bars
from abbe.service.report.report_discovery import DECIDED, discovery_report
from abbe.service.report.report_measured import SOLUTION_SIGNS
from abbe.service.storage.store import Store
from abbe.service.web.frame import current

# Contribution of each error motion of a machine, from a stored solution with its full covariance.
#
# The contribution of a motion is the rms length of the deviation that it alone causes, over an even grid of the volume, with the best-fit
# rigid motion removed (the pose of the workpiece is no machine error): c = sqrt(theta^T G theta), G the mean square of its terms.
# Its uncertainty follows from the covariance of theta (GUM 5.1.2); near zero, where the direction is unknown, the worst direction counts,
# as in `abbe.service.verification.deviations`. The squares of the contributions do not add up to the square of the whole, since motions can
# compensate each other.


NODES = 6
HIDDEN = "not observable"


@dataclass(frozen=True, slots=True)
class Ranked:
    """An error motion: contribution and standard uncertainty in µm, whether the runs show it separately, and if not, why."""

    name: str
    value_um: float
    u_um: float
    status: str
    reason: str

    @property
    def hidden(self) -> bool:
        """Whether the runs cannot show the motion separately."""
        return self.status == HIDDEN

    @property
    def shown(self) -> tuple[str, str]:
        """Value and U (k = 2), rounded together."""
        return with_uncertainty(self.value_um, self.u_um)

    @property
    def contribution(self) -> Contribution:
        """The motion as a bar of the picture."""
        return Contribution(self.name, self.value_um, self.u_um)


def ranking(prediction: StoredPrediction, motions: Mapping[str, MotionValue], machine: Machine) -> list[Ranked]:
    """Every motion of a stored solution, largest contribution first; ``machine``: nominal geometry of the measured machine."""
    terms, coefficients, covariance = prediction.unpacked()
    points = volume_grid(machine.stroke_mm, NODES)
    design = unit_deviation(machine, terms, points, None, volume_frame(machine))
    out = []
    for name in dict.fromkeys(t.motion for t in terms):
        at = [k for k, t in enumerate(terms) if t.motion == name]
        part = design[:, :, at]
        mean_square = np.einsum("mik,mil->kl", part, part) / len(points)
        value, u = _size(mean_square, coefficients[at], covariance[np.ix_(at, at)])
        known = motions.get(name)
        status, reason = ("", "") if known is None else (known.status, known.reason)
        out.append(Ranked(name, value * 1e3, u * 1e3, status, reason))
    return sorted(out, key=lambda r: -r.value_um)


def _size(mean_square: F2, coefficients: F1, covariance: F2) -> tuple[float, float]:
    """Rms of a motion's effect over the nodes, and its standard uncertainty; an upper bound of u if the rms is not significant."""
    values, vectors = np.linalg.eigh(mean_square)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    vector, spread = root @ coefficients, root @ covariance @ root.T
    size = float(np.linalg.norm(vector))
    worst = float(np.sqrt(max(np.linalg.eigvalsh(spread)[-1], 0.0)))
    if size <= 2.0 * worst:
        return size, worst
    along = vector / size
    return size, float(np.sqrt(max(along @ spread @ along, 0.0)))


MOST_SOLUTIONS = 20
"""Largest number of solutions in the list: each has half a megabyte, and more would make the list slow."""


@dataclass(frozen=True, slots=True)
class SolutionLine:
    """One solution in the list."""

    id: int
    campaign: str
    model: str
    sign: Sign
    word: str
    created_utc: str


@dataclass(frozen=True, slots=True)
class ResultScreen:
    """One solution. ``campaign_id``: number of its campaign, whose report contains the solution. ``ranked``: empty if the
    solution lacks the covariance; ``picture``: contributions that the runs show; ``runs``: number of each run (None: it is not stored
    here), and its cells.
    """

    line: SolutionLine
    campaign_id: int
    text: str
    ranked: Sequence[Ranked]
    picture: Markup
    not_observable: Sequence[str]
    advice: Sequence[str]
    budget: Sequence[tuple[str, str, str]]
    runs: Sequence[tuple[int | None, Sequence[str]]]
    flags: Sequence[str]

    @property
    def hidden(self) -> list[Ranked]:
        """Motions that the runs cannot show separately."""
        return [r for r in self.ranked if r.hidden]


@dataclass(frozen=True, slots=True)
class DiscoveryScreen:
    """One search with its states and its report; ``document`` None: unfinished or unreadable, ``trouble`` has the reason."""

    found: DiscoveryDetail
    document: Document | None
    trouble: str = ""


def solution_lines(store: Store, limit: int = MOST_SOLUTIONS) -> list[SolutionLine]:
    """Solutions of campaigns, newest first."""
    names = {c.id: c.name for c in store.campaigns.all()}
    newest = store.solutions.latest("joint", limit)
    return [_line(s, names.get(s.campaign_id, "")) for s in newest if "mean_over_volume" in s.doc]


def _line(record: SolutionRecord, campaign: str) -> SolutionLine:
    verdict = record.doc.get("verdict") or {}
    word = str(verdict.get("word", ""))
    return SolutionLine(record.id, campaign, str(record.doc.get("model", "")), SOLUTION_SIGNS.get(word, "open"), word, record.created_utc)


def result_screen(store: Store, record: SolutionRecord) -> ResultScreen:
    """A solution with its motions by contribution to the machine's error."""
    solution, campaign = stored_solution(record.doc, record.id), store.campaigns.find(record.campaign_id)
    ranked = _ranked(solution, store.machines.get(campaign.machine_id).doc)
    shown = [r.contribution for r in ranked if not r.hidden]
    known = {run.label: run.id for run in store.runs.all(campaign.id) if run.id in record.run_ids}
    # The SVG writer has already escaped every text.
    picture = Markup(contribution_bars(shown, unit=current().drawn())) if shown else Markup("")  # noqa: S704
    return ResultScreen(
        _line(record, campaign.name),
        campaign.id,
        "" if solution.verdict is None else solution.verdict.text,
        ranked,
        picture,
        solution.not_observable,
        solution.advice,
        [(b.text, plain(b.u_um, 2), f"{b.share:.0%}") for b in solution.uncertainty.budget],
        [(known.get(k), (k, str(r.readings), plain(r.rms_um), plain(r.expected_um), str(r.outliers))) for k, r in solution.runs.items()],
        solution.flags,
    )


def _ranked(solution: SolutionFile, machine: Doc) -> list[Ranked]:
    if solution.prediction is None:
        return []  # an earlier version stored no covariance
    geometry: Machine = machine_from_doc(machine)
    return ranking(solution.prediction, solution.motions, geometry)


def discovery_screen(reader: Reader, number: int, rules: Rules) -> DiscoveryScreen:
    """A search as stored. Raises NotStored."""
    found = discovery(reader, number)
    try:
        report = discovery_report(reader.store, number, rules)
        # The screen shows the states with their times, so it omits the report's table of states.
        appendix = [s for s in report.appendix if s.title != DECIDED]
        return DiscoveryScreen(found, replace(report, appendix=appendix))
    except AbbeError as error:
        return DiscoveryScreen(found, None, error.detail)
