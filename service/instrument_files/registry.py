"""Which reader reads a file, by its ending."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.content import Content, read_bytes
from abbe.service.instrument_files.renishaw import read_renishaw

READERS: Mapping[str, Callable[[str, bytes], Content]] = {
    ".rtl": read_renishaw,
    ".rta": read_renishaw,
}
"""Reader of each ending, in small letters: from a file's name and its bytes."""


def read_file(path: Path) -> Content:
    """Read a file of an instrument.

    Raises
    ------
    FileFormatError
        Its ending is not known, or its content is wrong or incomplete; the message has the line.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise FileFormatError(
            f"{path.name}: files {', '.join(READERS)} can be imported, and folders with campaign.json", "give one of these"
        )
    return reader(path.name, read_bytes(path))
