"""Decode compensation images (docs/protocols/cnc.md, "Banks") to a correction that is added to the command."""

import struct
import zlib
from collections.abc import Callable

import numpy as np

from abbe.simulators.arrays import I64, F

BANK_WORDS = 4800
HEADER_WORDS = 24
LSB_NM = 100
MAGIC = 0xABBE
FORMAT = 1
_LSB_MM = LSB_NM * 1e-6
_TEN_NM_MM = 1e-5
_HEADER = struct.Struct(">4HI2H3HH3i3i")

Correction = Callable[[F], F]


class ImageError(ValueError):
    """The words are not a valid compensation image."""


def empty_image() -> list[int]:
    """Return the words of a kind 0 image: no correction."""
    header = _HEADER.pack(MAGIC, FORMAT, 0, HEADER_WORDS, 0, LSB_NM, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1)
    return list(struct.unpack(f">{HEADER_WORDS}H", header))


def to_bytes(words: list[int]) -> bytes:
    """Return words as big-endian bytes."""
    return struct.pack(f">{len(words)}H", *words)


def checksum(words: list[int]) -> int:
    """Return the CRC-32 of an image that `parse` has checked, over the number of words that its header states."""
    return zlib.crc32(to_bytes(words[: words[3]]))


def parse(words: list[int]) -> tuple[int, Correction]:
    """Check an image; return its kind and its correction, a function from commanded positions (n, 3) mm to additions (n, 3) mm.

    Raises ImageError for an image that the controller would not seal.
    """
    if len(words) < HEADER_WORDS:
        raise ImageError("the image is shorter than its header")
    magic, fmt, kind, length, _, lsb, _, nx, ny, nz, _, *ends = _HEADER.unpack(to_bytes(words[:HEADER_WORDS]))
    counts = (nx, ny, nz)
    if (magic, fmt, lsb) != (MAGIC, FORMAT, LSB_NM):
        raise ImageError("the header has another magic number, format or table unit than docs/protocols/cnc.md")
    if kind not in (0, 1, 2):
        raise ImageError(f"kind {kind} is none of 0, 1, 2")
    if kind == 0 and counts != (0, 0, 0):
        raise ImageError("an image of kind 0 must have no grid points")
    expected = HEADER_WORDS + {0: 0, 1: 3 * sum(counts), 2: 3 * nx * ny * nz}[kind]
    if length != expected or length > min(len(words), BANK_WORDS):
        raise ImageError(f"length {length}, expected {expected}")
    if kind == 0:
        return 0, _nothing
    start, step = np.array(ends[:3]) * _TEN_NM_MM, np.array(ends[3:]) * _TEN_NM_MM
    if min(counts) < 2 or step.min() <= 0.0:
        raise ImageError("a grid needs 2 points or more and a positive pitch")
    body = np.frombuffer(to_bytes(words[HEADER_WORDS:length]), dtype=">i2").astype(np.float64) * _LSB_MM
    if kind == 1:
        return 1, _AxisTables(body, counts, start, step)
    return 2, _Grid(body, counts, start, step)


def _nothing(command_mm: F) -> F:
    """Return the correction of kind 0: zeros."""
    return np.zeros_like(command_mm)


def _cell(position_mm: F, start_mm: float, step_mm: float, count: int) -> tuple[I64, F]:
    """Return the index of the lower grid point and the fraction towards the next one; a position beyond the grid is moved to its end."""
    place = np.clip((position_mm - start_mm) / step_mm, 0.0, count - 1.0)
    index = np.minimum(place.astype(np.int64), count - 2)
    return index, place - index


class _AxisTables:
    """Kind 1: nine one-axis tables, linear between points."""

    def __init__(self, body_mm: F, counts: tuple[int, int, int], start_mm: F, step_mm: F) -> None:
        self._start, self._step, self._counts = start_mm, step_mm, counts
        ends = np.cumsum([3 * n for n in counts])
        # stored as output-major rows of N[a] values; wanted as (N[a], 3)
        self._tables = [part.reshape(3, -1).T for part in np.split(body_mm, ends[:-1])]

    def __call__(self, command_mm: F) -> F:
        total = np.zeros_like(command_mm)
        for a, table in enumerate(self._tables):
            index, fraction = _cell(command_mm[:, a], float(self._start[a]), float(self._step[a]), self._counts[a])
            total += table[index] * (1.0 - fraction)[:, None] + table[index + 1] * fraction[:, None]
        return total


class _Grid:
    """Kind 2: three corrections per node of a 3-D grid, trilinear between nodes."""

    def __init__(self, body_mm: F, counts: tuple[int, int, int], start_mm: F, step_mm: F) -> None:
        self._start, self._step, self._counts = start_mm, step_mm, counts
        nx, ny, nz = counts
        self._nodes = body_mm.reshape(nz, ny, nx, 3)

    def __call__(self, command_mm: F) -> F:
        cells = [_cell(command_mm[:, a], float(self._start[a]), float(self._step[a]), self._counts[a]) for a in range(3)]
        (ix, fx), (iy, fy), (iz, fz) = cells
        total = np.zeros_like(command_mm)
        for dx, dy, dz in np.ndindex(2, 2, 2):
            weight = (fx if dx else 1.0 - fx) * (fy if dy else 1.0 - fy) * (fz if dz else 1.0 - fz)
            total += weight[:, None] * self._nodes[iz + dz, iy + dy, ix + dx]
        return total
