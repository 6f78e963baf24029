"""Machines, campaigns, runs, and stretches of their samples and evaluated columns; a query reads only the chunks that it needs."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields

from abbe.drivers.api import BarSample
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import MachineObject
from abbe.service.domain.measured import INCOMPLETE, RUNNING, ChannelRecord, ChunkRecord, Owner, RunFacts, RunRecord, visible_status
from abbe.service.errors import NotStored, StoreError
from abbe.service.queries.reader import Reader, as_stored, finite, of_row, read_as, storable
from abbe.service.runs.chunks import BAR_CODEC, IMPORTED_CHANNEL, JSON_CODEC, decode_bar, decode_json, pack_bar
from abbe.service.sequences.journal import Trouble, not_written, troubles
from abbe.service.storage.repositories.pages import PageRow
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
    """One measured sequence. ``status`` as people see it: a run whose process died is incomplete."""

    number: int
    machine: str
    run_id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignDetail(CampaignSummary):
    """A campaign with its runs in the order of measurement, and the numbers of its solutions and discoveries.

    ``incidents``: incidents of the device links during the measurement, None for an imported campaign; ``incidents_not_written``: number
    of those that the database did not get in time.
    """

    runs: list[RunSummary]
    solutions: list[int]
    discoveries: list[int]
    incidents: list[Trouble] | None
    incidents_not_written: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDetail(RunSummary):
    """A run with its channels. ``gaps``: number of stretches of missing samples."""

    channels: list[ChannelRecord]
    gaps: int


def machines(reader: Reader, name: str | None, cursor: int | None, limit: int) -> tuple[list[MachineDescription], int | None]:
    """Return the descriptions of machines, newest first."""
    rows, after = reader.page("machines", {"name": name}, cursor, limit)
    return [_machine(row) for row in rows], after


def machine(reader: Reader, number: int) -> MachineDescription:
    """Return one description of a machine. Raises NotStored."""
    return _machine(reader.row("machines", number, "machine"))


def _machine(row: PageRow) -> MachineDescription:
    return of_row(MachineDescription, row, description=read_as(MachineObject, row.doc))


def campaigns(reader: Reader, machine: str | None, cursor: int | None, limit: int) -> tuple[list[CampaignSummary], int | None]:
    """Return the campaigns, newest first."""
    rows, after = reader.page("campaigns", {"machine": machine}, cursor, limit)
    return [of_row(CampaignSummary, row) for row in rows], after


def campaign(reader: Reader, number: int) -> CampaignDetail:
    """Return a campaign with its runs. Raises NotStored."""
    row = reader.row("campaigns", number, "campaign")
    filters = {"campaign": reader.store.campaigns.find(number).name}
    runs = [_run(one) for one in reversed(reader.store.pages.page("runs", filters, None, MOST_RUNS))]
    solutions, discoveries = (
        [one.number for one in reader.store.pages.page(kind, filters, None, MOST_RESULTS)] for kind in ("solutions", "discoveries")
    )
    journal = reader.store.checkpoints.of_campaign(number)
    known = {"incidents": troubles(journal) if journal else None, "incidents_not_written": not_written(journal)}
    return of_row(CampaignDetail, row, runs=runs, solutions=solutions, discoveries=discoveries, **known)


def runs(reader: Reader, filters: Mapping[str, str | None], cursor: int | None, limit: int) -> tuple[list[RunSummary], int | None]:
    """Return the runs, newest first, including interrupted ones.

    ``filters`` has ``campaign``, ``machine``, ``test``, ``role`` and ``status`` (as stored: a run whose process died is ``running``
    here); None: any.
    """
    rows, after = reader.page("runs", filters, cursor, limit)
    return [_run(row) for row in rows], after


def runs_by_state(reader: Reader, campaign: str, test: str, state: str, limit: int) -> tuple[list[RunSummary], bool]:
    """Return the newest runs with a visible state (empty: any), and whether there are more."""
    filters = {"campaign": campaign or None, "test": test or None, "status": state or None}
    if state not in (INCOMPLETE, RUNNING):
        found, after = runs(reader, filters, None, limit)
        return found, after is not None
    # The store has both as running; they differ in whether their process still lives.
    fitting = [run for run in runs(reader, filters | {"status": RUNNING}, None, MOST_RUNNING)[0] if run.status == state]
    return fitting[:limit], len(fitting) > limit


def run(reader: Reader, number: int) -> RunDetail:
    """Return one run with its channels. Raises NotStored."""
    row, record = reader.row("runs", number, "run"), reader.store.runs.find(number)
    state, end = record.visible_status, record.end_doc or {}
    known = {"status": state, "reason": _reason(state, record.reason, end)}
    return of_row(RunDetail, row, **known, channels=reader.store.chunks.channels(number), gaps=len(end.get("gaps") or []))


def all_runs(store: Store, campaign: str | None = None) -> list[RunSummary]:
    """Return the runs (of one campaign), oldest first; ``reason`` counts the missing samples of a complete run. Raises NotStored."""
    owners = [store.campaigns.find(campaign)] if campaign is not None else store.campaigns.all()
    names = {one.id: store.machines.get(one.machine_id).name for one in owners}
    found = store.runs.all(owners[0].id if campaign is not None else None)
    return [run_summary(one, names[one.campaign_id]) for one in found]


def run_summary(record: RunRecord, machine: str) -> RunSummary:
    """Return the summary of a full record of a run."""
    row = PageRow(record.id, {one.name: getattr(record, one.name) for one in fields(record)})
    state = record.visible_status
    return of_row(RunSummary, row, machine=machine, run_id=record.label, status=state, reason=_reason(state, record.reason, record.end_doc))


@dataclass(frozen=True, slots=True, kw_only=True)
class _StateColumns:
    """The columns of a run that tell its state."""

    status: str
    reason: str
    owner_host: str
    owner_pid: int
    owner_start: str


def _run(row: PageRow) -> RunSummary:
    found = of_row(_StateColumns, row)
    state = visible_status(found.status, Owner(found.owner_host, found.owner_pid, found.owner_start))
    return of_row(RunSummary, row, status=state, reason=_reason(state, found.reason, None))


def _reason(state: str, reason: str, end: Doc | None) -> str:
    """Return why a run is not complete, or which samples a complete run lacks."""
    if state == INCOMPLETE:
        return "its process ended before the run was closed; the next command that connects to the machine takes over what was saved"
    gaps = (end or {}).get("gaps") or []
    if reason or not gaps:
        return reason
    return f"{len(gaps)} gaps, {sum(gap['last'] - gap['first'] + 1 for gap in gaps if gap.get('last') is not None)} samples missing"


Record = dict[str, float | int | str | bool | list[float | None] | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class BarSamples:
    """Ball-bar samples as they arrived."""

    seq: list[int]
    device_us: list[int]
    reading_nm: list[int]
    status: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleStretch:
    """Rows ``first`` to ``first + count - 1`` of ``total``."""

    run: int
    first: int
    count: int
    total: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples(SampleStretch):
    """A stretch of one channel as it arrived: ball-bar samples by column, or records of another device."""

    channel: str
    bar: BarSamples | None = None
    records: list[Record] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunColumns(SampleStretch):
    """A stretch of the evaluated columns of a run (``abbe-run/1``), every reading with its position; null: readings are withheld."""

    columns: dict[str, list[float | None] | None]


def samples(reader: Reader, run: int, channel: str, first: int, limit: int) -> Samples:
    """Return the samples ``first`` to ``first + limit - 1`` of a channel.

    Raises
    ------
    NotStored
        There is no such run or channel; imported runs have only columns.
    """
    reader.row("runs", run, "run")
    with as_stored():
        found, at, total = _chunks(reader.store, run, channel, first, limit)
        codecs = {chunk.codec for chunk in found}
        if codecs <= {BAR_CODEC} and channel == "bar":
            taken = [sample for chunk in found for sample in decode_bar(chunk.payload)][at]
            return Samples(run=run, channel=channel, first=first, count=len(taken), total=total, bar=_columns(taken))
        if not codecs <= {JSON_CODEC}:
            raise StoreError(f"run {run}, channel {channel!r}: unknown codec ({', '.join(sorted(codecs))})", "use a newer version of Abbe")
        records = [finite(one) for chunk in found for one in decode_json(chunk.payload)][at]
    return Samples(run=run, channel=channel, first=first, count=len(records), total=total, records=records)


def packed_samples(reader: Reader, run: int, first: int, limit: int) -> tuple[bytes, int]:
    """Return a stretch of ball-bar samples, packed (18 bytes a sample), and the total number of samples."""
    reader.row("runs", run, "run")
    with as_stored():
        found, at, total = _chunks(reader.store, run, "bar", first, limit)
        taken = [sample for chunk in found for sample in decode_bar(chunk.payload)][at]
    return pack_bar(taken), total


def columns(reader: Reader, run: int, first: int, limit: int) -> RunColumns:
    """Return the rows ``first`` to ``first + limit - 1`` of a run's evaluated columns.

    Raises
    ------
    NotStored
        There is no such run.
    Unusable, MeasurementFault
        The run is not complete enough for an evaluation.
    """
    from abbe.service.runs.columns import run_document, whole_run  # numpy, which a list of runs does not need

    reader.row("runs", run, "run")
    with as_stored():
        record = reader.store.runs.find(run)
        found = run_document(whole_run(reader.store, record), record, reader.store.chunks.of_run(run))["columns"]
    total = max((len(values) for values in found.values() if values is not None), default=0)
    part = {name: None if values is None else finite(values[first : first + limit]) for name, values in found.items()}
    return RunColumns(run=run, first=first, count=max(0, min(limit, total - first)), total=total, columns=part)


def _columns(taken: list[BarSample]) -> BarSamples:
    return BarSamples(
        seq=[one.seq for one in taken],
        device_us=[one.device_us for one in taken],
        reading_nm=[one.reading_nm for one in taken],
        status=[one.status for one in taken],
    )


def _chunks(store: Store, run: int, channel: str, first: int, limit: int) -> tuple[list[ChunkRecord], slice, int]:
    """Return the chunks that contain a stretch, its slice of their samples, and the number of samples in the channel."""
    sizes = store.chunks.sizes(run, channel) if storable(channel) and channel != IMPORTED_CHANNEL else []
    if not sizes:
        raise NotStored(
            f"run {run} has no samples of channel {channel[:40]!r}", "the run's `channels` name them; imported runs have columns"
        )
    wanted: list[int] = []
    before = at = 0
    for seq, n in sizes:
        if at + n > first and at < first + limit:
            before = at if not wanted else before
            wanted.append(seq)
        at += n
    if not wanted:
        return [], slice(0, 0), at
    found = store.chunks.between(run, channel, wanted[0], wanted[-1])
    for chunk in found:
        if zlib.crc32(chunk.payload) != chunk.crc32:
            raise StoreError(
                f"run {run}, chunk {chunk.seq} of channel {channel!r}: stored bytes do not match their CRC", "restore a backup"
            )
    return found, slice(first - before, first - before + limit), at
