"""Solutions with the volume map, discoveries, checks and their trends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_store import stored_steps
from abbe.service.domain.discovery_file import DiscoveryFile
from abbe.service.domain.finding import ChangedSince
from abbe.service.domain.results import StepRecord
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.domain.verification import Verification
from abbe.service.errors import Unusable
from abbe.service.identification.solution_field import node_map, stored_field
from abbe.service.queries.reader import Doc, Reader, StoredResult, as_stored, finite, of_row, read_as, storable
from abbe.service.storage.repositories.pages import PageRow
from abbe.service.verification.trend_table import FigureChart, FigureTrend
from abbe.service.verification.trend_table import charts as figure_charts
from abbe.service.verification.verified_by import VerifiedBy, verified_by


@dataclass(frozen=True, slots=True, kw_only=True)
class SolutionSummary(StoredResult):
    """A solution and the runs that it was computed from."""

    kind: str
    runs: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SolutionDetail(SolutionSummary):
    """A solution with every parameter, its standard uncertainty, and the errors that the runs could not show (``not_observable``)."""

    document: SolutionFile


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoverySummary(StoredResult):
    """A search for effects that a campaign's model lacks. ``state``, ``why``: the latest state and its reason; empty before the first."""

    state: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryState:
    """A state that a search reached."""

    state: str
    utc: str
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryDetail(DiscoverySummary):
    """A search with its states and its answer, if any; ``changed``: comparison with an earlier solution, if there was one."""

    states: list[DiscoveryState]
    answer: DiscoveryFile | None
    changed: ChangedSince | None


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenMotion:
    """A motion that the runs cannot show separately, and the reason."""

    motion: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeMap:
    """Deviation (actual minus nominal, best-fit rigid motion removed) at the nodes of an even grid over the strokes, X slowest.

    Nodes lie at every combination of ``x_mm``, ``y_mm``, ``z_mm``. ``motions``: the motions that make up the map. ``deviation_um``: dX, dY,
    dZ; ``expanded_um``: their U and that of the length, k = 2. ``significant``: whether the 95 % ellipsoid around the deviation
    excludes zero; otherwise neither error nor direction is known. ``hidden``: motions without a map of their own.
    """

    solution: int
    motions: list[str]
    nodes: int
    x_mm: list[float]
    y_mm: list[float]
    z_mm: list[float]
    deviation_um: list[tuple[float, float, float]]
    expanded_um: list[tuple[float, float, float, float]]
    significant: list[bool]
    coverage_factor: float = 2.0
    hidden: list[HiddenMotion]


def solutions(
    reader: Reader, campaign: str | None, machine: str | None, cursor: int | None, limit: int
) -> tuple[list[SolutionSummary], int | None]:
    """Return the solutions, newest first."""
    rows, after = reader.page("solutions", {"campaign": campaign, "machine": machine}, cursor, limit)
    return [of_row(SolutionSummary, row) for row in rows], after


def solution(reader: Reader, number: int) -> SolutionDetail:
    """Return a solution: parameters with uncertainties, unobservable quantities, residuals, budget.

    Raises
    ------
    NotStored
        There is no such solution.
    Unusable
        It was stored in another form.
    """
    row = reader.row("solutions", number, "solution")
    document = read_as(SolutionFile, row.doc)
    if document is None:
        raise Unusable(f"solution {number} was stored in another form than abbe-solution/1", "solve the campaign again")
    return of_row(SolutionDetail, row, document=document)


def volume_map(reader: Reader, number: int, motions: Sequence[str], nodes: int) -> VolumeMap:
    """Return the volume map of a solution, rounded to 0.001 µm, which is far below every U.

    ``motions``: the map shows their joint effect, or that of all motions if empty. ``nodes``: number per axis.
    """
    reader.row("solutions", number, "solution")
    with as_stored():
        stored = stored_field(reader.store, reader.store.solutions.get(number))
        found = node_map(stored, nodes, motions)
    grid = found.points_mm.reshape(nodes, nodes, nodes, 3)
    x, y, z = ([round(float(v), 3) for v in axis] for axis in (grid[:, 0, 0, 0], grid[0, :, 0, 1], grid[0, 0, :, 2]))
    return VolumeMap(
        solution=number,
        motions=[name for name in stored.motions if not motions or name in motions],
        nodes=nodes,
        x_mm=x,
        y_mm=y,
        z_mm=z,
        deviation_um=[(dx, dy, dz) for dx, dy, dz in found.deviation_um.round(3).tolist()],
        expanded_um=[(ux, uy, uz, u) for ux, uy, uz, u in (2.0 * found.u_um).round(3).tolist()],
        significant=found.significant.tolist(),
        hidden=[HiddenMotion(motion=name, reason=why) for name, why in stored.hidden.items()],
    )


def discoveries(
    reader: Reader, campaign: str | None, machine: str | None, cursor: int | None, limit: int
) -> tuple[list[DiscoverySummary], int | None]:
    """Return the searches for missing effects, newest first."""
    rows, after = reader.page("discoveries", {"campaign": campaign, "machine": machine}, cursor, limit)
    return [of_row(DiscoverySummary, row, **_last(_states(reader.store.discoveries.steps(row.number)))) for row in rows], after


def discovery(reader: Reader, number: int) -> DiscoveryDetail:
    """Return a search with its states and its answer. Raises NotStored."""
    row = reader.row("discoveries", number, "discovery")
    states = _states(reader.store.discoveries.steps(number))
    found = next((step.finding for step in stored_steps(reader.store, number) if step.finding is not None), None)
    answer = None if found is None else read_as(DiscoveryFile, answer_doc(found))
    changed = None if found is None else found.changed
    return of_row(DiscoveryDetail, row, **_last(states), states=states, answer=answer, changed=changed)


def _states(steps: Sequence[StepRecord]) -> list[DiscoveryState]:
    return [DiscoveryState(state=one.state, utc=one.utc, why=str(one.doc.get("why", ""))) for one in steps]


def _last(states: Sequence[DiscoveryState]) -> dict[str, str]:
    return {"state": states[-1].state, "why": states[-1].why} if states else {"state": "", "why": ""}


CHECKS = 20_000
"""Number of latest checks in a trend: more than ten years at four a day."""
UNSCHEDULED: Doc = {
    "schedule": "", "recipe": "", "duration_s": 0.0, "values": {}, "uncertainties": {}, "limits": {}, "runs": [], "text": "",
}  # fmt: skip
"""Defaults for a check that no schedule ordered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trends:
    """Trends of a machine's figures over its checks, by default those since the table in force became active.

    ``verified``: whether a measurement supports that table, and which.
    """

    machine: str
    figures: Sequence[FigureTrend] = ()
    verified: VerifiedBy = field(default_factory=lambda: VerifiedBy("unknown", "never"))


def checks(
    reader: Reader, machine: str | None, verdict: str | None, cursor: int | None, limit: int
) -> tuple[list[Verification], int | None]:
    """Return the checks of all machines, newest first, without those stored in another form."""
    rows, after = reader.page("verifications", {"machine": machine, "verdict": verdict}, cursor, limit)
    return [one for row in rows if (one := _check(row)) is not None], after


def check(reader: Reader, number: int) -> Verification:
    """Return one check: figures with uncertainties (k = 2), limits, verdict. Raises NotStored, Unusable."""
    row = reader.row("verifications", number, "check")
    found = _check(row)
    if found is None:
        raise Unusable(f"check {number} was stored in another form")
    return found


def latest_checks(reader: Reader, limit: int) -> list[Verification]:
    """Return the latest checks of this service's machine, newest first."""
    return checks(reader, reader.machine, None, None, limit)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class _CheckRow:
    """The columns of a check."""

    number: int
    machine: str
    verdict: str
    utc: str
    doc: Doc


def _check(row: PageRow) -> Verification | None:
    found = of_row(_CheckRow, row)
    known = {"id": found.number, "verdict": found.verdict, "machine": found.machine}
    return read_as(Verification, UNSCHEDULED | {"slot_utc": found.utc, "started_utc": found.utc} | finite(found.doc) | known)


def trends(reader: Reader, machine: str, after_utc: datetime | None = None, limit: int = CHECKS) -> Trends:
    """Return the trend of the figures of a machine's checks: drift, its start, and the days until their limits.

    Uses at most ``limit`` of the checks later than ``after_utc``; None: since the table came into force.
    """
    if not storable(machine):
        return Trends(machine=machine)
    known = verified_by(reader.store, machine, control=reader.control_of(machine))
    found = charts(reader, machine, after_utc or known.since, limit)
    return Trends(machine=machine, figures=[one.as_trend for one in found], verified=known)


def charts(reader: Reader, machine: str, after_utc: datetime | None, limit: int = CHECKS) -> list[FigureChart]:
    """Control charts of a machine's judged figures over at most ``limit`` of its checks, later than ``after_utc``."""
    return figure_charts(reader.store.verifications.of_machine(machine, limit), after_utc)
