"""One-axis tables as files that the control reads at its start (COMP_FILE), in sets; a single rename exchanges a whole set.

In the run folder ``tables`` is a link to the set that the next start reads. A set is a folder with ``image.bin`` and the three files made
from it. A set is complete and on the disk before the link points to it, so the control never finds an incomplete set.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from image import checksum, data_of, empty, plan, words_of
from network import AXES, Vertices

_ACTING = "acting"
_FAR_MM = 1000.0


class TablesAltered(Exception):  # noqa: N818 - reads as what it is
    """The files on the disk are not those of their image."""


def text_of(vertices: Vertices) -> str:
    """Return a COMP_FILE of type 1: triples of nominal, forward and reverse, mm; the last two are added to the command.

    The file has no header and no comment, because the control stops reading, without a message, at the first line that is not a triple.
    """
    rows = vertices or ((0.0, 0.0), (_FAR_MM, 0.0))
    return "".join(f"{nominal:.5f} {value:.6f} {value:.6f}\n" for nominal, value in rows)


class TableSets:
    """The sets in one run folder."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._link = run / "tables"

    def prepare(self) -> None:
        """Make sure that there is a set for the control to read."""
        if not self._link.exists():
            self.stage(empty())

    def stage(self, words: list[int]) -> None:
        """Write an image's set and let the next start of the control read it."""
        crc = checksum(words)
        folder = self._run / f"set-{crc:08x}"
        shutil.rmtree(folder, ignore_errors=True) if self._link.resolve() != folder else None
        folder.mkdir(exist_ok=True)
        files = plan(words).files
        contents = {f"{a}.comp": text_of(files.get(a, ())).encode() for a in AXES}
        contents["image.bin"] = data_of(words[: words[3]])
        for name, data in contents.items():
            _write(folder / name, data)
        _sync(folder)
        fresh = self._run / "tables.new"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(folder.name)
        fresh.replace(self._link)
        _sync(self._run)

    def staged(self) -> list[int]:
        """Image of the set that the next start reads.

        Raises
        ------
        TablesAltered
            A file was changed since the bridge wrote it.
        """
        return self._image(self._link.resolve())

    def acting(self, *, fresh_start: bool) -> list[int]:
        """Image of the set that the running control has read; ``fresh_start``: the control has just started and read the present set.

        Raises
        ------
        TablesAltered
            A file was changed since the bridge wrote it.
        """
        note = self._run / _ACTING
        if fresh_start or not note.exists():
            self.staged()
            _write(note, self._link.resolve().name.encode())
        return self._image(self._run / note.read_text())

    def _image(self, folder: Path) -> list[int]:
        try:
            words = words_of((folder / "image.bin").read_bytes())
            files = plan(words).files
            altered = [a for a in AXES if (folder / f"{a}.comp").read_text() != text_of(files.get(a, ()))]
        except (OSError, ValueError) as error:
            raise TablesAltered(f"{folder.name}: {error}") from None
        if altered:
            names = ", ".join(f"{a}.comp" for a in altered)
            raise TablesAltered(f"{folder.name}: {names} is not what the bridge wrote; remove the link 'tables' to begin with empty tables")
        return words


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
