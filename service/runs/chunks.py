"""The lossless packing of samples into chunks:

``bar/1``: zlib over ``<IQiH`` (seq, device_us, reading_nm, status) for each ball-bar sample.
``json/1``: zlib over JSON lines, one record per line, floats as written by Python's ``repr``.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

from abbe.drivers.api import BarSample
from abbe.service.errors import StoreError

BAR_CHANNEL = "bar"
LASER_CHANNEL = "laser"
IMPORTED_CHANNEL = "columns"
BAR_CODEC = "bar/1"
JSON_CODEC = "json/1"
_SAMPLE = struct.Struct("<IQiH")
_LEVEL = 1  # fastest; neighbouring samples differ little, so that a higher level is not worth its time


def encode_bar(samples: Sequence[BarSample]) -> bytes:
    """Pack ball-bar samples in order as a chunk ``bar/1``."""
    return zlib.compress(pack_bar(samples), _LEVEL)


def pack_bar(samples: Sequence[BarSample]) -> bytes:
    """Pack ball-bar samples as consecutive ``<IQiH``, uncompressed."""
    return b"".join(_SAMPLE.pack(one.seq, one.device_us, one.reading_nm, one.status) for one in samples)


def decode_bar(payload: bytes) -> list[BarSample]:
    """Unpack the samples of a chunk ``bar/1`` in order.

    Raises
    ------
    StoreError
        The bytes are not ``bar/1``.
    """
    return [BarSample(*fields) for fields in _SAMPLE.iter_unpack(whole_samples(payload))]


def whole_samples(payload: bytes) -> bytes:
    """Unpack a chunk ``bar/1`` to consecutive ``<IQiH``. Raises StoreError."""
    raw = _inflate(payload, BAR_CODEC)
    if len(raw) % _SAMPLE.size:
        raise StoreError(
            f"a chunk of codec {BAR_CODEC} has {len(raw)} bytes, not a multiple of {_SAMPLE.size}",
            "Abbe did not write this, or the database is damaged: restore a backup",
        )
    return raw


def encode_json(records: Iterable[dict[str, Any]]) -> bytes:
    """Pack JSON objects in order as a chunk ``json/1``.

    Raises
    ------
    StoreError
        A number is NaN or infinite.
    """
    try:
        lines = "\n".join(json.dumps(one, allow_nan=False, ensure_ascii=False, separators=(",", ":")) for one in records)
    except ValueError:
        raise StoreError("a record with NaN or Infinity cannot be stored", "give null where there is no value") from None
    return zlib.compress(lines.encode(), _LEVEL)


def decode_json(payload: bytes) -> list[dict[str, Any]]:
    """Unpack the objects of a chunk ``json/1`` in order.

    Raises
    ------
    StoreError
        The bytes are not ``json/1``.
    """
    text = _inflate(payload, JSON_CODEC)
    try:
        return [json.loads(line) for line in text.split(b"\n") if line]
    except ValueError as err:
        raise StoreError(
            f"a chunk of codec {JSON_CODEC} does not hold JSON lines ({err})",
            "Abbe did not write this, or the database is damaged: restore a backup",
        ) from None


def _inflate(payload: bytes, codec: str) -> bytes:
    try:
        return zlib.decompress(payload)
    except zlib.error as err:
        raise StoreError(
            f"a chunk of codec {codec} cannot be unpacked ({err})", "Abbe did not write this, or the database is damaged: restore a backup"
        ) from None
