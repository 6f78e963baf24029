"""Atomic writing of a page to disk."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from abbe.service.errors import FileFormatError


def write_page(text: str | bytes, target: Path) -> None:
    """Write a page (or the bytes of a PDF) to a temporary file and rename it: a reader sees the old file or the whole new one.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    aside: Path | None = None
    try:
        if target.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        handle, name = tempfile.mkstemp(prefix=f".{target.name}-", dir=target.parent)
        aside = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(text.encode() if isinstance(text, str) else text)
            file.flush()
            os.fsync(file.fileno())
        aside.chmod(0o644)  # mkstemp creates private files
        aside.replace(target)
    except OSError as error:
        if aside is not None:
            aside.unlink(missing_ok=True)
        raise FileFormatError(f"{target}: cannot be written: {error.strerror}", "give a file in a writable folder") from None
