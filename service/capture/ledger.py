"""Accounts for every sequence number of a run: stored as valid, stored with a flag, or in an explicit gap. Pure bookkeeping.

`Drafter` turns batches into chunks and gaps; `streams_doc` and `joined` list which chunks belong to which stream. A stream is one series of
ball-bar samples, numbered from 0; a run has several if the ball-bar was started again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from abbe.drivers.api import BarBatch, BarSample, bar_is_valid, bar_reasons, overran
from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.segment import CHUNK, CLOSE, GAP, OPEN, Record, Scan
from abbe.service.domain.measured import ChunkRecord
from abbe.service.runs.chunks import BAR_CODEC, JSON_CODEC, decode_bar, decode_json, encode_bar, encode_json
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True)
class SampleGap:
    """A gap of missing samples.

    ``stream``: number of the stream in the run, from 0; ``first``, ``last``: sequence numbers, ``last`` None if unknown; ``before_us``,
    ``after_us``: device clock of the neighbouring samples.
    """

    stream: int
    first: int
    last: int | None
    cause: str
    before_us: int | None
    after_us: int | None

    @property
    def missing(self) -> int:
        """Number of missing samples; 0 if unknown."""
        return 0 if self.last is None else self.last - self.first + 1

    def doc(self) -> dict[str, Any]:
        """Return the gap as JSON object."""
        return asdict(self)

    @staticmethod
    def of(doc: dict[str, Any]) -> SampleGap:
        """Return the gap in a JSON object."""
        return SampleGap(*(doc[name] for name in SampleGap.__dataclass_fields__))


@dataclass(slots=True)
class Ledger:
    """Account of one run's sequence numbers. Samples and gaps come in any order; `unaccounted` lists the numbers that no entry covers."""

    flagged: dict[str, int] = field(default_factory=dict)
    gaps: list[SampleGap] = field(default_factory=list)
    invalid: int = 0
    _stored: dict[int, list[list[int]]] = field(default_factory=dict)

    def add_samples(self, stream: int, samples: Sequence[BarSample]) -> None:
        """Enter stored samples with consecutive numbers."""
        self.add_span(stream, samples[0].seq, samples[-1].seq)
        for sample in samples:
            if not bar_is_valid(sample.status):  # flagged samples are stored, too
                self.invalid += 1
                for reason in bar_reasons(sample.status):
                    self.flagged[reason] = self.flagged.get(reason, 0) + 1

    def add_span(self, stream: int, first: int, last: int) -> None:
        """Enter stored samples without flags, by their first and last number."""
        spans = self._stored.setdefault(stream, [])
        if spans and spans[-1][1] + 1 == first:
            spans[-1][1] = last
        else:
            spans.append([first, last])

    def add_gap(self, gap: SampleGap) -> None:
        """Enter missing samples."""
        self.gaps.append(gap)

    @property
    def stored(self) -> int:
        """Number of stored samples, with and without flags."""
        return sum(last - first + 1 for spans in self._stored.values() for first, last in spans)

    def stored_spans(self, stream: int = 0) -> list[tuple[int, int]]:
        """Return the first and last number of every contiguous part of a stream."""
        return [(first, last) for first, last in sorted(self._stored.get(stream, []))]

    def unaccounted(self) -> list[tuple[int, int, int]]:
        """Return stream, first and last number of every range that neither a sample nor a gap covers, up to the highest known number."""
        found = []
        for stream in sorted({*self._stored, *(gap.stream for gap in self.gaps)}):
            at = 0
            for first, last in self._covered(stream):
                if first > at:
                    found.append((stream, at, first - 1))
                at = max(at, last + 1)
        return found

    def ends(self) -> dict[int, int]:
        """Return the sequence number after the highest known one, by stream."""
        streams = sorted({*self._stored, *(gap.stream for gap in self.gaps)})
        return {stream: max((last + 1 for _, last in self._covered(stream)), default=0) for stream in streams}

    def duplicates(self) -> int:
        """Return how many entries are superfluous because another one covers the same sequence number."""
        count = 0
        for stream in sorted({*self._stored, *(gap.stream for gap in self.gaps)}):
            at = 0
            for first, last in self._covered(stream):
                count += max(0, min(at, last + 1) - first)
                at = max(at, last + 1)
        return count

    @property
    def in_gaps(self) -> int:
        """Number of samples known to be missing."""
        return sum(gap.missing for gap in self.gaps)

    @property
    def uncovered(self) -> int:
        """Number of samples that no entry covers."""
        return sum(last - first + 1 for _, first, last in self.unaccounted())

    def doc(self) -> dict[str, Any]:
        """Return the totals as JSON object."""
        return {
            "stored_valid": self.stored - self.invalid,
            "stored_flagged": self.invalid,
            "flags": dict(self.flagged),
            "in_gaps": self.in_gaps,
            "gaps": len(self.gaps),
            "unaccounted": self.uncovered,
        }

    def _covered(self, stream: int) -> list[tuple[int, int]]:
        spans = [(first, last) for first, last in self._stored.get(stream, [])]
        return sorted(spans + [(g.first, g.last) for g in self.gaps if g.stream == stream and g.last is not None])


BAR, GAPS, RUN = "bar", "gaps", "run"
MAX_SAMPLES = 4096
WIRE = "lost or damaged on the line"
BOX = "lost in the ball-bar's box (buffer overrun)"
SLOW = "this computer did not keep up: the driver's buffer was full"

Item = tuple[int, BarBatch] | tuple[str, dict[str, Any]]
"""A stream number with a ball-bar batch, or a channel name with another record."""


@dataclass(slots=True)
class _OpenStream:
    number: int
    next_seq: int = 0
    last_us: int | None = None


class Drafter:
    """Turns a run's data into records and enters them into the ledger. ``utc_offset_s`` returns UTC minus monotonic host time."""

    def __init__(self, run: int, utc_offset_s: Callable[[], float]) -> None:
        self.ledger = Ledger()
        self._run, self._offset_s = run, utc_offset_s
        self._numbers: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._stream = _OpenStream(-1)

    @property
    def last_seq(self) -> int:
        """Highest sequence number of the current stream so far, -1 for none."""
        return self._stream.next_seq - 1

    def mark(self) -> object:
        """Return the state of the numbering, for `reset`."""
        return dict(self._numbers), dict(self._counts), replace(self._stream)

    def reset(self, mark: object) -> None:
        """Return to the numbering at `mark`, because the records since then did not reach the disk."""
        assert isinstance(mark, tuple)
        self._numbers, self._counts, self._stream = mark

    def opening(self, doc: dict[str, Any]) -> Record:
        """Return the first record, which describes the run."""
        return self._json(OPEN, RUN, [doc])

    def closing(self, doc: dict[str, Any]) -> Record:
        """Return the last record, with the outcome of the run."""
        return self._json(CLOSE, RUN, [doc])

    def drafts(self, items: list[Item]) -> list[Record]:
        """Return records for all items in order. Leaves the ledger alone: nothing is on the disk yet."""
        found: list[Record] = []
        batches: list[BarBatch] = []
        others: dict[str, list[dict[str, Any]]] = {}
        for item in items:
            if isinstance(item[1], BarBatch):
                stream, batch = int(item[0]), item[1]
                if batches and (batch.missing or stream != self._stream.number or _count(batches) >= MAX_SAMPLES):
                    found += self._chunks(batches)
                    batches = []
                if stream != self._stream.number:
                    self._stream = _OpenStream(stream)
                if batch.missing:
                    found.append(self._gap(batch))
                batches.append(batch)
            else:
                others.setdefault(str(item[0]), []).append(item[1])
        if batches:
            found += self._chunks(batches)
        return found + [self._json(CHUNK, channel, records) for channel, records in others.items()]

    def book(self, items: list[Item], gaps: list[Record]) -> None:
        """Enter items and gaps that are now on the disk into the ledger."""
        for stream, batch in items:
            if isinstance(batch, BarBatch) and batch.samples:
                self.ledger.add_samples(int(stream), batch.samples)
        for record in gaps:
            self.ledger.add_gap(gap_of(record))

    def lost(self, cause: str, last: int | None, after_us: int | None, stream: int | None = None) -> Record:
        """Return the record of a gap that begins at the next expected number, in the current stream or in a later one."""
        at = self._stream if stream in (None, self._stream.number) else _OpenStream(int(stream or 0))
        if last is not None and last < at.next_seq:  # the numbers went back: the end is unknown
            last = None
        return self.gap_record(SampleGap(max(0, at.number), at.next_seq, last, cause, at.last_us, after_us))

    def gap_record(self, gap: SampleGap) -> Record:
        """Return the record of a gap."""
        record = self._json(GAP, GAPS, [gap.doc()])
        return replace(record, stream=gap.stream, first_seq=gap.first, count=gap.missing)

    def _gap(self, batch: BarBatch) -> Record:
        first = batch.samples[0]
        cause = SLOW if batch.overran else BOX if overran(first.status) else WIRE
        return self.lost(cause, first.seq - 1 if first.seq else None, first.device_us)

    def _chunks(self, batches: list[BarBatch]) -> list[Record]:
        samples = [sample for batch in batches for sample in batch.samples]
        if not samples:
            return []
        self._stream.next_seq, self._stream.last_us = samples[-1].seq + 1, samples[-1].device_us
        pieces = [samples[at : at + MAX_SAMPLES] for at in range(0, len(samples), MAX_SAMPLES)]
        return [self._chunk(piece, batches) for piece in pieces]

    def _chunk(self, samples: list[BarSample], batches: list[BarBatch]) -> Record:
        flags = 0
        for sample in samples:
            flags |= sample.status
        return Record(
            CHUNK,
            self._run,
            BAR,
            BAR_CODEC,
            self._number(BAR),
            self._stream.number,
            batches[-1].boot_id,
            samples[0].seq,
            len(samples),
            flags,
            samples[0].device_us,
            samples[-1].device_us,
            batches[0].host_s,
            batches[-1].host_s,
            self._offset_s(),
            encode_bar(samples),
        )

    def _json(self, kind: int, channel: str, records: list[dict[str, Any]]) -> Record:
        first, last = records[0], records[-1]
        begun = self._counts.get(channel, 0)
        self._counts[channel] = begun + len(records)
        return Record(
            kind,
            self._run,
            channel,
            JSON_CODEC,
            self._number(channel),
            first_seq=begun,
            count=len(records),
            first_us=int(first.get("ctrl_us", 0)),
            last_us=int(last.get("ctrl_us", 0)),
            first_host_s=float(first.get("host_s", 0.0)),
            last_host_s=float(last.get("host_s", 0.0)),
            utc_offset_s=self._offset_s(),
            payload=encode_json(records),
        )

    def _number(self, channel: str) -> int:
        number = self._numbers.get(channel, 0)
        self._numbers[channel] = number + 1
        return number


def gap_of(record: Record) -> SampleGap:
    """Decode the gap in a record."""
    return SampleGap.of(decode_json(record.payload)[0])


def _count(batches: list[BarBatch]) -> int:
    return sum(len(batch.samples) for batch in batches)


DAMAGED = "the segment is damaged here"
TORN = "the end of the segment is torn or damaged: the number of its samples is unknown"


def ledger_of(chunks: list[ChunkRecord], streams: dict[int, int] | None = None) -> Ledger:
    """Return the ledger of a stored run from the chunks of all its channels.

    ``streams``: stream of each chunk by chunk number, if known from a segment. Other chunks begin a stream where sequence numbers go back.

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
    """Return the streams of the ball-bar's chunks, for the run's account: first chunk, last chunk and stream of every contiguous part."""
    return joined([], [[one.chunk_no, one.chunk_no, one.stream] for one in records if one.kind == CHUNK and one.channel == BAR])


def joined(spans: list[list[int]], more: list[list[int]]) -> list[list[int]]:
    """Return the parts of both lists (as of `streams_doc`) in one list, adjacent parts of one stream merged."""
    spans = [list(span) for span in spans]
    for first, last, stream in more:
        if spans and spans[-1][1] + 1 == first and spans[-1][2] == stream:
            spans[-1][1] = last
        else:
            spans.append([first, last, stream])
    return spans


def streams_from_end_doc(end_doc: dict[str, Any] | None) -> dict[int, int] | None:
    """Return the stream of every chunk by its number; None if the run's end document does not state it (open run, or older version)."""
    spans = ((end_doc or {}).get("capture") or {}).get("streams")
    if spans is None:
        return None
    return {chunk: stream for first, last, stream in spans for chunk in range(first, last + 1)}


def settle(store: Store, run_id: int, scanned: Scan) -> Ledger:
    """Return the ledger of a run whose good records are all in the database, and store its damaged ranges there as gaps.

    Raises
    ------
    StoreError
        The database refuses the gaps, or a chunk cannot be unpacked.
    """
    keys = store.chunks.crcs(run_id)
    known = {(record.channel, record.chunk_no) for record in scanned.records if record.kind in (CHUNK, GAP)}
    broken = bool(scanned.damaged or scanned.broken_links)
    if broken or not keys.keys() <= known:  # inspect every sample only if the segment is incomplete
        streams = {one.chunk_no: one.stream for one in scanned.records if one.kind == CHUNK and one.channel == BAR}
        ledger = ledger_of(store.chunks.of_run(run_id), streams)
    else:
        ledger = _of_headers(scanned)
    holes = _holes(ledger, scanned) if broken or scanned.tail_bytes else []
    begun = 1 + max((number for channel, number in {*keys, *known} if channel == GAPS), default=-1)
    drafter = Drafter(run_id, lambda: 0.0)
    store.chunks.ingest([chunk_of(replace(drafter.gap_record(gap), chunk_no=begun + k)) for k, gap in enumerate(holes)])
    for gap in holes:
        ledger.add_gap(gap)
    return ledger


def _holes(ledger: Ledger, scanned: Scan) -> list[SampleGap]:
    found = [SampleGap(stream, first, last, DAMAGED, None, None) for stream, first, last in ledger.unaccounted()]
    ends = ledger.ends()
    for record in scanned.records:
        if record.kind == CLOSE:  # states the last durable sequence number
            stream, seq = decode_json(record.payload)[0].get("durable", {}).get(BAR, (0, -1))
            if seq >= ends.get(stream, 0):
                found.append(SampleGap(stream, ends.get(stream, 0), seq, DAMAGED, None, None))
                ends[stream] = seq + 1
    if scanned.tail_bytes and not scanned.closed:
        stream = max(ends, default=0)
        found.append(SampleGap(stream, ends.get(stream, 0), None, TORN, None, None))
    return found


def _of_headers(scanned: Scan) -> Ledger:
    ledger = Ledger()
    for record in scanned.records:
        if record.kind == GAP:
            ledger.add_gap(gap_of(record))
        elif record.kind == CHUNK and record.channel == BAR:
            if not bar_is_valid(record.flags):
                ledger.add_samples(record.stream, decode_bar(record.payload))
            else:
                ledger.add_span(record.stream, record.first_seq, record.first_seq + record.count - 1)
    return ledger
