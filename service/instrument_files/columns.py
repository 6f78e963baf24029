"""Import of any table of readings (CSV, TSV, XLSX). A file describes its columns; without one, Abbe asks about each column."""

from __future__ import annotations

import csv
import io
import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from abbe.models.arrays import F1
from abbe.service.config_schema import COLDEST_C, WARMEST_C
from abbe.service.errors import AbbeError, FileFormatError, location_text, mistakes
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.answers import ANGLES, LENGTHS
from abbe.service.instrument_files.content import AxisReadings, Content, axis_of, digest, read_bytes, step_of, text_file

TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
TEMPERATURES = {"C": 0.0, "K": -273.15}
"""Units of temperature, and the offset that converts each to °C."""
PRESSURES = {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1000.0}
POSSIBLE_PA = (60_000.0, 110_000.0)
MOST_ROWS = 200_000
Sensor = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
Column = Annotated[str | int, Field(description="heading of the column, or its number from 1")]


class ColumnFilePart(BaseModel):
    """Base of the objects of a column file: unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class MeasuredColumn(ColumnFilePart):
    """One column with a unit."""

    column: Column
    unit: str


class Direction(ColumnFilePart):
    """The column that says from which side a target was approached, and its words for + and - of the axis."""

    column: Column
    plus: str = "+"
    minus: str = "-"


def toml_of(columns: ColumnFile) -> str:
    """The column file as TOML, without default values."""
    doc = columns.model_dump(exclude_none=True, exclude_defaults=True)
    plain = {key: value for key, value in doc.items() if not isinstance(value, dict)}
    lines = ['format = "abbe-columns/1"', *(f"{key} = {json.dumps(value)}" for key, value in plain.items())]
    tables = {key: part for key, part in doc.items() if isinstance(part, dict)}
    tables |= {f"temperatures.{name}": part for name, part in tables.pop("temperatures", {}).items()}
    for key, part in tables.items():
        lines += [f"\n[{key}]", *(f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in part.items())]
    return "\n".join(lines) + "\n"


class ColumnFile(ColumnFilePart):
    """Meaning of the columns of a table (``abbe-columns/1``, TOML).

    The readings are in ``measured`` (positions) or ``deviation``. Without ``direction`` the order of the targets decides the direction.
    Without ``target`` the axis stood at ``at_mm``; then ``time``, or ``every_s`` from row to row, says when it was read.
    ``temperatures``: further sensors by name. ``heading``: row of the headings, 0 for none; rows above it are not read. ``decimal``: the
    decimal sign of a text file.
    """

    format: Literal["abbe-columns/1"] = "abbe-columns/1"
    axis: Literal["X", "Y", "Z"]
    target: MeasuredColumn | None = None
    at_mm: float | None = None
    measured: MeasuredColumn | None = None
    deviation: MeasuredColumn | None = None
    direction: Direction | None = None
    time: MeasuredColumn | None = None
    every_s: float | None = Field(default=None, gt=0.0)
    scale_temperature: MeasuredColumn | None = None
    spindle_temperature: MeasuredColumn | None = None
    air_temperature: MeasuredColumn | None = None
    air_pressure: MeasuredColumn | None = None
    temperatures: dict[Sensor, MeasuredColumn] = Field(default_factory=dict)
    heading: int = Field(default=1, ge=0, le=1000)
    delimiter: Literal[",", ";", "tab", "blank"] | None = None
    decimal: Literal[".", ","] = "."
    sheet: str | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if (self.measured is None) == (self.deviation is None):
            raise ValueError("expected either measured (positions) or deviation, got " + ("none" if self.measured is None else "both"))
        if (self.target is None) != (self.at_mm is not None and (self.time or self.every_s) is not None):
            raise ValueError("expected either target, or at_mm (where the axis stood) with time or every_s")
        stated = [(name, getattr(self, name), units) for name, units in _UNITS.items()]
        stated += [(f"temperatures.{name}", one, TEMPERATURES) for name, one in self.temperatures.items()]
        for name, one, units in stated:
            if one is not None and one.unit not in units:
                raise ValueError(f"{name}.unit is {one.unit!r}, expected one of {', '.join(units)}")
        return self


_UNITS: dict[str, Any] = {
    "target": LENGTHS,
    "measured": LENGTHS,
    "deviation": LENGTHS | ANGLES,
    "time": TIMES,
    "scale_temperature": TEMPERATURES,
    "spindle_temperature": TEMPERATURES,
    "air_temperature": TEMPERATURES,
    "air_pressure": PRESSURES,
}


@dataclass(frozen=True, slots=True)
class FileRows:
    """A table: each row with its number in the file, and its cells as text."""

    file: TextFile
    rows: list[tuple[int, list[str]]]

    def headings(self, heading: int) -> list[str]:
        """Cells of the row of headings; numbers from 1 if there is no such row."""
        if heading:
            found = next((cells for line, cells in self.rows if line == heading), None)
            if found is None:
                raise self.file.wrong(heading, "the row of headings is empty, or the file is shorter")
            return [cell.strip() for cell in found]
        return [str(k + 1) for k in range(len(self.rows[0][1]))]


def column_file(path: Path) -> ColumnFile:
    """Read a column file.

    Raises
    ------
    FileFormatError
        The file has a mistake; the message names the key.
    """
    try:
        return ColumnFile.model_validate(tomllib.loads(read_bytes(path).decode("utf-8")))
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: is not UTF-8 text", "see docs/reference/instrument-files.md") from None
    except tomllib.TOMLDecodeError as err:
        raise FileFormatError(f"{path}: not valid TOML: {err}", "see docs/reference/instrument-files.md") from None
    except ValidationError as err:
        first = mistakes(err.errors())[0]
        place = location_text(first.place)
        raise FileFormatError(
            f"{path}: {f'{place}: ' if place else ''}{first.expected}", "see docs/reference/instrument-files.md"
        ) from None


def table_of(name: str, data: bytes, heading: int, delimiter: str | None = None, sheet: str | None = None) -> FileRows:
    """Return the cells of a CSV, TSV or XLSX file. Without ``delimiter``, the row ``heading`` shows how a text file is divided.

    Raises
    ------
    FileFormatError
        The file is of another kind, or has no rows.
    """
    if name.lower().endswith((".xlsx", ".xlsm")):
        return _excel(name, data, sheet)
    file = text_file(name, data)
    sign = _delimiter(file, heading, delimiter)
    rows = []
    for line, text in file.lines():
        if text.strip():
            try:
                rows.append((line, text.split() if sign == " " else next(csv.reader([text], delimiter=sign, strict=True))))
            except csv.Error as err:
                raise file.wrong(line, f"not a row of a table: {err}") from None
        if len(rows) > MOST_ROWS:
            raise file.wrong(line, f"more than {MOST_ROWS} rows")
    if not rows:
        raise file.wrong(1, "the table is empty")
    return FileRows(file, rows)


def _delimiter(file: TextFile, heading: int, delimiter: str | None) -> str:
    if delimiter is not None:
        return {"tab": "\t", "blank": " "}.get(delimiter, delimiter)
    first = next((text for line, text in file.lines() if line >= heading and text.strip()), "")
    return next((sign for sign in ("\t", ";", ",") if sign in first), " ")


def _excel(name: str, data: bytes, sheet: str | None) -> FileRows:
    try:
        from python_calamine import CalamineError, CalamineWorkbook
    except ModuleNotFoundError:
        raise FileFormatError(
            f"{name}: reading Excel files needs a library", "pip install 'abbe[excel]', or save the table as CSV"
        ) from None
    file = TextFile(name, "", FileFormatError)
    try:
        book = CalamineWorkbook.from_filelike(io.BytesIO(data))
        names = book.sheet_names
        if sheet is not None and sheet not in names:
            raise file.wrong(1, f"there is no sheet {sheet!r}; there are {', '.join(names)}")
        cells = book.get_sheet_by_name(sheet or names[0]).to_python(skip_empty_area=False)
    except (CalamineError, IndexError) as err:
        raise file.wrong(1, f"not an Excel workbook: {' '.join(str(err).split())}", "save it again") from None
    rows = [(k, [_text(cell) for cell in row]) for k, row in enumerate(cells, start=1)]
    rows = [(line, row) for line, row in rows if any(row)]
    if not rows or len(rows) > MOST_ROWS:
        raise file.wrong(1, f"the sheet has {len(rows)} rows, expected 1 to {MOST_ROWS}")
    return FileRows(file, rows)


def _text(cell: Any) -> str:
    return repr(cell) if isinstance(cell, float) else str(cell).strip()


POSITIONS_SHARE = 0.1
"""Deviations that differ from their targets by less than this share of the stroke are positions."""


@dataclass(frozen=True, slots=True)
class _ReadingRows:
    """The rows of readings of a table, its headings, and the meaning of its columns."""

    table: FileRows
    columns: ColumnFile
    headings: list[str]
    rows: list[tuple[int, list[str]]]

    def wrong(self, row: int, what: str) -> AbbeError:
        """An error about a row of readings, counted from 0."""
        return self.table.file.wrong(self.rows[row][0], what)

    def index(self, wanted: str | int) -> int:
        """Place of a column in a row, from 0."""
        line = self.columns.heading or 1
        if isinstance(wanted, int):
            if not 1 <= wanted <= len(self.headings):
                raise self.table.file.wrong(line, f"there is no column {wanted}, the row has {len(self.headings)}")
            return wanted - 1
        if self.headings.count(wanted) != 1:
            found = "two columns" if wanted in self.headings else "no column"
            raise self.table.file.wrong(line, f"{found} {wanted!r}; headings are {', '.join(self.headings)[:200]}")
        return self.headings.index(wanted)

    def numbers(self, name: str) -> tuple[F1, list[str]]:
        """Return the values of a column of the column file, in its unit, and the texts of its cells."""
        return self.values(getattr(self.columns, name), name.replace("_", " "))

    def values(self, one: MeasuredColumn, what: str) -> tuple[F1, list[str]]:
        """Return the values of a column, in its unit, and the texts of its cells."""
        k, words = self.index(one.column), list[str]()
        for row, (_, cells) in enumerate(self.rows):
            if len(cells) <= k:
                raise self.wrong(row, f"only {len(cells)} cells, but {what} is in column {k + 1}")
            words.append(self._plain(row, cells[k].strip()))
        values = [self.table.file.number(line, word, what) for (line, _), word in zip(self.rows, words, strict=True)]
        return np.array(values), words

    def _plain(self, row: int, word: str) -> str:
        if self.columns.decimal == "." or not self.table.file.text:  # the cells of a workbook are numbers
            return word
        if "." in word:
            raise self.wrong(row, f"{word!r} has a point, but the decimal sign is a comma")
        return word.replace(",", ".")


def read_table(name: str, data: bytes, columns: ColumnFile) -> Content:
    """Read a table by its column file.

    Raises
    ------
    FileFormatError
        A column is missing, or a cell is wrong; the message has the row.
    """
    table = table_of(name, data, columns.heading, columns.delimiter, columns.sheet)
    headings = table.headings(columns.heading)
    body = _ReadingRows(table, columns, headings, [(line, cells) for line, cells in table.rows if line > columns.heading])
    if len(body.rows) < 2:
        raise table.file.wrong(table.rows[-1][0], f"{len(body.rows)} rows of readings, expected two or more")
    for row, (_, cells) in enumerate(body.rows):
        if len(cells) > len(headings) and any(cell.strip() for cell in cells[len(headings) :]):
            raise body.wrong(row, f"{len(cells)} cells under {len(headings)} headings: are decimals or the delimiter commas?")
    position, way, noted = _places(body)
    deviation, resolution, quantity = _deviations(body, position)
    return Content(
        name=name,
        form="table",
        sha256=digest(data),
        machine="",
        said={"Columns": ", ".join(headings)} | {"Rows": str(len(body.rows))},
        test=AxisReadings(
            quantity=quantity,
            axis=axis_of(columns.axis),
            position_mm=position,
            direction=way,
            deviation=deviation,
            resolution=resolution,
            t_s=_times(body),
            further=_further(body),
        ),
        notes=(noted,) if noted else (),
    )


def _places(body: _ReadingRows) -> tuple[F1, F1, str]:
    """Return position and direction of each reading, and a note on their origin."""
    columns, n = body.columns, len(body.rows)
    if columns.target is None:
        at = float(columns.at_mm or 0.0)
        return np.full(n, at), np.ones(n), f"the axis stood at {at:g} mm: its readings are relative to the first one"
    target = body.numbers("target")[0] * LENGTHS[columns.target.unit]
    if columns.direction is None:
        return target, _by_order(body, target), "the table has no direction column: the order of the targets decided the direction"
    return target, _by_words(body, columns.direction), ""


def _deviations(body: _ReadingRows, position: F1) -> tuple[F1, float, str]:
    """Deviations in mm or rad, their step, and the quantity."""
    name, one = ("deviation", body.columns.deviation) if body.columns.deviation is not None else ("measured", body.columns.measured)
    assert one is not None
    value, words = body.numbers(name)
    unit = (LENGTHS | ANGLES)[one.unit]
    value = value * unit
    if body.columns.target is None:
        value = value - value[0]
    elif name == "measured":
        value = value - position
    elif one.unit in LENGTHS and np.ptp(position) > 0.0 and np.abs(value - position).max() < POSITIONS_SHARE * np.ptp(position):
        far = int(np.abs(position).argmax())
        follow = f"the deviations follow the targets ({value[far]:g} mm at {position[far]:g} mm)"
        raise body.wrong(far, f"{follow}: are they positions? Then name the column [measured]")
    return value, step_of(words, unit), "angle" if one.unit in ANGLES else "length"


def _by_words(body: _ReadingRows, direction: Direction) -> F1:
    k, words = body.index(direction.column), {direction.plus: 1.0, direction.minus: -1.0}
    for row, (_, cells) in enumerate(body.rows):
        if len(cells) <= k or cells[k].strip() not in words:
            found = cells[k].strip() if len(cells) > k else "missing"
            raise body.wrong(row, f"the direction is {found!r}, expected {direction.plus!r} or {direction.minus!r}")
    return np.array([words[cells[k].strip()] for _, cells in body.rows])


def _by_order(body: _ReadingRows, target: F1) -> F1:
    step = np.sign(np.diff(target))
    for k in range(1, step.size):
        if step[k] == 0.0 == step[k - 1]:
            raise body.wrong(k + 1, f"target {target[k + 1]:g} mm three times in a row: the order gives no direction")
    if not step.any():
        raise body.wrong(0, "all targets are equal: the order gives no direction")
    # The first reading, and the second one at a turning point, belong to the way that follows.
    way = np.concatenate([[0.0], step])
    for k in reversed(range(way.size)):
        if way[k] == 0.0:
            way[k] = way[k + 1] if k + 1 < way.size else -way[k - 1]
    return way


def _times(body: _ReadingRows) -> F1 | None:
    if body.columns.time is None:
        every = body.columns.every_s
        return None if every is None else every * np.arange(len(body.rows), dtype=np.float64)
    t = body.numbers("time")[0] * TIMES[body.columns.time.unit]
    back = np.flatnonzero(np.diff(t) < 0.0)
    if back.size:
        raise body.wrong(int(back[0]) + 1, "the time goes back")
    return t


def _further(body: _ReadingRows) -> dict[str, F1]:
    columns = body.columns
    stated = [
        ("scale temperature", f"temp_{columns.axis.lower()}_C", columns.scale_temperature),
        ("spindle temperature", "temp_spindle_C", columns.spindle_temperature),
        ("air temperature", "temp_air_C", columns.air_temperature),
        ("air pressure", "pressure_air_Pa", columns.air_pressure),
        *((f"temperature {name}", f"temp_{name}_C", one) for name, one in columns.temperatures.items()),
    ]
    out = dict[str, F1]()
    for what, column, one in stated:
        if one is not None:
            values = body.values(one, what)[0]
            values = values + TEMPERATURES[one.unit] if one.unit in TEMPERATURES else values * PRESSURES[one.unit]
            low, high = (COLDEST_C, WARMEST_C) if one.unit in TEMPERATURES else POSSIBLE_PA
            odd = np.flatnonzero((values < low) | (values > high))
            if odd.size:
                raise body.wrong(int(odd[0]), f"{what} is {values[odd[0]]:g}, expected {low:g} to {high:g}: is the unit {one.unit}?")
            out[column] = values
    return out


_DECIMAL_COMMA = re.compile(rb"(?:^|[;\t ])\s*[-+]?\d+,\d+\s*(?:[;\t ]|$)", re.MULTILINE)


def has_decimal_commas(data: bytes) -> bool:
    """Whether a text table holds numbers with a comma between other delimiters, like ``50,25;``."""
    return _DECIMAL_COMMA.search(data) is not None


def guesses(headings: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Guess the heading of each column of a `ColumnFile` by common words."""
    words = {
        "target": r"target|nominal|position|pos|soll",
        "deviation": r"deviation|error|dev|fehler|abweichung",
        "measured": r"measured|actual|reading|ist",
        "direction": r"direction|dir|richtung",
        "time": r"time|zeit",
    }
    for name, pattern in words.items():
        found = next((one for one in headings if re.search(rf"(?<![A-Za-z])(?:{pattern})(?![A-Za-z])", one, re.IGNORECASE)), None)
        if found is not None:
            yield name, found
