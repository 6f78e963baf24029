"""Stretches of a run's samples: only the chunks that are asked for are read and unpacked."""

from __future__ import annotations

import zlib

from abbe.service.errors import NotStored, StoreError
from abbe.service.runs.codec import BAR_CODEC, JSON_CODEC, decode_bar, decode_json, pack_bar
from abbe.service.runs.columns import IMPORTED_CHANNEL, load_run
from abbe.service.storage.records import ChunkRecord
from abbe.service.storage.store import Store
from abbe.service.web.api.shapes import BarSamples, Columns, Samples
from abbe.service.web.api.sources import as_stored, finite, storable

JSON_ROWS = 10_000
BINARY_ROWS = 100_000


def stretch(store: Store, run: int, channel: str, first: int, limit: int) -> Samples:
    """Samples ``first`` to ``first + limit - 1`` of a channel.

    Raises
    ------
    NotStored
        The run has no such channel; what was imported has only columns.
    """
    with as_stored():
        found, before, total = _chunks(store, run, channel, first, limit)
        codecs = {chunk.codec for chunk in found}
        at = slice(first - before, first - before + limit)
        if codecs <= {BAR_CODEC} and channel == "bar":
            samples = [sample for chunk in found for sample in decode_bar(chunk.payload)][at]
            names = ("seq", "device_us", "reading_nm", "status")
            bar = BarSamples(**{name: [getattr(one, name) for one in samples] for name in names})
            return Samples(run=run, channel=channel, first=first, count=len(samples), total=total, bar=bar)
        if not codecs <= {JSON_CODEC}:
            raise StoreError(f"run {run}, channel {channel!r}: packed in another way ({', '.join(sorted(codecs))})", "use a newer Abbe")
        records = [finite(one) for chunk in found for one in decode_json(chunk.payload)][at]
    return Samples(run=run, channel=channel, first=first, count=len(records), total=total, records=records)


def binary_stretch(store: Store, run: int, first: int, limit: int) -> tuple[bytes, int]:
    """The same of the ball-bar, packed, and how many samples there are in all."""
    with as_stored():
        found, before, total = _chunks(store, run, "bar", first, limit)
        samples = [sample for chunk in found for sample in decode_bar(chunk.payload)]
    return pack_bar(samples[first - before : first - before + limit]), total


def columns_stretch(store: Store, run: int, first: int, limit: int) -> Columns:
    """Rows ``first`` to ``first + limit - 1`` of a run's evaluated columns.

    Raises
    ------
    Unusable, MeasurementFault
        The run is not complete enough to be evaluated.
    """
    with as_stored():
        columns = load_run(store, run)["columns"]
    total = max((len(values) for values in columns.values() if values is not None), default=0)
    part = {name: None if values is None else finite(values[first : first + limit]) for name, values in columns.items()}
    return Columns(run=run, first=first, count=max(0, min(limit, total - first)), total=total, columns=part)


def _chunks(store: Store, run: int, channel: str, first: int, limit: int) -> tuple[list[ChunkRecord], int, int]:
    """Chunks that hold a stretch, the number of their first sample, and how many samples the channel has."""
    sizes = store.chunk_sizes(run, channel) if storable(channel) and channel != IMPORTED_CHANNEL else []
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
    found = store.chunk_range(run, channel, wanted[0], wanted[-1]) if wanted else []
    for chunk in found:
        if zlib.crc32(chunk.payload) != chunk.crc32:
            raise StoreError(f"run {run}, chunk {chunk.seq} of channel {channel!r}: stored bytes do not match their CRC")
    return found, before if wanted else first, at
