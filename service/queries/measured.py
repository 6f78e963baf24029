"""Machines, campaigns and runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from abbe.service.domain.document import Doc
from abbe.service.domain.machine_object import MachineObject
from abbe.service.domain.measured import INCOMPLETE, RUNNING, ChannelRecord, RunFacts, RunRecord
from abbe.service.queries.reader import Reader, of_row, read_as
from abbe.service.storage.repositories.pages import visible_status
from abbe.service.storage.store import Store

MOST_RUNS = 10_000
MOST_RESULTS = 1000
MOST_RUNNING = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDescription:
    """One description of a machine; a changed description has a number of its own. ``description`` None: stored in another form."""

    number: int
    name: str
    created_utc: str
    description: MachineObject | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSummary:
    """A campaign: runs that belong together."""

    number: int
    name: str
    machine: str
    created_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary(RunFacts):
    """One measured sequence. ``status`` is the visible one: a run whose process died is incomplete."""

    number: int
    machine: str
    run_id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignDetail(CampaignSummary):
    """A campaign with its runs in the order of measurement, and the numbers of its solutions and discoveries."""

    runs: list[RunSummary]
    solutions: list[int]
    discoveries: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDetail(RunSummary):
    """A run with its channels. ``gaps``: number of stretches of missing samples."""

    channels: list[ChannelRecord]
    gaps: int


def machines(reader: Reader, name: str | None, cursor: int | None, limit: int) -> tuple[list[MachineDescription], int | None]:
    """Descriptions of machines, newest first."""
    rows, after = reader.page("machines", {"name": name}, cursor, limit)
    return [_machine(row) for row in rows], after


def machine(reader: Reader, number: int) -> MachineDescription:
    """One description of a machine. Raises NotStored."""
    return _machine(reader.row("machines", number, "machine"))


def _machine(row: Doc) -> MachineDescription:
    return of_row(MachineDescription, row, description=read_as(MachineObject, row["doc"]))


def campaigns(reader: Reader, machine: str | None, cursor: int | None, limit: int) -> tuple[list[CampaignSummary], int | None]:
    """Campaigns, newest first."""
    rows, after = reader.page("campaigns", {"machine": machine}, cursor, limit)
    return [of_row(CampaignSummary, row) for row in rows], after


def campaign(reader: Reader, number: int) -> CampaignDetail:
    """A campaign with its runs. Raises NotStored."""
    row = reader.row("campaigns", number, "campaign")
    filters = {"campaign": row["name"]}
    runs = [_run(one) for one in reversed(reader.store.pages.page("runs", filters, None, MOST_RUNS))]
    solutions, discoveries = (
        [one["id"] for one in reader.store.pages.page(kind, filters, None, MOST_RESULTS)] for kind in ("solutions", "discoveries")
    )
    return of_row(CampaignDetail, row, runs=runs, solutions=solutions, discoveries=discoveries)


def runs(reader: Reader, filters: Mapping[str, str | None], cursor: int | None, limit: int) -> tuple[list[RunSummary], int | None]:
    """Runs, newest first, including those that were broken off.

    ``filters`` has ``campaign``, ``machine``, ``test``, ``role`` and ``status`` (as stored: a run whose process died is ``running``
    here); None: any.
    """
    rows, after = reader.page("runs", filters, cursor, limit)
    return [_run(row) for row in rows], after


def runs_by_state(reader: Reader, campaign: str, test: str, state: str, limit: int) -> tuple[list[RunSummary], bool]:
    """The newest runs with a visible state (empty: any), and whether there are more."""
    filters = {"campaign": campaign or None, "test": test or None, "status": state or None}
    if state not in (INCOMPLETE, RUNNING):
        found, after = runs(reader, filters, None, limit)
        return found, after is not None
    # The store has both as running; they differ in whether their process still lives.
    fitting = [run for run in runs(reader, filters | {"status": RUNNING}, None, MOST_RUNNING)[0] if run.status == state]
    return fitting[:limit], len(fitting) > limit


def run(reader: Reader, number: int) -> RunDetail:
    """One run with its channels. Raises NotStored."""
    row = reader.row("runs", number, "run")
    end = reader.store.runs.find(number).end_doc or {}
    state = visible_status(row)
    known = {"run_id": row["label"], "status": state, "reason": _reason(state, row["reason"], end)}
    return of_row(RunDetail, row, **known, channels=reader.store.chunks.channels(number), gaps=len(end.get("gaps") or []))


def all_runs(store: Store, campaign: str | None = None) -> list[RunSummary]:
    """Runs (of one campaign), oldest first; ``reason`` of a complete run with gaps counts the missing samples. Raises NotStored."""
    owners = [store.campaigns.find(campaign)] if campaign is not None else store.campaigns.all()
    names = {one.id: store.machines.get(one.machine_id).name for one in owners}
    found = store.runs.all(owners[0].id if campaign is not None else None)
    return [run_summary(one, names[one.campaign_id]) for one in found]


def run_summary(record: RunRecord, machine: str) -> RunSummary:
    """Summary of a complete record."""
    row = {one.name: getattr(record, one.name) for one in fields(record)}
    state = record.visible_status
    return of_row(RunSummary, row, machine=machine, run_id=record.label, status=state, reason=_reason(state, record.reason, record.end_doc))


def _run(row: Doc) -> RunSummary:
    state = visible_status(row)
    return of_row(RunSummary, row, run_id=row["label"], status=state, reason=_reason(state, row["reason"], None))


def _reason(state: str, reason: str, end: Doc | None) -> str:
    """Why a run is not complete, or which samples a complete run lacks."""
    if state == INCOMPLETE:
        return "its process ended before the run was closed; the next command that connects to the machine takes over what was saved"
    gaps = (end or {}).get("gaps") or []
    if reason or not gaps:
        return reason
    return f"{len(gaps)} gaps, {sum(gap['last'] - gap['first'] + 1 for gap in gaps if gap.get('last') is not None)} samples missing"
