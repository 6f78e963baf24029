"""Read the points for a prediction: a CSV file with one commanded position per row."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.service.errors import FileFormatError, nearest, short_repr

POSITION = ("x_mm", "y_mm", "z_mm")
DIRECTION = ("direction_x", "direction_y", "direction_z")
TOOL = ("tool_x_mm", "tool_y_mm", "tool_z_mm")
KNOWN = POSITION + DIRECTION + TOOL
_MEANT = frozenset(("x", "y", "z", "direction", "dir", "tool"))
"""A column whose name starts like this was meant for this format and is never ignored."""
BLOCK = 4096
"""Rows held as text at a time: as Python text, a point takes a hundred times as much memory as three numbers."""

Lines = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PointsFile:
    """Content of a points file.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    direction : array, shape (n, 3), or None
        Sign of each axis' last move; 0 for an axis without a column; None if no axis has one.
    directed : tuple of int
        Axes that have a direction column.
    tool_mm : array, shape (n, 3), or None
        Tool at each point; None if the file has no such columns.
    lines : array of int, shape (n,)
        Line of each point in the file.
    unused : list of str
        Unknown columns.
    """

    path: Path
    axes_mm: F2
    direction: F2 | None
    directed: tuple[int, ...]
    tool_mm: F2 | None
    lines: Lines
    unused: list[str]

    def place(self, index: int) -> str:
        """Return the file, row and line of a point, for messages; rows count from 1 below the header."""
        return f"{self.path}: row {index + 1} (line {self.lines[index]})"


def read_points(path: Path) -> PointsFile:
    """Read and check a points file.

    Columns ``x_mm,y_mm,z_mm``; optional ``direction_x`` .. ``direction_z`` (-1, 0 or +1) and, all three or none, ``tool_x_mm`` ..
    ``tool_z_mm``. Other columns are ignored and listed in ``unused``.

    Raises
    ------
    FileFormatError
        The file has a mistake; the message names file, column and row of the first one.
    """
    stream = _rows(path)
    _, first = next(stream, (0, None))
    if first is None:
        raise FileFormatError(f"{path}: the file is empty", "expected a header x_mm,y_mm,z_mm and one row for each point")
    header = [name.strip() for name in first]
    _check_header(path, header)
    wanted = {name: at for at, name in enumerate(header) if name in KNOWN}
    blocks: dict[str, list[F1]] = {name: [] for name in wanted}
    numbers: list[Lines] = []
    count = 0
    while block := list(islice(stream, BLOCK)):
        some = _Block(path, count, [line for line, _ in block], [row for _, row in block])
        some.check_length(len(header))
        for name, at in wanted.items():
            blocks[name].append(some.column(name, at))
        numbers.append(np.array(some.lines, dtype=np.int64))
        count += len(block)
    if not count:
        raise FileFormatError(f"{path}: no point below the header", "add at least one row")
    columns = {name: np.concatenate(parts) for name, parts in blocks.items()}
    directed = tuple(axis for axis, name in enumerate(DIRECTION) if name in columns)
    still = np.zeros(count)
    return PointsFile(
        path,
        np.stack([columns[name] for name in POSITION], axis=1),
        np.stack([columns.get(name, still) for name in DIRECTION], axis=1) if directed else None,
        directed,
        np.stack([columns[name] for name in TOOL], axis=1) if TOOL[0] in columns else None,
        np.concatenate(numbers),
        [name for name in header if name not in KNOWN],
    )


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Return the line number and cells of each non-blank row, header first."""
    line = 0
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            for row in reader:
                line = reader.line_num
                if row and any(cell.strip() for cell in row):
                    yield line, row
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file", "give a CSV file with the columns x_mm,y_mm,z_mm") from None
    except OSError as err:
        raise FileFormatError(f"{path}: cannot be read: {err.strerror}", "give a readable CSV file") from None
    except UnicodeDecodeError as err:
        raise FileFormatError(
            f"{path}: below line {line}, a byte 0x{err.object[err.start]:02x} is not UTF-8", "save the file as UTF-8"
        ) from None
    except csv.Error as err:
        raise FileFormatError(f"{path}: line {line + 1}: not CSV: {err}", "correct the file") from None


def _check_header(path: Path, header: Sequence[str]) -> None:
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise FileFormatError(
            f"{path}: line 1: columns are not separated by commas",
            "separate columns by commas (x_mm,y_mm,z_mm), and write decimals with a point",
        )
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise FileFormatError(f"{path}: column {twice!r} appears twice", "leave one out")
    for name in header:
        if name not in KNOWN and name.lower().partition("_")[0] in _MEANT:
            wanted = next(
                (one for one in KNOWN if one.rpartition("_")[0] == name.rpartition("_")[0] or one.removesuffix("_mm") == name), None
            )
            if wanted in POSITION + TOOL:
                raise FileFormatError(f"{path}: unknown unit suffix in {name!r}, expected {wanted!r}", "lengths are in mm")
            raise FileFormatError(f"{path}: unknown column {name!r}", nearest(name, KNOWN))
    needed = POSITION + (TOOL if set(TOOL) & set(header) else ())
    missing = next((name for name in needed if name not in header), None)
    if missing is not None:
        raise FileFormatError(
            f"{path}: column {missing!r} is missing, got {short_repr(','.join(header))}", f"the header must name {','.join(needed)}"
        )


@dataclass(frozen=True, slots=True)
class _Block:
    """A block of rows as text: the file, the number of points above it, its line numbers and cells."""

    path: Path
    above: int
    lines: list[int]
    rows: list[list[str]]

    def check_length(self, wanted: int) -> None:
        for index, row in enumerate(self.rows):
            if len(row) != wanted:
                raise FileFormatError(f"{self.path}: {self._place(index)}: expected {wanted} values, got {len(row)}", "correct the row")

    def column(self, name: str, at: int) -> F1:
        values = np.empty(len(self.rows))
        sign = name in DIRECTION
        for index, row in enumerate(self.rows):
            value = _number(row[at])
            if not math.isfinite(value) or (sign and value not in (-1.0, 0.0, 1.0)):
                wanted = "-1, 0 or 1" if sign else "a finite number"
                raise FileFormatError(
                    f"{self.path}: {name}, {self._place(index)}: expected {wanted}, got {short_repr(row[at])}", "correct the row"
                )
            values[index] = value
        return values

    def _place(self, index: int) -> str:
        return f"row {self.above + index + 1} (line {self.lines[index]})"


def _number(cell: str) -> float:
    """Return the number in a CSV cell, or NaN; ``float`` alone would also accept ``1_00`` and non-ASCII digits."""
    if not cell.isascii() or "_" in cell:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return math.nan
