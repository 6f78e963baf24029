"""A stored run becomes an ``abbe-run/1`` document: the one place where raw samples turn into columns.

Start document: ``setup`` and ``machine`` of the exchange format, ``ctrl0_us`` (zero of the campaign clock in controller time), and for
ball-bar runs ``path`` {``feed_mm_min``, ``direction``, ``points_mm``} and ``rate_hz``. ``points_mm`` begins where the machine stands when
the path starts. End document of a ball-bar run: ``path_start_us``, ``path_end_us`` (controller time). For a run without end document the
path's start is taken from the start document: ``path_start_us``, else ``clock.ctrl_us``, else the setup's ``t_set_s``.
``path.measured``: first and last point of ``points_mm`` between which readings count; without it all do. A ball-bar run whose
setup says how many ``samples`` make a reading was read at standstill, point by point: it has no ``path``, and its
records stand where those of a laser run do.
``path.pieces`` (run, to_mm) and ``path.offset_mm``: the path was broken off and went on (abbe.service.sequences.path_resume);
``points_mm`` is its rest, and the readings of the broken runs belong to it up to those lengths. The end document of a broken run says how
far it came at constant feed: ``path_start_us``, ``good_us``, ``box_boot_id``.
``clock_pairs`` of the end document: controller time (us) and arrival (host s) of its statuses; they check the sync line
(abbe.service.runs.clocks; ``timing`` of the result says what came of it).
``mounted_us`` is when cup or laser were mounted (controller time); the start document is written before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from abbe.drivers.flags import bar_is_valid
from abbe.service.domain.document import Doc
from abbe.service.domain.measured import ChunkRecord, RunRecord
from abbe.service.errors import MeasurementFault, StoreError, StretchDiffers
from abbe.service.runs.bar_columns import bar_columns, begins_seen, sync_edges
from abbe.service.runs.clocks import RunClock, run_clock
from abbe.service.runs.codec import BAR_CODEC, JSON_CODEC, decode_bar, decode_json
from abbe.service.runs.coverage import with_state
from abbe.service.runs.laser_columns import laser_columns
from abbe.service.runs.pieces import SoFar, joined, pieces_of, read_so_far, up_to
from abbe.service.storage.store import Store

# Ball-bar readings at standstill become columns: one row for each point, the mean of the samples that were taken there.


def bar_point_columns(records: Sequence[dict[str, Any]], start: Doc) -> Doc:
    """Turn the records of a point-by-point ball-bar test into columns.

    Parameters
    ----------
    records : sequence of dict
        ``ctrl_us`` (controller time, after the axes had settled), ``target_mm``, ``direction``, ``feed_mm_min``, and for every sample
        ``device_us``, ``reading_nm``, ``status``; in order.
    start : dict
        Start document (abbe.service.runs.columns).

    Returns
    -------
    dict
        Columns of ``abbe-run/1`` and ``reading_u_mm`` (standard uncertainty of each mean), ``samples_count``, ``device_us`` of the first
        sample.
    """
    means = [np.mean(one["reading_nm"]) * 1e-6 for one in records]
    return {
        "t_s": [(one["ctrl_us"] - start["ctrl0_us"]) * 1e-6 for one in records],
        **{f"{axis}_mm": [float(one["target_mm"][index]) for one in records] for index, axis in enumerate("xyz")},
        "feed_mm_min": [float(one["feed_mm_min"]) for one in records],
        "direction": [int(one["direction"]) for one in records],
        "deviation_mm": [float(m) for m in means],
        "valid": [1 if all(bar_is_valid(s) for s in one["status"]) else 0 for one in records],
        "reading_u_mm": [_u_mm(one["reading_nm"]) for one in records],
        "samples_count": [len(one["reading_nm"]) for one in records],
        "device_us": [int(one["device_us"][0]) for one in records],
    }


def _u_mm(reading_nm: Sequence[int]) -> float:
    n = len(reading_nm)
    return float(np.std(reading_nm, ddof=1) * 1e-6 / np.sqrt(n)) if n > 1 else 0.0


FORMAT = "abbe-run/1"
BAR_CHANNEL = "bar"
LASER_CHANNEL = "laser"
IMPORTED_CHANNEL = "columns"


def load_run(store: Store, id_or_label: int | str) -> Doc:
    """Read a run from the store as an ``abbe-run/1`` document.

    Parameters
    ----------
    store : Store
        Open store.
    id_or_label : int or str
        As ``Store.run`` takes it.

    Returns
    -------
    dict
        The document.

    Raises
    ------
    StoreError
        If the run is not there, damaged, or not complete enough to be understood.
    MeasurementFault
        If its samples contradict its path.
    """
    return whole_document(store, store.runs.find(id_or_label))


def whole_document(store: Store, record: RunRecord) -> Doc:
    """A run with the pieces that belong to it, as an ``abbe-run/1`` document; errors as of `load_run`.

    One that is not complete says so under ``state`` (`abbe.service.runs.coverage`).
    """
    document = run_document(record, store.chunks.of_run(record.id))
    pieces = pieces_of(record.start_doc)
    if not pieces:
        return with_state(document, record)
    broken = [(store.runs.find(p.run), p.to_mm) for p in pieces]
    pieces_doc = [run_document(run, store.chunks.of_run(run.id)) for run, _ in broken]
    parts = [up_to(run, one["columns"], to_mm) for (run, to_mm), one in zip(broken, pieces_doc, strict=True)]
    named = [{"run": run.label, "readings": len(part["t_s"])} for (run, _), part in zip(broken, parts, strict=True)]
    timing = document.get("timing", {}) | {"pieces": named}
    troubles = [f"in {run.label}: {text}" for (run, _), one in zip(broken, pieces_doc, strict=True) if (text := _trouble(one))]
    if troubles and "trouble" not in timing:
        timing["trouble"] = troubles[0]
    return with_state(document | {"columns": joined([*parts, document["columns"]]), "timing": timing}, record, broken[0][0].start_doc)


def _trouble(document: Doc) -> str:
    return str(document.get("timing", {}).get("trouble", ""))


def path_so_far(store: Store, run: int) -> SoFar | None:
    """How far a path was read by its last broken run and the pieces before it; None if it has to begin again."""
    record = store.runs.find(run)
    if record.reason.startswith(StretchDiffers.code):
        return None  # nobody knows which of the two was right
    try:
        chunks = store.chunks.of_run(run)
        document = run_document(record, chunks)
        samples = [sample for chunk in _of(chunks, BAR_CHANNEL, BAR_CODEC) for sample in decode_bar(chunk.payload)]
        found = read_so_far(record, document["columns"]) if begins_seen(samples) and not _trouble(document) else None
    except (StoreError, MeasurementFault):
        found = None  # it cannot be read: it counts as nothing
    if found is not None:
        return found
    earlier = pieces_of(record.start_doc)
    return path_so_far(store, earlier[-1].run) if earlier else None


def run_document(record: RunRecord, chunks: Sequence[ChunkRecord]) -> Doc:
    """Turn a run and its chunks into an ``abbe-run/1`` document.

    Parameters
    ----------
    record : RunRecord
        The run.
    chunks : sequence of ChunkRecord
        All its chunks, in order of seq within a channel.

    Returns
    -------
    dict
        With plain lists of Python numbers; an imported run comes back exactly as it was, unknown keys included.

    Raises
    ------
    StoreError
        If start document or chunks cannot be understood.
    MeasurementFault
        If its samples contradict its path.
    """
    imported = record.start_doc.get("imported")
    if imported is not None:
        return dict(imported) | {"columns": unpack_columns(chunks)}  # the key stands in "imported" too, so its place is kept
    document: Doc = {"format": FORMAT, "campaign": record.campaign, "run_id": record.label, "test": record.test, "role": record.role}
    try:
        columns, timing = _measured(record, chunks)
        document |= {"machine": record.start_doc["machine"], "setup": _setup(record.start_doc, record.end_doc), "columns": columns}
    except (KeyError, TypeError) as err:
        raise StoreError(
            f"run {record.campaign}/{record.label}: its documents lack or garble {err}", "it was not written by Abbe"
        ) from None
    # which compensation table was active: a solution is only meaningful together with it, so it travels with the run
    document |= {"table": record.start_doc["table"]} if "table" in record.start_doc else {}
    return document | ({"timing": timing} if timing else {})


def _setup(start: Doc, end: Doc | None) -> Doc:
    """The set-up with the instant at which it was mounted."""
    setup: Doc = start["setup"]
    if not end or "mounted_us" not in end:
        return setup
    return setup | {"t_set_s": (end["mounted_us"] - start["ctrl0_us"]) * 1e-6}


def pack_columns(columns: Doc) -> list[dict[str, Any]]:
    """Lay out imported columns as records for ``json/1``.

    Parameters
    ----------
    columns : dict
        Name to list (or None).

    Returns
    -------
    list of dict
        One record a column, in order.
    """
    return [{"name": name, "values": values} for name, values in columns.items()]


def unpack_columns(chunks: Sequence[ChunkRecord]) -> Doc:
    """Read imported columns back.

    Parameters
    ----------
    chunks : sequence of ChunkRecord
        Chunks of the run.

    Returns
    -------
    dict
        Name to list (or None), in the order of the file.
    """
    records = [record for chunk in _of(chunks, IMPORTED_CHANNEL, JSON_CODEC) for record in decode_json(chunk.payload)]
    return {record["name"]: record["values"] for record in records}


def _measured(record: RunRecord, chunks: Sequence[ChunkRecord]) -> tuple[Doc, Doc]:
    """The columns, and what is to be said of the clocks."""
    if record.test.startswith("ballbar") and "samples" not in record.start_doc.get("setup", {}):
        bar_chunks = _of(chunks, BAR_CHANNEL, BAR_CODEC)
        samples = [sample for chunk in bar_chunks for sample in decode_bar(chunk.payload)]
        edges, complete = sync_edges(samples, record.start_doc), record.status == "complete"
        clock = RunClock(1.0, 0.0, {}) if edges is None else run_clock(bar_chunks, record.end_doc, edges)
        return bar_columns(samples, record.start_doc, record.end_doc, complete=complete, rate=clock.rate), clock.doc
    records = [one for chunk in _of(chunks, LASER_CHANNEL, JSON_CODEC) for one in decode_json(chunk.payload)]
    make = bar_point_columns if record.test.startswith("ballbar") else laser_columns
    return make(records, record.start_doc), {}


def _of(chunks: Sequence[ChunkRecord], channel: str, codec: str) -> list[ChunkRecord]:
    found = [chunk for chunk in chunks if chunk.channel == channel]
    for chunk in found:
        if chunk.codec != codec:
            raise StoreError(
                f"run {chunk.run_id}, chunk {chunk.seq} of channel {channel!r}: unknown codec {chunk.codec!r}", "use a newer Abbe"
            )
    return found
