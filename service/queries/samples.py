"""Stretches of a run's samples and evaluated columns; a query reads only the chunks that it needs."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from abbe.drivers.api import BarSample
from abbe.service.domain.measured import ChunkRecord
from abbe.service.errors import NotStored, StoreError
from abbe.service.queries.reader import Reader, as_stored, finite, storable
from abbe.service.runs.codec import BAR_CODEC, JSON_CODEC, decode_bar, decode_json, pack_bar
from abbe.service.runs.columns import IMPORTED_CHANNEL, load_run
from abbe.service.storage.store import Store

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
    """A stretch of the evaluated columns of a run (``abbe-run/1``): every reading with its position. null: the column is sealed."""

    columns: dict[str, list[float | None] | None]


def samples(reader: Reader, run: int, channel: str, first: int, limit: int) -> Samples:
    """Samples ``first`` to ``first + limit - 1`` of a channel.

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
            raise StoreError(f"run {run}, channel {channel!r}: unknown codec ({', '.join(sorted(codecs))})", "use a newer Abbe")
        records = [finite(one) for chunk in found for one in decode_json(chunk.payload)][at]
    return Samples(run=run, channel=channel, first=first, count=len(records), total=total, records=records)


def packed_samples(reader: Reader, run: int, first: int, limit: int) -> tuple[bytes, int]:
    """A stretch of ball-bar samples, packed (18 bytes a sample), and the total number of samples."""
    reader.row("runs", run, "run")
    with as_stored():
        found, at, total = _chunks(reader.store, run, "bar", first, limit)
        taken = [sample for chunk in found for sample in decode_bar(chunk.payload)][at]
    return pack_bar(taken), total


def columns(reader: Reader, run: int, first: int, limit: int) -> RunColumns:
    """Rows ``first`` to ``first + limit - 1`` of a run's evaluated columns.

    Raises
    ------
    NotStored
        There is no such run.
    Unusable, MeasurementFault
        The run is not complete enough for an evaluation.
    """
    reader.row("runs", run, "run")
    with as_stored():
        found = load_run(reader.store, run)["columns"]
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
    """Chunks that contain a stretch, its slice of their samples, and the number of samples in the channel."""
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
            raise StoreError(f"run {run}, chunk {chunk.seq} of channel {channel!r}: stored bytes do not match their CRC")
    return found, slice(first - before, first - before + limit), at
