"""What becomes of a segment whose run is closed: deleted, kept, or renamed because something in it is damaged."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from abbe.service.capture.file_io import RealFileIO
from abbe.service.capture.scan import Scan
from abbe.service.capture.settings import DAMAGED_SUFFIX, TAIL, free_name, set_aside


def put_away(path: Path, held: Scan, *, keep: bool) -> None:
    """Delete or keep a segment that was taken over; nothing that could not be read is deleted. Never raises: the next start tries again.

    Parameters
    ----------
    path : Path
        The file.
    held : Scan
        What is in it.
    keep : bool
        Keep it although the database has everything.
    """
    with suppress(OSError):
        if held.damaged or (held.tail_bytes and not _copied(path, held.good_bytes)):
            set_aside(path, DAMAGED_SUFFIX)
        elif not keep:
            path.unlink(missing_ok=True)
        elif held.tail_bytes:
            with path.open("r+b") as file:
                file.truncate(held.good_bytes)
                os.fsync(file.fileno())


def _copied(path: Path, begin: int) -> bool:
    """Copy the end of a file to a file of its own, onto the disk; False when there is no room or the disk reports an error."""
    copy = free_name(path, TAIL)
    try:
        with path.open("rb") as file, copy.open("xb") as other:
            file.seek(begin)
            other.write(file.read())
            other.flush()
            os.fsync(other.fileno())
        RealFileIO().sync_folder(path.parent)
    except OSError:
        with suppress(OSError):
            copy.unlink(missing_ok=True)
        return False
    return True
