"""Table files for a control: put into its folder (share, medium) or its OPC UA files, read back, kept, confirmed, taken back.

Beside the exported files ``OUT`` a folder ``OUT.dropped`` holds ``receipt.json`` (`abbe-drop/1`) and ``before/``, the files that lay in the
control's folder. The receipt is on disk before the first file is written, so an interrupted drop can be taken back. A person loads the
files at the control. A drop is confirmed when the control has written its tables into files again and these hold the same corrections; a
person's statement is recorded, but is no confirmation.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path

from abbe.drivers.opcua_control import open_files
from abbe.service.clock import utc_text
from abbe.service.compensation.comp_export import alike_mm, contents, control_for, read_files, read_key
from abbe.service.errors import FileFormatError
from abbe.service.files import write_page
from abbe.service.formats.compare import check_same
from abbe.service.formats.files import FormatSettings

FORMAT = "abbe-drop/1"
RECEIPT, BEFORE = "receipt.json", "before"
LOOK = "check this file; nothing was written"


@dataclass(frozen=True, slots=True)
class Drop:
    """Receipt of a drop. ``files``, ``before``: SHA-256 by name; "" for a file that was not there.

    ``state``: "writing", "written" (and read back), "taken back", "confirmed"; ``seen_by``: a person who says that the tables were loaded.
    """

    machine: str
    form: str
    folder: str
    files: dict[str, str]
    before: dict[str, str]
    utc: str
    state: str = "writing"
    seen_by: str = ""


class ControlFolder:
    """A folder as the place where a control reads files."""

    def __init__(self, path: Path) -> None:
        if not path.is_dir():
            raise FileFormatError(f"{path}: is not a folder", "mount the control's folder or medium")
        self.name, self._path = str(path.resolve()), path

    def get(self, name: str) -> bytes | None:
        """Return a file's content; None if it is not there."""
        file = self._path / name
        return file.read_bytes() if file.is_file() else None

    def put(self, name: str, content: bytes | None) -> None:
        """Write a file whole or not at all; None removes it."""
        if content is None:
            (self._path / name).unlink(missing_ok=True)
        else:
            write_page(content, self._path / name)


class OpcUaPlace:
    """The file objects of an OPC UA server as the place where a control reads files: ``opc.tcp://HOST:PORT/?NAME=NODE``."""

    def __init__(self, url: str) -> None:
        self.name = url

    def get(self, name: str) -> bytes | None:
        """Return a file's content; None if the file is empty or missing."""
        return asyncio.run(self._do(name, None)) or None

    def put(self, name: str, content: bytes | None) -> None:
        """Write a file; None empties it."""
        asyncio.run(self._do(name, content or b""))

    async def _do(self, name: str, content: bytes | None) -> bytes:
        files = await open_files(self.name)
        try:
            if name not in files.names:
                raise FileFormatError(f"{self.name}: names no node for {name}", f"add {name}=NODE to the URL")
            if content is None:
                return await files.get(name)
            await files.put(name, content)
            return content
        finally:
            await files.close()


Place = ControlFolder | OpcUaPlace


def place_at(text: str) -> Place:
    """Return the place of a folder or an ``opc.tcp://`` URL.

    Raises
    ------
    FileFormatError
        There is no such folder.
    """
    return OpcUaPlace(text) if text.startswith("opc.tcp://") else ControlFolder(Path(text))


def place_of(source: Path) -> Path:
    """Folder of a drop's receipt."""
    return source.with_name(source.name + ".dropped")


def drop(source: Path, to: Place, *, machine: str, form: str, now: datetime) -> Drop:
    """Put exported files where a control reads them, keep the files that were there, and read the new ones back.

    Raises
    ------
    FileFormatError
        The files were dropped already, or a file cannot be written, or reads back with other content.
    DriverError
        The server of the files does not answer.
    """
    new, aside = contents(source), place_of(source)
    if (aside / RECEIPT).exists() and receipt(source).state != "taken back":
        raise FileFormatError(f"{aside}: these files were dropped already", "confirm them or take them back: abbe comp drop --help")
    old = {name: to.get(name) for name in new}
    made = Drop(machine, form, to.name, _sums(new), _sums(old), utc_text(now))
    try:
        (aside / BEFORE).mkdir(parents=True, exist_ok=True)
        for name, content in old.items():
            if content is not None:
                write_page(content, aside / BEFORE / name)
        _keep(aside, made)
        _put(to, new)
    except OSError as error:
        raise FileFormatError(
            f"{to.name}: cannot be written: {error.strerror}", "abbe comp drop --take-back undoes what was done"
        ) from None
    return _keep(aside, replace(made, state="written"))


def take_back(source: Path) -> Drop:
    """Restore the previous files; leave files alone that were changed since.

    Raises
    ------
    FileFormatError
        There is no receipt, or a file at the control is neither the dropped file nor the previous one.
    DriverError
        The server of the files does not answer.
    """
    made, aside = receipt(source), place_of(source)
    to = place_at(made.folder)
    here = _sums({name: to.get(name) for name in made.files})
    strange = [name for name, total in here.items() if total not in (made.files[name], made.before[name])]
    if strange:
        raise FileFormatError(f"{made.folder}: {strange[0]} was changed since it was dropped", LOOK)
    try:
        _put(to, {name: (aside / BEFORE / name).read_bytes() if total else None for name, total in made.before.items()})
    except OSError as error:
        raise FileFormatError(f"{made.folder}: cannot be written: {error.strerror}", "try again") from None
    return _keep(aside, replace(made, state="taken back", seen_by=""))


def confirm(source: Path, back: Path, settings: FormatSettings, *, turned: bool = False) -> Drop:
    """Compare the files that the control wrote with those that were dropped, by their corrections.

    Raises
    ------
    FileFormatError, TableFileError
        There is no receipt for these files, or a file cannot be read.
    TableContradicts
        The control holds other corrections; the message names the mistake, if it is a known one.
    """
    made = _lying_there(source)
    if back.resolve() in (source.resolve(), Path(made.folder)):
        raise FileFormatError(
            f"{back}: these are the dropped files, not files that the control exported", "export the tables at the control"
        )
    given, found = (read_key(made.form, read_files(p), settings, turned=turned) for p in (source, back))
    check_same(found, given, alike_mm(control_for(made.form)))
    return _keep(place_of(source), replace(made, state="confirmed"))


def seen(source: Path, who: str) -> Drop:
    """Record a person's statement that the tables were loaded.

    Raises
    ------
    FileFormatError
        There is no receipt for these files.
    """
    return _keep(place_of(source), replace(_lying_there(source), seen_by=who))


def receipt(source: Path) -> Drop:
    """Read the receipt of a drop.

    Raises
    ------
    FileFormatError
        There is no receipt, or the file is not one.
    """
    file = place_of(source) / RECEIPT
    try:
        doc = json.loads(file.read_bytes())
        if doc.pop("format") != FORMAT:
            raise ValueError
        return Drop(**doc)
    except OSError:
        raise FileFormatError(f"{file}: there is no receipt", "drop the files first: abbe comp drop") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise FileFormatError(f"{file}: is not a receipt of {FORMAT}", "restore it from a backup") from None


def _lying_there(source: Path) -> Drop:
    made = receipt(source)
    if made.state not in ("written", "confirmed") or _sums(contents(source)) != made.files:
        what = f"{source}: these are not the files that were dropped at the control ({made.state})"
        raise FileFormatError(what, "drop them again: abbe comp drop")
    return made


def _sums(files: Mapping[str, bytes | None]) -> dict[str, str]:
    return {name: "" if content is None else hashlib.sha256(content).hexdigest() for name, content in files.items()}


def _put(to: Place, files: Mapping[str, bytes | None]) -> None:
    for name, content in files.items():
        to.put(name, content)
        if to.get(name) != content:
            raise FileFormatError(f"{to.name}: {name} holds other bytes than were written", "load nothing from it; try another medium")


def _keep(place: Path, made: Drop) -> Drop:
    write_page(json.dumps({"format": FORMAT} | asdict(made), indent=1, sort_keys=True), place / RECEIPT)
    return made
