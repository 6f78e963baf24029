"""Disk space that is held back so that a run can be closed when the disk is full."""

from __future__ import annotations

from pathlib import Path

from abbe.service.capture.file_io import FileIO
from abbe.service.capture.segment import fault


class Reserve:
    """A file of a given size in the folder of the segments.

    Parameters
    ----------
    io : FileIO
        Where files are.
    folder : Path
        Of the segments.
    size : int
        Bytes.
    """

    def __init__(self, io: FileIO, folder: Path, size: int) -> None:
        self._io, self._folder, self._size = io, folder, size
        self._path = folder / "reserve"
        self._held = False

    def hold(self) -> None:
        """Make sure that it is there; of size 0 there is none.

        Raises
        ------
        DiskFull, CaptureFault
            There is no room for it: nothing should be begun.
        """
        if not self._size:
            return
        try:
            self._io.hold_space(self._path, self._size)
            self._io.sync_folder(self._folder)
        except OSError as error:
            raise fault(self._path, "hold back disk space", error) from error
        self._held = True

    def release(self) -> bool:
        """Give the space back; False when it was given back before or cannot be."""
        if not self._held:
            return False
        self._held = False
        try:
            self._io.remove(self._path)
            self._io.sync_folder(self._folder)
        except OSError:
            return False
        return True
