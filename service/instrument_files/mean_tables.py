"""Tables of means: API .pos and the compensation report .REN.

Each format is known from one public reader. Neither states the sign of its values.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.answers import LENGTHS
from abbe.service.instrument_files.content import AxisReadings, Content, axis_of, digest, step_of, text_file

_POS_HEAD = re.compile(r"Position\s+(Bidirectional|Forward Directional|Reverse Directional|Backward Directional) Avg Error", re.ASCII)
_OTHER_HEAD = re.compile(r"\s*Position\s+[A-Z]", re.ASCII)
_WAYS = {"Bidirectional": 0.0, "Forward Directional": 1.0, "Reverse Directional": -1.0, "Backward Directional": -1.0}
_NAMES = {0.0: "bidirectional", 1.0: "forward", -1.0: "reverse"}
_REN_HEAD = re.compile(r"No\.\s+Axis position\s+Combined", re.ASCII)
_REN_FACTS = {"compensation spacing": "spacing", "compensation start": "start", "compensation end": "end"}
"""Words with which a line of a .REN begins, and the field of `_Grid` that the line gives."""
_UNITS = re.compile(r"(?<![A-Za-z])(millimet(?:re|er)s?|micromet(?:re|er)s?|microns?|mm|um|µm|μm|nm)(?![A-Za-z/])", re.IGNORECASE)
NEAR = 1e-6
"""Largest difference of a position in a .REN from start + number * spacing, as a share of the range."""
Table = tuple[list[float], list[float], list[str], list[int]]
"""Positions, values, the values as printed, line numbers."""


def read_pos(name: str, data: bytes) -> Content:
    """Read a .pos of an API laser: tables of mean deviations, mm. A forward and a reverse table become one test with both approaches.

    Raises
    ------
    FileFormatError
        The file is incomplete or contradicts itself; the message has the line.
    """
    file = text_file(name, data)
    tables, said, last = _pos_tables(file)
    if not tables:
        raise file.wrong(last, "no table 'Position ... Avg Error': the file is cut off, or is not a .pos file")
    ways = sorted(way for way in tables if way) or [0.0]
    if ways == [0.0, 1.0] or ways in ([1.0], [-1.0]):
        raise file.wrong(last, "the table of the other direction is missing: the file is cut off")
    chosen = [(way, tables[way]) for way in reversed(ways)]
    for _, other in chosen[1:]:
        if other[0] != chosen[0][1][0]:
            raise file.wrong(other[3][0], "the tables have different positions")
    if len(chosen) == 2 and 0.0 in tables:
        _check_mean(file, tables[0.0], chosen[0][1], chosen[1][1])
    test = AxisReadings(
        quantity="length",
        axis=axis_of(said.get("axis", "")),
        position_mm=np.concatenate([table[0] if way >= 0 else table[0][::-1] for way, table in chosen]),
        direction=np.concatenate([np.full(len(table[0]), way) for way, table in chosen]),
        deviation=np.concatenate([table[1] if way >= 0 else table[1][::-1] for way, table in chosen]),
        resolution=step_of([word for _, table in chosen for word in table[2]], 1.0),
        means=True,
        sign_known=False,
    )
    return _content(name, data, "API .pos", said, test)


def _pos_tables(file: TextFile) -> tuple[dict[float, Table], dict[str, str], int]:
    tables, said, now, line = dict[float, Table](), dict[str, str](), None, 1
    for line, text in file.lines():
        head = _POS_HEAD.fullmatch(text.strip())
        if head is not None:
            way = _WAYS[head.group(1)]
            if way in tables:
                raise file.wrong(line, f"the file has two tables of {head.group(1)} means")
            now = tables.setdefault(way, ([], [], [], []))
        elif _OTHER_HEAD.match(text):
            raise file.wrong(line, f"{text.strip()[:60]!r} is not a known table", "send the file to the people who write Abbe")
        elif now is not None and text.strip():
            _row(file, line, text, now)
        elif now is None and ":" in text:
            key, _, value = text.partition(":")
            said[" ".join(key.split()).lower()] = value.strip()
    for way, table in tables.items():
        if len(table[0]) < 2:
            raise file.wrong(line, f"the {_NAMES[way]} table has {len(table[0])} rows, expected two or more: the file is cut off")
    return tables, said, line


def _row(file: TextFile, line: int, text: str, table: Table) -> None:
    cells = text.split()
    if len(cells) != 2:
        raise file.wrong(line, f"{len(cells)} values, expected a position and a mean")
    position, value = (file.number(line, cell, what) for cell, what in zip(cells, ("the position", "the mean"), strict=True))
    if table[0] and position <= table[0][-1]:
        raise file.wrong(line, f"position {position:g} after {table[0][-1]:g}: positions have to rise from line to line")
    table[0].append(position)
    table[1].append(value)
    table[2].append(cells[1])
    table[3].append(line)


def _check_mean(file: TextFile, mean: Table, one: Table, other: Table) -> None:
    step = step_of([*mean[2], *one[2], *other[2]], 1.0)
    if mean[0] != one[0]:
        raise file.wrong(mean[3][0], "the tables have different positions")
    for line, m, a, b in zip(mean[3], mean[1], one[1], other[1], strict=True):
        if abs(m - (a + b) / 2.0) > 1.01 * step:
            raise file.wrong(line, f"the mean of both directions is {m:g}, but their tables give {(a + b) / 2.0:g}")


def read_ren(name: str, data: bytes) -> Content:
    """Read a .REN: equally spaced values of a compensation that combines both directions.

    Raises
    ------
    FileFormatError
        The file is incomplete or contradicts itself; the message has the line.
    """
    file = text_file(name, data)
    said, facts, head = dict[str, str](), dict[str, float](), 0
    positions, values, words, unit, line = list[float](), list[float](), list[str](), set[str](), 1
    for line, text in file.lines():
        if head and text.strip():
            position, word = _ren_row(file, line, text, len(values) + 1)
            positions.append(position)
            values.append(file.number(line, word, "the value"))
            words.append(word)
        elif _REN_HEAD.match(text.strip()):
            head = line
            unit |= {_unit(found) for found in _UNITS.findall(text)}
        elif text.strip():
            _ren_fact(file, line, text, facts, said)
            unit |= {_unit(found) for found in _UNITS.findall(text.partition(":")[2])} if "unit" in text.lower() else set()
    if not head or len(values) < 2 or len(facts) != len(_REN_FACTS):
        raise file.wrong(
            line, "spacing, start, end or the table 'No. Axis position Combined' is missing: the file is cut off, or not a .REN"
        )
    _check_spacing(file, line, _Grid(**facts), np.array(positions))
    known = len(unit) == 1
    factor = LENGTHS[next(iter(unit))] if known else 1.0
    test = AxisReadings(
        quantity="length",
        axis=axis_of(said.get("axis", "")),
        position_mm=np.array(positions),
        direction=np.zeros(len(values)),
        deviation=np.array(values) * factor,
        resolution=step_of(words, factor),
        means=True,
        sign_known=False,
    )
    return _content(name, data, "Renishaw .REN", said, test, unit_known=known)


def _ren_row(file: TextFile, line: int, text: str, number: int) -> tuple[float, str]:
    cells = text.split()
    if len(cells) != 3:
        raise file.wrong(line, f"{len(cells)} values, expected number, position and value")
    if cells[0] not in (str(number), f"{number - 1}") or (number == 1 and cells[0] != "1" and cells[0] != "0"):
        raise file.wrong(line, f"the number is {cells[0]!r}, expected {number}")
    return file.number(line, cells[1], "the position"), cells[2]


def _ren_fact(file: TextFile, line: int, text: str, facts: dict[str, float], said: dict[str, str]) -> None:
    name = next((key for words, key in _REN_FACTS.items() if words in text.lower()), None)
    if name is not None:
        numbers = re.findall(r"[-+]?[0-9]*\.?[0-9]+", text)
        if not numbers or name in facts:
            raise file.wrong(line, f"the compensation's {name} has no number, or is repeated")
        facts[name] = file.number(line, numbers[0], name)
    elif ":" in text:
        key, _, value = text.partition(":")
        said[" ".join(key.split()).lower()] = value.strip()


def _unit(word: str) -> str:
    word = word.lower()
    return "nm" if word == "nm" else "mm" if word.startswith(("mm", "milli")) else "um"


@dataclass(frozen=True, slots=True)
class _Grid:
    """The positions that a .REN states, mm."""

    spacing: float
    start: float
    end: float


def _check_spacing(file: TextFile, last: int, grid: _Grid, position: F1) -> None:
    wanted = grid.start + grid.spacing * np.arange(position.size)
    off = np.flatnonzero(np.abs(position - wanted) > NEAR * max(1.0, abs(grid.end - grid.start)))
    if grid.spacing == 0.0 or off.size or abs(wanted[-1] - grid.end) > NEAR * max(1.0, abs(grid.end)):
        at = last - position.size + 1 + (int(off[0]) if off.size else position.size - 1)
        stated = f"from {grid.start:g} to {grid.end:g} in steps of {grid.spacing:g}"
        raise file.wrong(at, f"expected {position.size} positions {stated}, as the file states")


def _content(name: str, data: bytes, form: str, said: Mapping[str, str], test: AxisReadings, *, unit_known: bool = True) -> Content:
    both = "means of both directions: no reversal and no repeatability" if not test.direction.any() else "means: no repeatability"
    return Content(
        name=name,
        form=form,
        sha256=digest(data),
        machine=said.get("machine", ""),
        said={key.capitalize(): value for key, value in said.items() if value},
        test=test,
        notes=(f"the values are {both}",),
        unit_known=unit_known,
    )
