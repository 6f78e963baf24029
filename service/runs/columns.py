"""Read stored runs: the only place where raw samples become columns.

`abbe.service.domain.measured` describes the documents beside the samples, `abbe.service.runs.chunks` the bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from abbe.service.domain.document import Doc, parsed
from abbe.service.domain.measured import BarRecord, ChunkRecord, LaserRecord, RunRecord, RunStart, TouchRecord
from abbe.service.domain.run import AnySetup, ArtefactSetup, BarSetup, Columns, Run, RunTiming, parsed_setup
from abbe.service.errors import MeasurementFault, StoreError, StretchDiffers
from abbe.service.runs.chunks import (
    BAR_CHANNEL,
    BAR_CODEC,
    IMPORTED_CHANNEL,
    JSON_CODEC,
    LASER_CHANNEL,
    decode_json,
    whole_samples,
)
from abbe.service.runs.coverage import with_state
from abbe.service.runs.pieces import ReadProgress, counted_columns, progress_of
from abbe.service.runs.sample_columns import (
    BAR_SAMPLE,
    BarSamples,
    RunClock,
    bar_columns,
    bar_point_columns,
    laser_columns,
    run_clock,
    starts_in_stream,
    sync_edges,
)
from abbe.service.runs.touches import qualified_mm, touch_columns
from abbe.service.storage.store import Store


def bar_samples(chunks: Sequence[ChunkRecord]) -> BarSamples:
    """Unpack the samples of chunks ``bar/1`` in order; as `decode_bar`, but for millions of them. Raises StoreError."""
    raw = bytearray()
    for chunk in chunks:
        raw += whole_samples(chunk.payload)  # grows in place: a list of all chunks would take as much memory again
    return np.frombuffer(raw, BAR_SAMPLE)


def load_run(store: Store, id_or_label: int | str, *, full: bool = True) -> Run:
    """Read a run with its pieces and its artefact from the store; an incomplete one has a ``state`` (`abbe.service.runs.coverage`).

    ``full`` False: the readings of a ball-bar path without their positions and without a ``state``, in half the time.

    Raises
    ------
    StoreError
        The run is missing, damaged, or too incomplete.
    MeasurementFault
        Its samples contradict its path, or its campaign does not describe its artefact.
    """
    record = store.runs.find(id_or_label)
    run = whole_run(store, record, full=full)
    return run.with_artefact(store.campaigns.find(record.campaign_id).known) if run.is_artefact else run


def whole_run(store: Store, record: RunRecord, *, full: bool = True) -> Run:
    """Return a run joined with its pieces, the interrupted runs whose path it resumed; arguments and errors like `load_run`."""
    run = single_run(record, store.chunks.of_run(record.id), full=full)
    pieces = record.start.pieces
    if not pieces:
        return with_state(run, record) if full else run
    broken = [(store.runs.find(p.run), p.to_mm) for p in pieces]
    earlier = [single_run(one, store.chunks.of_run(one.id), full=full) for one, _ in broken]
    parts = [counted_columns(record, one.columns, to_mm) for (record, to_mm), one in zip(broken, earlier, strict=True)]
    named = [{"run": one.label, "readings": len(part)} for (one, _), part in zip(broken, parts, strict=True)]
    timing = run.timing.document | {"pieces": named}
    troubles = [f"in {one.run_id}: {one.timing.trouble}" for one in earlier if one.timing.trouble]
    if troubles and not run.timing.trouble:
        timing["trouble"] = troubles[0]
    columns = Columns.concatenated([*parts, run.columns])
    joined = replace(run, columns=columns, timing=RunTiming.from_document(timing))
    return with_state(joined, record, broken[0][0].start) if full else joined


def run_document(run: Run, record: RunRecord, chunks: Sequence[ChunkRecord]) -> Doc:
    """Return a run as an ``abbe-run/1`` document; an imported run as it was imported, including unknown keys."""
    imported = _imported(record, chunks)
    if imported is None:
        return run.to_document()
    return imported | ({} if run.state is None else {"state": run.state.to_document()})


def path_progress(store: Store, run: int) -> ReadProgress | None:
    """Return how far a path was read by its last interrupted run ``run`` and the pieces before it; None if it has to start again."""
    record = store.runs.find(run)
    if record.reason.startswith(StretchDiffers.code):
        return None  # either of the two readings of the stretch may be wrong
    try:
        chunks = store.chunks.of_run(run)
        one = single_run(record, chunks)
        samples = bar_samples(_of(chunks, BAR_CHANNEL, BAR_CODEC))
        found = progress_of(record, one.columns) if starts_in_stream(samples) and not one.timing.trouble else None
    except (StoreError, MeasurementFault):
        found = None  # an unreadable run does not count
    if found is not None:
        return found
    earlier = record.start.pieces
    return path_progress(store, earlier[-1].run) if earlier else None


def single_run(record: RunRecord, chunks: Sequence[ChunkRecord], *, full: bool = True) -> Run:
    """Return a run without its pieces, from all its chunks in order of seq within a channel; ``full`` as in `load_run`.

    Raises
    ------
    StoreError
        The start document or a chunk is malformed.
    MeasurementFault
        The samples contradict the path.
    """
    imported = _imported(record, chunks)
    if imported is not None:
        return replace(Run.from_document(imported), ended_utc=record.ended_utc or "")
    try:
        start = record.start
        columns, timing = _measured(record, start, chunks, full=full)
        _check_documents(record)
        return Run(
            campaign=record.campaign,
            run_id=record.label,
            test=record.test,
            role=record.role,
            machine=start.machine,
            setup=_qualified(_setup(record), chunks),
            columns=columns,
            table=start.table,  # a solution is meaningful only together with the active table
            timing=RunTiming.from_document(timing),
            ended_utc=record.ended_utc or "",
        )
    except (AttributeError, KeyError, TypeError, ValueError) as err:
        raise StoreError(
            f"run {record.campaign}/{record.label}: its documents have a missing or invalid field: {err}",
            "Abbe did not write this, or the database is damaged: restore a backup",
        ) from None


def _check_documents(record: RunRecord) -> None:
    """Raise KeyError if an entry is missing on which readings depend: set-up, machine, clock, rate or start of a path."""
    for key in ("machine", "setup", "ctrl0_us", *(("rate_hz",) if record.start_doc.get("path") else ())):
        record.start_doc[key]
    if record.end.path_end_us and record.end.path_start_us is None:
        raise KeyError("path_start_us")


def _imported(record: RunRecord, chunks: Sequence[ChunkRecord]) -> Doc | None:
    """Return an imported run exactly as it was imported; None for a measured run."""
    imported = record.start_doc.get("imported")
    return None if imported is None else dict(imported) | {"columns": unpack_columns(chunks)}  # the key keeps its place


def _setup(record: RunRecord) -> AnySetup:
    """Return the set-up with its mounting time."""
    setup, mounted_us = parsed_setup(record.test, record.start.setup), record.end.mounted_us
    return setup if mounted_us is None else setup.mounted(record.start.since_zero_s(mounted_us))


def pack_columns(columns: Doc) -> list[dict[str, Any]]:
    """Return the imported columns (name to list or None) as records for ``json/1``, one per column in order."""
    return [{"name": name, "values": values} for name, values in columns.items()]


def unpack_columns(chunks: Sequence[ChunkRecord]) -> Doc:
    """Return the imported columns (name to list or None) from the chunks of a run, in the order of the file."""
    records = [record for chunk in _of(chunks, IMPORTED_CHANNEL, JSON_CODEC) for record in decode_json(chunk.payload)]
    return {record["name"]: record["values"] for record in records}


def _measured(record: RunRecord, start: RunStart, chunks: Sequence[ChunkRecord], *, full: bool) -> tuple[Columns, Doc]:
    """Return the columns and the ``timing`` document."""
    if record.test.startswith("ballbar") and not start.point_by_point:
        bar_chunks = _of(chunks, BAR_CHANNEL, BAR_CODEC)
        samples = bar_samples(bar_chunks)
        edges, complete = sync_edges(samples, start), record.status == "complete"
        clock = RunClock(1.0, 0.0, {}) if edges is None else run_clock(bar_chunks, record.end, edges)
        return bar_columns(samples, start, record.end, complete=complete, rate=clock.rate, full=full), clock.doc
    setup = _setup(record)
    if isinstance(setup, ArtefactSetup):
        return touch_columns(_touches(chunks), start, setup.pose), {}
    records = _records(chunks)
    if isinstance(setup, BarSetup):
        return bar_point_columns([parsed(BarRecord, one) for one in records], start), {}
    if setup.nominal_beam is None:
        raise KeyError("nominal_beam")
    return laser_columns([parsed(LaserRecord, one) for one in records], start, setup.nominal_beam), {}


def _records(chunks: Sequence[ChunkRecord]) -> list[dict[str, Any]]:
    return [one for chunk in _of(chunks, LASER_CHANNEL, JSON_CODEC) for one in decode_json(chunk.payload)]


def _touches(chunks: Sequence[ChunkRecord]) -> list[TouchRecord]:
    return [parsed(TouchRecord, one) for one in _records(chunks)]


def _qualified(setup: AnySetup, chunks: Sequence[ChunkRecord]) -> AnySetup:
    """Return the set-up of an artefact with the radius of the stylus that a qualification sphere showed; other set-ups stay as they are."""
    stated = setup.document.get("tool_radius_mm")
    found = qualified_mm(_touches(chunks), float(stated)) if isinstance(setup, ArtefactSetup) and stated is not None else None
    return setup if found is None else setup.noted(tool_radius_mm=round(found[0], 6), u_tool_radius_mm=round(found[1], 6))


def _of(chunks: Sequence[ChunkRecord], channel: str, codec: str) -> list[ChunkRecord]:
    found = [chunk for chunk in chunks if chunk.channel == channel]
    for chunk in found:
        if chunk.codec != codec:
            raise StoreError(
                f"run {chunk.run_id}, chunk {chunk.seq} of channel {channel!r}: unknown codec {chunk.codec!r}",
                "use a newer version of Abbe",
            )
    return found
