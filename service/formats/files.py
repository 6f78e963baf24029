"""Text files of an export, their numbers as controls read them, errors that name file and line, and the settings of an export."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import Machine
from abbe.service.errors import AbbeError, TableFileError

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class TextFile:
    """One file of a format: its name (no folder), its text, and the class of its errors."""

    name: str
    text: str
    error: type[AbbeError] = TableFileError

    def lines(self) -> Iterator[tuple[int, str]]:
        """Return the lines with their numbers, from 1; a line ends with LF, CRLF or CR."""
        return enumerate((text.removesuffix("\n") for text in io.StringIO(self.text, newline=None)), start=1)

    def wrong(self, line: int, what: str, remedy: str = "correct the file; nothing was loaded") -> AbbeError:
        """Return an error about one line of this file, for the caller to raise."""
        return self.error(f"{self.name}:{line}: {what}", remedy)

    def number(self, line: int, word: str, what: str) -> float:
        """Convert ``word`` to a finite number; ``what`` names it in the message.

        Raises
        ------
        AbbeError
            The word is not a finite number; the message has file and line.
        """
        if NUMBER.fullmatch(word) is None or not math.isfinite(float(word)):
            raise self.wrong(line, f"{what} is {word!r}, expected a number")
        return float(word)


def short(value: float, decimals: int) -> str:
    """Return the shortest text of the rounded value with at least one decimal, no exponent, no minus zero: ``0.01``, ``-200.0``."""
    text = f"{round(value, decimals) + 0.0:.{decimals}f}"
    head, _, tail = text.partition(".")
    return f"{head}.{tail.rstrip('0') or '0'}" if float(text) != 0.0 else "0.0"


def fixed(value: float, decimals: int) -> str:
    """Return the value as text with a fixed number of decimals, no minus zero: ``0.010``."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def whole(value: float, decimals: int) -> str:
    """Return the text of `short`, but whole numbers without a point: ``100``, ``12.5``."""
    return short(value, decimals).removesuffix(".0")


def integers(values: F1, unit: float) -> list[int]:
    """Return the values in whole units, rounded to the nearest."""
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


@dataclass(frozen=True)
class FormatSettings:
    """Settings of an export for one machine.

    Attributes
    ----------
    reference_mm : (x, y, z), optional
        Position at which the tables must be zero (reference point, home); None: not checked.
    decimals : int
        Decimals of corrections in mm. Angles in rad have three more.
    points : int, optional
        Largest number of points of a table on this machine (Siemens MD38000, MD18342; Fanuc option); None: limit of the format.
    machine : Machine, optional
        Nominal geometry for a control with a kinematic model (ISG).
    axis_names : (str, str, str)
        Siemens machine axes of X, Y, Z.
    unit_mm, magnification, largest_step : float, int, int
        Fanuc: detection unit; parameter 3623; largest number that a point can hold (127; 7 on old series).
    first_point : int
        Fanuc: number of the first point that may be used.
    power_of_two : bool
        The control is a Heidenhain TNC 4xx: the spacing must be a power of two times 0.1 µm.
    """

    reference_mm: tuple[float, float, float] | None = None
    decimals: int = 6
    points: int | None = None
    machine: Machine | None = None
    axis_names: tuple[str, str, str] = ("X1", "Y1", "Z1")
    unit_mm: float = 0.001
    magnification: int = 1
    largest_step: int = 127
    first_point: int = 0
    power_of_two: bool = False

    @property
    def step_mm(self) -> float:
        """Value of one unit in the last decimal, mm."""
        return float(10.0**-self.decimals)
