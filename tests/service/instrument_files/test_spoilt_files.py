"""Spoilt files: each is read as a second reader reads it, or refused with file and line. ABBE_TEST_LONG=1: 100,000 of them."""

from __future__ import annotations

import os
import random
import re
import tomllib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.columns import ColumnFile, read_table
from abbe.service.instrument_files.content import Content
from abbe.service.instrument_files.registry import READERS
from tests.service.instrument_files import second_reader as second
from tests.service.instrument_files.examples import B5R, COLUMNS, ENVIRONMENT, POS, REN, TABLE, renishaw, rtx

FILES = 100_000 if os.environ.get("ABBE_TEST_LONG") == "1" else 3_000
TABLES = ColumnFile.model_validate(tomllib.loads(COLUMNS))
GOOD: dict[str, list[bytes]] = {
    ".rtl": [
        renishaw().encode(),
        renishaw(environment=ENVIRONMENT, user="Machine:Fräse 1\nAxis:Y axis").encode("latin-1"),
        renishaw(targets=(-10, -5, 0, 5, 10, 12), runs=[(1, 2, 3, 4, 5, 6)] * 2).replace("\n", "\r\n").encode(),
        renishaw(runs=[(1, 2, 3), (0, 0, 0), (4, 5, 6), (0, 0, 0)]).replace("Flags: 0 0", "Flags: 0 1").encode(),
        renishaw(both=False, targets=(0, -50.5, -101), runs=[(0, 1.25, 2.5)] * 3).encode(),
    ],
    ".rta": [renishaw(kind="rta", runs=[(0.001, 0.002, 0.004), (0.001, 0.003, 0.004)]).encode()],
    ".pos": [POS.encode(), POS[: POS.index("Position   \tForward")].encode()],
    ".ren": [REN.encode(), REN.replace("micrometres", "").encode()],
    ".b5r": [B5R.format(encoding="utf-8", machine="m").encode()],
    ".rtx": [rtx((0.0, 1.5e-3, -2.0, 7.25))],
    ".csv": [TABLE.encode()],
}


def cut(r: random.Random, data: bytes) -> bytes:
    return data[: r.randrange(len(data))]


def flip(r: random.Random, data: bytes) -> bytes:
    k = r.randrange(len(data))
    return data[:k] + bytes([data[k] ^ (1 << r.randrange(8))]) + data[k + 1 :]


def replace(r: random.Random, data: bytes) -> bytes:
    k = r.randrange(len(data))
    return data[:k] + bytes([r.choice(b"0123456789.,+-eE ;:\t\nXYZ")]) + data[k + 1 :]


def insert(r: random.Random, data: bytes) -> bytes:
    k = r.randrange(len(data) + 1)
    return data[:k] + bytes([r.choice(b"0123456789.,+-eE ;:\t\r\nx\x00\xff")]) + data[k:]


def remove(r: random.Random, data: bytes) -> bytes:
    k = r.randrange(len(data))
    return data[:k] + data[k + r.choice((1, 1, 2, 5)) :]


def digit(r: random.Random, data: bytes) -> bytes:
    k = r.choice([m.start() for m in re.finditer(rb"[0-9]", data)] or [0])
    return data[:k] + bytes([r.choice(b"0123456789")]) + data[k + 1 :]


def on_lines(change: Callable[[random.Random, list[bytes]], None]) -> Callable[[random.Random, bytes], bytes]:
    def changed(r: random.Random, data: bytes) -> bytes:
        lines = data.split(b"\n")
        change(r, lines)
        return b"\n".join(lines)

    return changed


def drop(r: random.Random, lines: list[bytes]) -> None:
    del lines[r.randrange(len(lines))]


def double(r: random.Random, lines: list[bytes]) -> None:
    k = r.randrange(len(lines))
    lines.insert(r.randrange(len(lines)), lines[k])


def swap(r: random.Random, lines: list[bytes]) -> None:
    a, b = r.randrange(len(lines)), r.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]


def word_away(r: random.Random, lines: list[bytes]) -> None:
    k = r.randrange(len(lines))
    words = lines[k].split()
    if words:
        del words[r.randrange(len(words))]
        lines[k] = b" ".join(words)


MUTATIONS = (cut, flip, replace, insert, remove, digit, *map(on_lines, (drop, double, swap, word_away)))


def ours(ending: str, data: bytes) -> Content:
    return read_table(f"f{ending}", data, TABLES) if ending == ".csv" else READERS[ending](f"f{ending}", data)


def theirs(ending: str, data: bytes) -> dict[str, Any] | None:
    reader = {".rta": second.rtl, ".csv": second.csv}.get(ending) or getattr(second, ending[1:])
    found: dict[str, Any] | None = reader(data)
    return found


def same(content: Content, other: dict[str, Any]) -> bool:
    """Whether both readers say the same: machine, axis, positions, sides, values with units."""
    if content.machine != other["machine"]:
        return False
    if "stated" in other:
        return {one.symbol: (one.value, one.unit) for one in content.stated} == other["stated"]
    if "samples" in other:
        trace = content.trace
        return trace is not None and (trace.axis, trace.rate_hz, trace.samples.tolist()) == (other["axis"], other["rate"], other["samples"])
    test = content.test
    if test is None or test.axis != other["axis"] or content.unit_known != other.get("unit_known", True):
        return False
    further, wanted = {name: values[[0, -1]] for name, values in test.further.items()}, other.get("further")
    if wanted is not None and (further.keys() != wanted.keys() or not all(np.allclose(further[name], wanted[name]) for name in wanted)):
        return False
    return (
        test.position_mm.tolist() == other["position"]
        and test.direction.tolist() == other["direction"]
        and np.allclose(test.deviation, other["deviation"], rtol=1e-12, atol=1e-12)
    )


@pytest.mark.parametrize("ending", GOOD)
def test_both_readers_agree_on_good_files(ending: str) -> None:
    for data in GOOD[ending]:
        other = theirs(ending, data)
        assert other is not None
        assert same(ours(ending, data), other)


def outcome(ending: str, data: bytes) -> Content | str:
    try:
        return ours(ending, data)
    except FileFormatError as error:
        return str(error)


@pytest.mark.timeout(1800)
def test_a_spoilt_file_is_read_right_or_refused_with_its_line() -> None:
    r = random.Random(20261126)
    read = 0
    too_strict: list[str] = []
    for _ in range(FILES):
        ending = r.choice(list(GOOD))
        data = r.choice(GOOD[ending])
        for _ in range(r.choice((1, 1, 2, 3))):
            data = r.choice(MUTATIONS)(r, data) or b"\n"
        other, found = theirs(ending, data), outcome(ending, data)
        if isinstance(found, str):
            assert re.fullmatch(rf"f\{ending}:[0-9]+: [^\n]+", found), (found, data)
            too_strict += [found] if other is not None else []
            continue
        read += 1
        assert other is not None, (ending, data)
        assert same(found, other), (ending, data, found, other)
    assert FILES / 5 < read < 4 * FILES / 5
    assert len(too_strict) < FILES / 100, too_strict[:20]
