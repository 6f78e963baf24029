"""Reader of a file by its ending; and a preview of its import as text, for the person who decides."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from abbe.service.domain.run_file import SourceFile
from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.ballbar import read_b5r
from abbe.service.instrument_files.columns import ColumnFile, guesses, read_table, table_of
from abbe.service.instrument_files.content import AxisReadings, Content, read_bytes, text_file
from abbe.service.instrument_files.dynamic import read_rtx
from abbe.service.instrument_files.mean_tables import read_pos, read_ren
from abbe.service.instrument_files.renishaw import read_renishaw
from abbe.service.rendering.numbers import plain

READERS: Mapping[str, Callable[[str, bytes], Content]] = {
    ".rtl": read_renishaw,
    ".rta": read_renishaw,
    ".rtx": read_rtx,
    ".pos": read_pos,
    ".ren": read_ren,
    ".b5r": read_b5r,
}
"""Reader of each ending (in small letters); it gets a file's name and bytes."""
WORKBOOKS = (".xlsx", ".xlsm")
TABLES = (".csv", ".tsv", ".txt", *WORKBOOKS)
"""Endings of tables, which need a column file."""


def is_table(path: Path) -> bool:
    """Whether a file is a table that needs a column file."""
    return path.suffix.lower() in TABLES


def read_file(path: Path, columns: ColumnFile | None = None) -> Content:
    """Read a file of an instrument; a table needs ``columns``.

    Raises
    ------
    FileFormatError
        The file is missing, its ending is not known, a table has no column file, or its content is wrong or incomplete; the message has
        the line.
    """
    if is_table(path):
        raw = read_bytes(path)
        if columns is None:
            raise FileFormatError(
                f"{path.name}: what are the columns?", "give --columns FILE (docs/reference/instrument-files.md), or answer at a terminal"
            )
        return read_table(path.name, raw, columns)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join((*READERS, *TABLES))
        raise FileFormatError(f"{path.name}: files {known} can be imported, and folders with campaign.json", "give one of these")
    return reader(path.name, read_bytes(path))


def headings_of(path: Path, heading: int) -> list[str]:
    """Headings of a table, for questions about them; numbers from 1 if ``heading`` is 0.

    Raises
    ------
    FileFormatError
        The file is no table.
    """
    return table_of(path.name, read_bytes(path), heading).headings(heading)


FIRST_ROWS = 40
NUMBER = re.compile(r"[-+]?[0-9]+([.,][0-9]*)?([eE][-+]?[0-9]+)?")


def likely_heading(path: Path) -> int:
    """Row that looks most like headings: of the first forty rows, the one with the most columns of known meaning, above a row with a
    number; 1 if no row has two such columns.

    Raises
    ------
    FileFormatError
        The file cannot be read.
    """
    raw, most, found = read_bytes(path), 1, 1
    book = table_of(path.name, raw, 1) if path.suffix.lower() in WORKBOOKS else None
    first = b"" if book else "\n".join(text for _, text in islice(text_file(path.name, raw).lines(), FIRST_ROWS)).encode()
    for row in range(1, FIRST_ROWS + 1):
        try:
            table = book or table_of(path.name, first, row)
            known = len({name for _, name in guesses(table.headings(row))})
        except FileFormatError:
            continue
        below = [cell for line, cells in table.rows if row < line <= row + 2 for cell in cells]
        if known > most and any(NUMBER.fullmatch(cell.strip()) for cell in below):
            most, found = known, row
    return found


UM = 1e3
URAD = 1e6


def preview_rows(content: Content, test: AxisReadings | None, origin: SourceFile) -> list[tuple[str, str]]:
    """Rows of a preview of one file: kind, stated facts, readings, unread parts, unknown facts."""
    out = [("file", content.name), ("format", content.form), ("machine", content.machine or "not stated")]
    if test is not None:
        out += _test_rows(test)
    if content.trace is not None:
        trace = content.trace
        out.append(("trace", f"{trace.samples.size} samples, {plain(trace.rate_hz)} a second"))
    out += [(f"{one.group} {one.symbol}".strip(), f"{one.value:g} {one.unit} ({one.name})") for one in content.stated]
    out += [(f"said: {name}", value) for name, value in content.said.items()]
    return out + [("note", note) for note in content.notes] + [("unknown", text) for text in origin.unknown]


def _test_rows(test: AxisReadings) -> list[tuple[str, str]]:
    factor, unit = (UM, "µm") if test.quantity == "length" else (URAD, "µrad")
    targets, count = np.unique(test.position_mm, return_counts=True)
    ways = {1.0: "+", -1.0: "-", 0.0: "means of both directions"}
    moving = ", ".join(ways[way] for way in sorted(set(test.direction.tolist()), reverse=True))
    few, many = int(count.min()), int(count.max())
    visits = f"{few} times" if few == many else f"{few} to {many} times"
    first = ", ".join(
        f"{p:g} mm {ways.get(d, '')} {v * factor:g} {unit}"
        for p, d, v in zip(test.position_mm[:3], test.direction[:3], test.deviation[:3], strict=True)
    )
    return [
        ("axis", test.axis),
        ("targets", f"{targets.size} from {targets[0]:g} to {targets[-1]:g} mm, each read {visits}, moving {moving}"),
        ("readings", f"{test.deviation.size} from {test.deviation.min() * factor:g} to {test.deviation.max() * factor:g} {unit}"),
        ("resolution", f"{test.resolution * factor:g} {unit}, by the printed decimals"),
        ("first readings", first),
    ]
