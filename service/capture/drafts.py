"""Batches from the device become records: samples between two gaps share a chunk, every gap gets its own record. No thread, no file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from abbe.drivers.api import BarBatch, BarSample
from abbe.drivers.flags import overran
from abbe.service.capture.ledger import Ledger, SampleGap
from abbe.service.capture.records import CHUNK, CLOSE, GAP, OPEN, Record
from abbe.service.runs.codec import BAR_CODEC, JSON_CODEC, decode_json, encode_bar, encode_json

BAR, GAPS, RUN = "bar", "gaps", "run"
MAX_SAMPLES = 4096
WIRE = "lost or damaged on the line"
BOX = "the box lost them (buffer overrun)"
SLOW = "this computer did not keep up: the ring was full"

Item = tuple[int, BarBatch] | tuple[str, dict[str, Any]]
"""A batch with its stream, or a record with its channel."""


@dataclass(slots=True)
class _Stream:
    number: int
    next_seq: int = 0
    last_us: int | None = None


class Drafter:
    """Turns what a run produces into records and books it.

    Parameters
    ----------
    run : int
        Run in the database.
    utc_offset_s : callable
        UTC minus monotonic host time, now.
    """

    def __init__(self, run: int, utc_offset_s: Callable[[], float]) -> None:
        self.ledger = Ledger()
        self._run, self._offset_s = run, utc_offset_s
        self._numbers: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._stream = _Stream(-1)

    @property
    def last_seq(self) -> int:
        """Highest sequence number of the present stream so far, -1 for none."""
        return self._stream.next_seq - 1

    def mark(self) -> object:
        """Where the numbering stands, for `reset`."""
        return dict(self._numbers), dict(self._counts), replace(self._stream)

    def reset(self, mark: object) -> None:
        """Number as if what was drafted since `mark` had never been: it did not get onto the disk."""
        assert isinstance(mark, tuple)
        self._numbers, self._counts, self._stream = mark

    def opening(self, doc: dict[str, Any]) -> Record:
        """The first record: who measures what."""
        return self._json(OPEN, RUN, [doc])

    def closing(self, doc: dict[str, Any]) -> Record:
        """The last record: how it ended."""
        return self._json(CLOSE, RUN, [doc])

    def drafts(self, items: list[Item]) -> list[Record]:
        """Records for everything that came, in order. The ledger is not touched: nothing is on the disk yet."""
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
                    self._stream = _Stream(stream)
                if batch.missing:
                    found.append(self._gap(batch))
                batches.append(batch)
            else:
                others.setdefault(str(item[0]), []).append(item[1])
        if batches:
            found += self._chunks(batches)
        return found + [self._json(CHUNK, channel, records) for channel, records in others.items()]

    def book(self, items: list[Item], gaps: list[Record]) -> None:
        """Enter into the ledger what is on the disk now."""
        for stream, batch in items:
            if isinstance(batch, BarBatch) and batch.samples:
                self.ledger.add_samples(int(stream), batch.samples)
        for record in gaps:
            self.ledger.add_gap(gap_of(record))

    def lost(self, cause: str, last: int | None, after_us: int | None, stream: int | None = None) -> Record:
        """A gap from the next expected number on, of the present stream or of a later one that nothing was drafted of."""
        at = self._stream if stream in (None, self._stream.number) else _Stream(int(stream or 0))
        if last is not None and last < at.next_seq:  # nobody knows: the numbers went back
            last = None
        return self.gap_record(SampleGap(max(0, at.number), at.next_seq, last, cause, at.last_us, after_us))

    def gap_record(self, gap: SampleGap) -> Record:
        """The record of a gap."""
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
    """The gap that a record tells of."""
    return SampleGap.of(decode_json(record.payload)[0])


def _count(batches: list[BarBatch]) -> int:
    return sum(len(batch.samples) for batch in batches)
