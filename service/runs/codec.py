"""How samples are packed into chunks. Pure: bytes in, values out, nothing lost in between.

``bar/1``: zlib over ``<IQiH`` (seq, device_us, reading_nm, status) for each ball-bar sample.
``json/1``: zlib over JSON lines, one record a line, floats as Python's ``repr`` writes them.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

from abbe.drivers.api import BarSample
from abbe.service.errors import StoreError

BAR_CODEC = "bar/1"
JSON_CODEC = "json/1"
_SAMPLE = struct.Struct("<IQiH")
_LEVEL = 1  # best speed; samples differ little from their neighbours, a higher level gains nothing worth its time


def encode_bar(samples: Sequence[BarSample]) -> bytes:
    """Pack ball-bar samples as ``bar/1``.

    Parameters
    ----------
    samples : sequence of BarSample
        In order.

    Returns
    -------
    bytes
        Payload of a chunk.
    """
    return zlib.compress(pack_bar(samples), _LEVEL)


def pack_bar(samples: Sequence[BarSample]) -> bytes:
    """Ball-bar samples as ``<IQiH``, one after the other, not compressed."""
    return b"".join(_SAMPLE.pack(one.seq, one.device_us, one.reading_nm, one.status) for one in samples)


def decode_bar(payload: bytes) -> list[BarSample]:
    """Unpack ``bar/1``.

    Parameters
    ----------
    payload : bytes
        Payload of a chunk.

    Returns
    -------
    list of BarSample
        In order.

    Raises
    ------
    StoreError
        If the bytes are not ``bar/1``.
    """
    raw = _inflate(payload, BAR_CODEC)
    if len(raw) % _SAMPLE.size:
        raise StoreError(
            f"a chunk of codec {BAR_CODEC} has {len(raw)} bytes, not a multiple of {_SAMPLE.size}", "it was not written by Abbe"
        )
    return [BarSample(*fields) for fields in _SAMPLE.iter_unpack(raw)]


def encode_json(records: Iterable[dict[str, Any]]) -> bytes:
    """Pack JSON objects as ``json/1``.

    Parameters
    ----------
    records : iterable of dict
        In order.

    Returns
    -------
    bytes
        Payload of a chunk.

    Raises
    ------
    StoreError
        If a number is NaN or infinite.
    """
    try:
        lines = "\n".join(json.dumps(one, allow_nan=False, ensure_ascii=False, separators=(",", ":")) for one in records)
    except ValueError:
        raise StoreError("a record with NaN or Infinity is not stored", "give null where there is no value") from None
    return zlib.compress(lines.encode(), _LEVEL)


def decode_json(payload: bytes) -> list[dict[str, Any]]:
    """Unpack ``json/1``.

    Parameters
    ----------
    payload : bytes
        Payload of a chunk.

    Returns
    -------
    list of dict
        In order.

    Raises
    ------
    StoreError
        If the bytes are not ``json/1``.
    """
    text = _inflate(payload, JSON_CODEC)
    try:
        return [json.loads(line) for line in text.split(b"\n") if line]
    except ValueError as err:
        raise StoreError(f"a chunk of codec {JSON_CODEC} does not hold JSON lines ({err})", "it was not written by Abbe") from None


def _inflate(payload: bytes, codec: str) -> bytes:
    try:
        return zlib.decompress(payload)
    except zlib.error as err:
        raise StoreError(f"a chunk of codec {codec} cannot be unpacked ({err})", "it was not written by Abbe") from None
