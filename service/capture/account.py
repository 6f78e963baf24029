"""What a run has, number by number, after a crash: from its segment's headers where they tell all, else from the stored chunks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from abbe.drivers.flags import bar_is_valid
from abbe.service.capture.drafts import BAR, GAPS, Drafter, gap_of
from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.ledger import Ledger, SampleGap
from abbe.service.capture.records import CHUNK, CLOSE, GAP, Record
from abbe.service.capture.scan import Scan
from abbe.service.domain.measured import ChunkRecord
from abbe.service.runs.codec import decode_bar, decode_json
from abbe.service.storage.store import Store

DAMAGED = "the segment is damaged here"
TORN = "the end of the segment is torn or damaged: it is not known how many samples were in it"


def ledger_of(chunks: list[ChunkRecord], streams: dict[int, int] | None = None) -> Ledger:
    """Account of a stored run: every sequence number of its ball-bar streams.

    Parameters
    ----------
    chunks : list of ChunkRecord
        Of all channels.
    streams : dict, optional
        Stream of a chunk by its number, where a segment tells; else a new one begins where the numbers go back.

    Raises
    ------
    StoreError
        A chunk cannot be unpacked.
    """
    ledger, stream, last = Ledger(), 0, -1
    for chunk in sorted((one for one in chunks if one.channel == BAR), key=lambda one: one.seq):
        samples = decode_bar(chunk.payload)
        known = (streams or {}).get(chunk.seq)
        stream = known if known is not None else stream + (samples[0].seq <= last)
        ledger.add_samples(stream, samples)
        last = samples[-1].seq
    for chunk in chunks:
        if chunk.channel == GAPS:
            for doc in decode_json(chunk.payload):
                ledger.add_gap(SampleGap.of(doc))
    return ledger


def streams_doc(records: Iterable[Record]) -> list[list[int]]:
    """Of which stream the ball-bar's chunks are: first chunk, last chunk, stream, for every unbroken piece. Goes into the run's account."""
    return joined([], [[one.chunk_no, one.chunk_no, one.stream] for one in records if one.kind == CHUNK and one.channel == BAR])


def joined(spans: list[list[int]], more: list[list[int]]) -> list[list[int]]:
    """Pieces as `streams_doc` has them, and more behind them; those that follow each other in one stream become one."""
    spans = [list(span) for span in spans]
    for first, last, stream in more:
        if spans and spans[-1][1] + 1 == first and spans[-1][2] == stream:
            spans[-1][1] = last
        else:
            spans.append([first, last, stream])
    return spans


def streams_told(end_doc: dict[str, Any] | None) -> dict[int, int] | None:
    """Stream of every chunk by its number, as the run's end document has it; None: it does not say (still open, or of an older version)."""
    spans = ((end_doc or {}).get("capture") or {}).get("streams")
    if spans is None:
        return None
    return {chunk: stream for first, last, stream in spans for chunk in range(first, last + 1)}


def settle(store: Store, run_id: int, held: Scan) -> Ledger:
    """Account of a run whose good records are all in the database; what damage has swallowed is declared there as gaps.

    Raises
    ------
    StoreError
        The database does not take it now, or a chunk cannot be unpacked.
    """
    keys = store.chunk_keys(run_id)
    known = {(record.channel, record.chunk_no) for record in held.records if record.kind in (CHUNK, GAP)}
    broken = bool(held.damaged or held.broken_links)
    if broken or not keys.keys() <= known:  # only where the segment does not tell all is every sample looked at
        streams = {one.chunk_no: one.stream for one in held.records if one.kind == CHUNK and one.channel == BAR}
        ledger = ledger_of(store.chunks(run_id), streams)
    else:
        ledger = _of_headers(held)
    holes = _holes(ledger, held) if broken or held.tail_bytes else []
    begun = 1 + max((number for channel, number in {*keys, *known} if channel == GAPS), default=-1)
    drafter = Drafter(run_id, lambda: 0.0)
    store.ingest_chunks([chunk_of(replace(drafter.gap_record(gap), chunk_no=begun + k)) for k, gap in enumerate(holes)])
    for gap in holes:
        ledger.add_gap(gap)
    return ledger


def _holes(ledger: Ledger, held: Scan) -> list[SampleGap]:
    found = [SampleGap(stream, first, last, DAMAGED, None, None) for stream, first, last in ledger.unaccounted()]
    ends = ledger.ends()
    for record in held.records:
        if record.kind == CLOSE:  # it says up to where everything had been made safe
            stream, seq = decode_json(record.payload)[0].get("durable", {}).get(BAR, (0, -1))
            if seq >= ends.get(stream, 0):
                found.append(SampleGap(stream, ends.get(stream, 0), seq, DAMAGED, None, None))
                ends[stream] = seq + 1
    if held.tail_bytes and not held.closed:
        stream = max(ends, default=0)
        found.append(SampleGap(stream, ends.get(stream, 0), None, TORN, None, None))
    return found


def _of_headers(held: Scan) -> Ledger:
    ledger = Ledger()
    for record in held.records:
        if record.kind == GAP:
            ledger.add_gap(gap_of(record))
        elif record.kind == CHUNK and record.channel == BAR:
            if not bar_is_valid(record.flags):
                ledger.add_samples(record.stream, decode_bar(record.payload))
            else:
                ledger.add_span(record.stream, record.first_seq, record.first_seq + record.count - 1)
    return ledger
