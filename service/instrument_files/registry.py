"""Which reader reads a file, by its ending."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.ballbar import read_b5r
from abbe.service.instrument_files.columns import ColumnFile, read_table, table_of
from abbe.service.instrument_files.content import Content, read_bytes
from abbe.service.instrument_files.dynamic import read_rtx
from abbe.service.instrument_files.mean_tables import read_pos, read_ren
from abbe.service.instrument_files.renishaw import read_renishaw

READERS: Mapping[str, Callable[[str, bytes], Content]] = {
    ".rtl": read_renishaw,
    ".rta": read_renishaw,
    ".rtx": read_rtx,
    ".pos": read_pos,
    ".ren": read_ren,
    ".b5r": read_b5r,
}
"""Reader of each ending, in small letters: from a file's name and its bytes."""
TABLES = (".csv", ".tsv", ".txt", ".xlsx", ".xlsm")
"""Endings of tables, which need a column file."""


def is_table(path: Path) -> bool:
    """Whether a file is a table that needs a column file."""
    return path.suffix.lower() in TABLES


def read_file(path: Path, columns: ColumnFile | None = None) -> Content:
    """Read a file of an instrument; a table needs ``columns``.

    Raises
    ------
    FileFormatError
        Its ending is not known, a table has no column file, or its content is wrong or incomplete; the message has the line.
    """
    if is_table(path):
        if columns is None:
            raise FileFormatError(
                f"{path.name}: what are the columns?", "give --columns FILE (docs/how-to/import.md), or answer at a terminal"
            )
        return read_table(path.name, read_bytes(path), columns)
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
        It is no table.
    """
    return table_of(path.name, read_bytes(path), heading).headings(heading)
