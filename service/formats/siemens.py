"""Common parts of both Siemens table files: lines ``$VARIABLE[indices]=value ; comment`` between a head and ``M17``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from abbe.models.arrays import F1
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import TextFile
from abbe.service.formats.rules import NOTHING

_LINE = re.compile(r"\$(\w+)\s*\[([^\]]*)\]\s*=\s*\(?([^;)]*?)\)?\s*(;.*)?")
HEAD = "CHANDATA(1)"
END = "M17"
POSITION_DECIMALS = 6


@dataclass
class Assignments:
    """Every assignment of a file: (variable, indices as text) -> value as text, and its line."""

    file: TextFile
    value: dict[tuple[str, tuple[str, ...]], str] = field(default_factory=dict)
    line: dict[tuple[str, tuple[str, ...]], int] = field(default_factory=dict)

    def number(self, name: str, *index: str) -> float:
        """Return one number; raise `TableFileError` if it is missing or invalid."""
        key = (name, index)
        if key not in self.value:
            raise self.file.wrong(1, f"${name}[{','.join(index)}] is missing: the control keeps its old value")
        return self.file.number(self.line[key], self.value[key], f"${name}[{','.join(index)}]")

    def values(self, name: str, *index: str, places: int = 1) -> F1:
        """Return the values of all points of a table, in the order of their numbers from 0.

        ``places``: place of the point's number among the variable's indices, from 0; ``index``: the other indices.

        Raises
        ------
        TableFileError
            A point is missing.
        """
        found: dict[int, float] = {}
        for (variable, indices), text in self.value.items():
            rest = tuple(v for k, v in enumerate(indices) if k != places)
            if variable == name and rest == index and indices[places].isdigit():
                found[int(indices[places])] = self.file.number(self.line[(variable, indices)], text, f"${name}")
        missing = sorted(set(range(max(found, default=-1) + 1)) - set(found))
        if missing or not found:
            raise self.file.wrong(
                1, f"${name}[{','.join(index)}]: point {missing[0] if missing else 0} is missing: the control keeps its old value"
            )
        return np.array([found[k] for k in range(len(found))])


def parse(file: TextFile, name: str) -> Assignments:
    """Read the assignments of a file ``%_N_name_INI``.

    Raises
    ------
    TableFileError
        A line is neither head, assignment, comment nor M17, M17 is missing (truncated file), or a variable has two values.
    """
    out, ended = Assignments(file), False
    for line, text in file.lines():
        bare = text.partition(";")[0].strip()
        if not bare or bare == HEAD or bare.startswith("%_N_"):
            if bare.startswith("%_N_") and bare != f"%_N_{name}_INI":
                raise file.wrong(line, f"the file is {bare}, expected %_N_{name}_INI")
            continue
        if bare == END:
            ended = True
            continue
        match = _LINE.fullmatch(text.strip())
        if match is None or ended:
            raise file.wrong(line, f"{text.strip()!r} is not an assignment" if not ended else "there is something behind M17")
        key = (match.group(1), tuple(w.strip() for w in match.group(2).split(",")))
        if key in out.value:
            raise file.wrong(line, f"${key[0]}[{','.join(key[1])}] has a second value (first in line {out.line[key]})")
        out.value[key], out.line[key] = match.group(3).strip(), line
    if not ended:
        raise file.wrong(len(file.text.splitlines()), "M17 is missing: the file is cut off")
    return out


def grid(found: Assignments, count: int, step: float, first: float, last: float, end_key: tuple[str, str]) -> F1:
    """Return equidistant positions, checked against the stated end; ``end_key``: variable and index of the end, for the message.

    Raises
    ------
    TableFileError
        The step is not positive, or first + (count − 1) step is not the stated end.
    """
    line = found.line.get((end_key[0], tuple(end_key[1].split(","))), 1)
    if not step > 0 or abs(first + (count - 1) * step - last) > 1e-6 * max(1.0, abs(last), count):
        raise found.file.wrong(line, f"{count} points from {first:g} in steps of {step:g} mm do not end at {last:g} mm, as the file states")
    return np.asarray(first + step * np.arange(count, dtype=np.float64))


def step_of(position_mm: F1, name: str) -> float:
    """Return the step that reproduces a grid with the decimals of the file.

    Raises
    ------
    FormatRefused
        The step needs more decimals than are written, which would shift the last point.
    """
    step = round(float(np.ptp(position_mm)) / (position_mm.size - 1), POSITION_DECIMALS)
    if abs(position_mm[0] + step * (position_mm.size - 1) - position_mm[-1]) > 1e-6:
        raise FormatRefused(
            f"{name}: the step {np.ptp(position_mm) / (position_mm.size - 1)!r} mm is not a whole number of nanometres",
            f"choose another grid; {NOTHING}",
        )
    return step
