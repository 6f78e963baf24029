"""Solutions with the volume map, and discoveries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_store import stored_steps
from abbe.service.domain.discovery_file import DiscoveryFile
from abbe.service.domain.finding import ChangedSince
from abbe.service.domain.results import StepRecord
from abbe.service.domain.solution_file import SolutionFile
from abbe.service.errors import Unusable
from abbe.service.identification.solution_field import node_map, stored_field
from abbe.service.queries.reader import Reader, StoredResult, as_stored, of_row, read_as


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
    dZ; ``expanded_um``: their U and the U of the length, k = 2. ``significant``: whether the 95 % ellipsoid around the deviation
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
        raise Unusable(
            f"solution {number} is not in the format abbe-solution/1: another version of Abbe stored it", "solve the campaign again"
        )
    return of_row(SolutionDetail, row, document=document)


def volume_map(reader: Reader, number: int, motions: Sequence[str], nodes: int) -> VolumeMap:
    """Return the volume map of a solution, rounded to 0.001 µm, which is far below every U.

    ``motions``: the map shows their joint effect, or the effect of all motions if empty. ``nodes``: number per axis.
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
