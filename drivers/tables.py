"""Encode and decode compensation images (docs/protocols/cnc.md, "Banks"). Values that do not fit exactly are refused, never rounded."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

from abbe.drivers.api import Point

FORMAT_VERSION = 1
"""Version of this encoding; part of the signed content of a table."""
MAGIC = 0xABBE
FORMAT = 1
NO_CORRECTION, NINE_TABLES, GRID_3D = 0, 1, 2
MAX_WORDS = 4800
GRID_NM = 10
_HEADER = struct.Struct(">HHHHIHHHHHHiiiiii")
_PER_MM = 100_000
_EXACT = 1e-3  # counts: a grid position may differ from a multiple of 10 nm by float noise only


class TableCodecError(ValueError):
    """The table cannot be stored exactly, or the bytes are not an image."""


@dataclass(frozen=True, slots=True)
class TableImage:
    """A compensation table in the controller's format.

    Parameters
    ----------
    kind : int
        0 no correction, 1 nine one-axis tables, 2 3-D grid.
    table_id : int
        Chosen by the host, u32.
    lsb_nm : int
        Unit of the values in nm.
    start_mm, step_mm : tuple of three float
        First grid position and pitch of X, Y, Z in mm, multiples of 10 nm.
    counts : tuple of three int
        Grid points of X, Y, Z.
    values : tuple of int
        Corrections in LSB, added to the command, ordered by input axis, corrected axis, index (kind 1) or z, y, x, corrected axis (kind 2).
    """

    kind: int
    table_id: int
    lsb_nm: int
    start_mm: Point
    step_mm: Point
    counts: tuple[int, int, int]
    values: tuple[int, ...]


def body_words(kind: int, counts: tuple[int, int, int]) -> int:
    """Return the number of values in an image of this kind and grid. Raises TableCodecError for an unknown kind."""
    nx, ny, nz = counts
    if kind == NO_CORRECTION:
        return 0
    if kind == NINE_TABLES:
        return 3 * (nx + ny + nz)
    if kind == GRID_3D:
        return 3 * nx * ny * nz
    raise TableCodecError(f"kind {kind} is none of 0, 1, 2")


def encode(image: TableImage) -> bytes:
    """Encode a table as the bytes of a bank.

    Raises
    ------
    TableCodecError
        For example, a correction exceeds 16 bits, a position is not a multiple of 10 nm, or the image exceeds the bank.
    """
    _check(image)
    n_words = _HEADER.size // 2 + len(image.values)
    start = [_counts(value, "start") for value in image.start_mm]
    step = [_counts(value, "step") for value in image.step_mm]
    _check_steps(image.kind, step)
    grid = image.counts
    try:
        header = _HEADER.pack(MAGIC, FORMAT, image.kind, n_words, image.table_id, image.lsb_nm, 0, *grid, 0, *start, *step)
    except struct.error as error:
        raise TableCodecError(f"header: {error}") from None
    return header + struct.pack(f">{len(image.values)}h", *image.values)


def decode(data: bytes) -> TableImage:
    """Decode the bytes of one image, without the unused rest of its bank.

    Raises
    ------
    TableCodecError
        The bytes are not exactly one image.
    """
    if len(data) < _HEADER.size:
        raise TableCodecError(f"{len(data)} bytes are shorter than an image's header of {_HEADER.size}")
    magic, fmt, kind, n_words, table_id, lsb_nm, reserved, nx, ny, nz, reserved_too, *grid = _HEADER.unpack_from(data)
    if magic != MAGIC or fmt != FORMAT:
        raise TableCodecError(f"magic {magic:#06x} format {fmt} instead of {MAGIC:#06x} format {FORMAT}")
    if reserved or reserved_too:
        raise TableCodecError("reserved words are not 0")
    if len(data) != 2 * n_words:
        raise TableCodecError(f"header says {n_words} registers, there are {len(data) / 2:g}")
    if n_words - _HEADER.size // 2 != body_words(kind, (nx, ny, nz)):
        raise TableCodecError(f"{n_words} registers do not fit kind {kind} with {nx} x {ny} x {nz} points")
    _check_steps(kind, grid[3:])
    values = struct.unpack_from(f">{n_words - _HEADER.size // 2}h", data, _HEADER.size)
    x0, y0, z0, dx, dy, dz = (value / _PER_MM for value in grid)
    image = TableImage(kind, table_id, lsb_nm, (x0, y0, z0), (dx, dy, dz), (nx, ny, nz), values)
    _check(image)
    return image


def crc32(data: bytes) -> int:
    """Return the CRC-32 (IEEE 802.3) of an image's bytes, as the controller computes it when sealing."""
    return zlib.crc32(data)


def _check(image: TableImage) -> None:
    expected = body_words(image.kind, image.counts)
    if len(image.values) != expected:
        raise TableCodecError(f"{len(image.values)} values instead of {expected} for kind {image.kind} with {image.counts} points")
    if _HEADER.size // 2 + expected > MAX_WORDS:
        raise TableCodecError(f"{_HEADER.size // 2 + expected} registers do not fit a bank of {MAX_WORDS}")
    if image.kind == NO_CORRECTION:
        if any(image.counts):
            raise TableCodecError(f"an image of kind 0 (no correction) must have no grid points, not {image.counts}")
    elif min(image.counts) < 2:
        raise TableCodecError(f"{image.counts} points: each axis needs 2 or more")
    if image.lsb_nm <= 0:
        raise TableCodecError(f"lsb_nm, the unit of the values, is {image.lsb_nm} nm: it must be above 0")
    for index, value in enumerate(image.values):
        if not -32768 <= value <= 32767:
            raise TableCodecError(f"value {index} is {value} LSB: beyond 16 bits ({value * image.lsb_nm / 1000:g} um)")


def _check_steps(kind: int, step: list[int]) -> None:
    if kind != NO_CORRECTION and min(step) <= 0:
        raise TableCodecError("each axis needs a grid pitch above 0")


def _counts(value_mm: float, what: str) -> int:
    exact = value_mm * _PER_MM if math.isfinite(value_mm) else math.inf
    if not -(1 << 31) - 0.5 < exact < (1 << 31) - 0.5:
        raise TableCodecError(f"grid {what} {value_mm} mm is not a number within +-21 m")
    if abs(exact - round(exact)) > _EXACT:
        raise TableCodecError(f"grid {what} {value_mm} mm is not a multiple of {GRID_NM} nm; quantise the grid before computing the table")
    return round(exact)
