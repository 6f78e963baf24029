"""Content of an instrument's file, independent of its format; and the decoding of its bytes into lines."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from abbe.models.arrays import F1
from abbe.service.domain.run_file import StatedFigure
from abbe.service.errors import FileFormatError
from abbe.service.files import NotPlainError, read_plain
from abbe.service.formats.files import NUMBER, TextFile

MAX_BYTES = 64 * 2**20
HPA = 100.0
"""One hectopascal, Pa."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisReadings:
    """A test of one axis as its file states it, n readings in their order.

    ``quantity``: length (mm) or angle (rad), of ``deviation`` and its ``resolution``; ``position_mm``: targets; ``direction``: +1 or -1
    where the axis approached in its own + or - direction, 0 for means of both; ``t_s``: None if the file has no times; ``means``: each
    value is the mean of several approaches; ``further``: other columns of the format (`abbe.service.domain.run.Columns`);
    ``sign_known``: the deviation is measured - nominal, as the format says.
    """

    quantity: str
    axis: str
    position_mm: F1
    direction: F1
    deviation: F1
    resolution: float
    t_s: F1 | None = None
    feed_mm_min: float | None = None
    means: bool = False
    sign_known: bool = True
    further: Mapping[str, F1] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Equally spaced samples of a displacement whose unit the file does not state, ``rate_hz`` a second."""

    axis: str
    samples: F1
    rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Content:
    """Content of one file.

    ``name``: name of the file, without its folder; ``said``: everything that the file states, as text; ``machine``: name of the measured
    machine, empty if not stated; ``notes``: unread parts and remarks; ``unit_known``: False if the unit of ``test`` has to be asked.
    """

    name: str
    form: str
    sha256: str
    machine: str
    said: Mapping[str, str]
    test: AxisReadings | None = None
    trace: Trace | None = None
    stated: tuple[StatedFigure, ...] = ()
    notes: tuple[str, ...] = ()
    unit_known: bool = True


def read_bytes(path: Path) -> bytes:
    """Read a file.

    Raises
    ------
    FileFormatError
        The file is missing, empty, no plain file, or larger than 64 MiB.
    """
    try:
        data = read_plain(path, MAX_BYTES)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file", "give an existing file") from None
    except NotPlainError as err:
        raise FileFormatError(f"{path}: {err.strerror}", "give the file of the instrument itself") from None
    except OSError as err:
        raise FileFormatError(f"{path}: cannot be read: {err.strerror}", "check its access rights") from None
    if not data:
        raise FileFormatError(f"{path}:1: the file is empty", "export it again")
    return data


def digest(data: bytes) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def text_file(name: str, data: bytes) -> TextFile:
    """Decode a text file: UTF-8, UTF-16 with byte order mark, GB 2312 if all bytes above 127 are pairs of usual signs, else Latin-1.

    Raises
    ------
    FileFormatError
        The file holds control characters: it is not text, or damaged.
    """
    file = TextFile(name, _decoded(data), FileFormatError)
    for line, text in file.lines():
        odd = next((c for c in text if (c < " " and c != "\t") or c == "\x7f" or c == "\ufffd"), None)
        if odd is not None:
            raise file.wrong(line, f"it holds the character {odd!r}: this is not text, or damaged", "export the file again")
    return file


def _decoded(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        pass
    try:
        text = data.decode("gb2312")
    except UnicodeDecodeError:
        return data.decode("latin-1")
    pairs = re.findall(rb"[\x80-\xff]{2}", data)
    usual = sum(b"\xb0" <= pair[:1] <= b"\xd7" for pair in pairs)  # level 1: signs that are often used
    return text if 2 * usual >= len(pairs) else data.decode("latin-1")


def step_of(words: list[str], unit: float) -> float:
    """Smallest step of printed numbers, in ``unit``: one in the last decimal of the longest number; 0 without numbers."""
    last = [_decimals(word) for word in words if NUMBER.fullmatch(word)]
    return unit * 10.0 ** -max(last) if last else 0.0


def _decimals(word: str) -> int:
    mantissa, _, exponent = word.lower().partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def axis_of(text: str) -> str:
    """The letter of a linear axis in a name such as ``X``, ``x axis`` or ``Y1``; empty if there is none."""
    found = re.match(r"(?:axis[ :_-]*)?([XYZ])(?![A-Za-z])", text.strip(), re.IGNORECASE) or re.match(
        r"([XYZ])[ _-]?axis", text.strip(), re.IGNORECASE
    )
    return found.group(1).upper() if found else ""


def along(values: list[float], n: int) -> F1:
    """Interpolate one to three values, spread evenly over a test from start to end, to its n readings."""
    return np.asarray(np.interp(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, len(values)), values))
