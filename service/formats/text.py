"""Text files and their numbers, written unambiguously for controls and read with file and line of every mistake."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.errors import TableFileError

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class TextFile:
    """One file of a format: its name (no folder) and its text."""

    name: str
    text: str

    def lines(self) -> Iterator[tuple[int, str]]:
        """Lines with their number, from 1."""
        return enumerate(self.text.splitlines(), start=1)

    def wrong(self, line: int, what: str, remedy: str = "correct the file; nothing was loaded") -> TableFileError:
        """An error about one line of this file."""
        return TableFileError(f"{self.name}:{line}: {what}", remedy)

    def number(self, line: int, word: str, what: str) -> float:
        """A finite number in plain notation.

        Raises
        ------
        TableFileError
            The text is no such number; the message has file and line.
        """
        if NUMBER.fullmatch(word) is None or not math.isfinite(float(word)):
            raise self.wrong(line, f"{what} is {word!r}, expected a number")
        return float(word)


def short(value: float, decimals: int) -> str:
    """Shortest text of the rounded value with at least one decimal, no exponent, no minus zero: ``0.01``, ``-200.0``."""
    text = f"{round(value, decimals) + 0.0:.{decimals}f}"
    head, _, tail = text.partition(".")
    return f"{head}.{tail.rstrip('0') or '0'}" if float(text) != 0.0 else "0.0"


def fixed(value: float, decimals: int) -> str:
    """Text with a fixed number of decimals, no minus zero: ``0.010``."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def whole(value: float, decimals: int) -> str:
    """Like `short`, but whole numbers without a point: ``100``, ``12.5``."""
    return short(value, decimals).removesuffix(".0")


def integers(values: F1, unit: float) -> list[int]:
    """Values in whole units, rounded to the nearest."""
    return [int(v) for v in np.rint(np.asarray(values) / unit)]


def increasing(file: TextFile, position: list[float], lines: list[int]) -> None:
    """Refuse positions that do not increase from line to line.

    Raises
    ------
    TableFileError
        The message names the line that goes back or repeats.
    """
    for before, now, line in zip(position, position[1:], lines[1:], strict=False):
        if not now > before:
            raise file.wrong(line, f"position {now:g} after {before:g}: positions have to increase from line to line")
