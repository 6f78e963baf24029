"""What goes into a chunk comes out of it."""

from __future__ import annotations

import zlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.api import BarSample
from abbe.service.errors import StoreError
from abbe.service.runs.chunks import decode_bar, decode_json, encode_bar, encode_json

SAMPLES = st.builds(
    BarSample,
    seq=st.integers(0, 2**32 - 1),
    device_us=st.integers(0, 2**64 - 1),
    reading_nm=st.integers(-(2**31), 2**31 - 1),
    status=st.integers(0, 2**16 - 1),
)
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=10,
)


@given(st.lists(SAMPLES))
def test_bar_round_trip(samples: list[BarSample]) -> None:
    assert decode_bar(encode_bar(samples)) == samples


@given(st.lists(st.dictionaries(st.text(), JSON_VALUES, max_size=5)))
def test_json_round_trip(records: list[dict[str, Any]]) -> None:
    assert decode_json(encode_json(records)) == records


def test_bytes_of_a_sample_are_fixed() -> None:
    raw = zlib.decompress(encode_bar([BarSample(7, 1234567, -12345, 8)]))
    assert raw.hex() == "07000000" + "87d6120000000000" + "c7cfffff" + "0800"


@given(st.binary())
def test_any_bytes_give_samples_or_one_error(payload: bytes) -> None:
    for unpack in (decode_bar, decode_json):
        with pytest.raises(StoreError, match="Abbe did not write this"):
            unpack(payload)


def test_wrong_content_is_refused() -> None:
    with pytest.raises(StoreError, match="not a multiple of 18"):
        decode_bar(zlib.compress(b"x"))
    with pytest.raises(StoreError, match="JSON lines"):
        decode_json(zlib.compress(b"{"))
    with pytest.raises(StoreError, match="NaN or Infinity"):
        encode_json([{"a": float("inf")}])
