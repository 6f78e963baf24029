"""Table files for a control without an interface: put into its folder (share, USB), read back, kept, confirmed, taken back.

Beside the exported files ``OUT`` a folder ``OUT.dropped`` holds ``receipt.json`` (`abbe-drop/1`) and ``before/``, the files that lay in the
control's folder. The receipt is on disk before the first file is written, so an interrupted drop can be taken back. A person loads the
files at the control. Confirmed is a drop when the control has written its tables into files again and these hold the same corrections; what
a person says to have seen is recorded as that, and is not a confirmation.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path

from abbe.service.clock import utc_text
from abbe.service.compensation.comp_export import alike_mm, contents, control_for, read_files, read_key
from abbe.service.errors import FileFormatError
from abbe.service.formats.compare import check_same
from abbe.service.formats.files import FormatSettings
from abbe.service.rendering.page_file import write_page

FORMAT = "abbe-drop/1"
RECEIPT, BEFORE = "receipt.json", "before"
LOOK = "look at the folder; nothing was written"


@dataclass(frozen=True, slots=True)
class Drop:
    """What was put where. ``files``, ``before``: SHA-256 by name; "" for a file that was not there.

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


def place_of(source: Path) -> Path:
    """Folder of a drop's receipt."""
    return source.with_name(source.name + ".dropped")


def drop(source: Path, folder: Path, *, machine: str, form: str, now: datetime) -> Drop:
    """Put exported files into a control's folder, keep what lay there, and read them back.

    Raises
    ------
    FileFormatError
        The folder is missing, the files were dropped already, or a file cannot be written or is another one when read back.
    """
    new, place = contents(source), place_of(source)
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: is no folder", "mount the control's folder or medium")
    if (place / RECEIPT).exists() and receipt(source).state != "taken back":
        raise FileFormatError(f"{place}: these files were dropped already", "confirm them or take them back: abbe comp drop --help")
    old = {name: (folder / name).read_bytes() if (folder / name).is_file() else None for name in new}
    made = Drop(machine, form, str(folder.resolve()), _sums(new), _sums(old), utc_text(now))
    try:
        (place / BEFORE).mkdir(parents=True, exist_ok=True)
        for name, content in old.items():
            if content is not None:
                write_page(content, place / BEFORE / name)
        _keep(place, made)
        _put(folder, new)
    except OSError as error:
        raise FileFormatError(f"{folder}: cannot be written: {error.strerror}", "abbe comp drop --take-back undoes what was done") from None
    return _keep(place, replace(made, state="written"))


def take_back(source: Path) -> Drop:
    """Put the files that lay there before into the folder again; files that somebody changed since are left alone.

    Raises
    ------
    FileFormatError
        There is no receipt, or a file in the folder is neither the dropped one nor the one before.
    """
    place = place_of(source)
    made, folder = receipt(source), Path(receipt(source).folder)
    here = {name: (folder / name).read_bytes() if (folder / name).is_file() else None for name in made.files}
    strange = [name for name, total in _sums(here).items() if total not in (made.files[name], made.before[name])]
    if strange:
        raise FileFormatError(f"{folder / strange[0]}: was changed since it was dropped", LOOK)
    try:
        for name, total in made.before.items():
            if total:
                _put(folder, {name: (place / BEFORE / name).read_bytes()})
            else:
                (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder}: cannot be written: {error.strerror}", "try again") from None
    return _keep(place, replace(made, state="taken back", seen_by=""))


def confirm(source: Path, back: Path, settings: FormatSettings, *, turned: bool = False) -> Drop:
    """Compare the files that the control wrote with those that were dropped, by their corrections.

    Raises
    ------
    FileFormatError, TableFileError
        There is no receipt of files that lie there, or a file cannot be read.
    TableContradicts
        The control holds other corrections; the message names the mistake, if it is a known one.
    """
    made = _lying_there(source)
    if back.resolve() in (source.resolve(), Path(made.folder)):
        raise FileFormatError(
            f"{back}: these are the files that were dropped, not what the control wrote", "export the tables at the control"
        )
    given, found = (read_key(made.form, read_files(p), settings, turned=turned) for p in (source, back))
    check_same(found, given, alike_mm(control_for(made.form)))
    return _keep(place_of(source), replace(made, state="confirmed"))


def seen(source: Path, who: str) -> Drop:
    """Record that a person says to have loaded the tables.

    Raises
    ------
    FileFormatError
        There is no receipt of files that lie there.
    """
    return _keep(place_of(source), replace(_lying_there(source), seen_by=who))


def receipt(source: Path) -> Drop:
    """Read the receipt of a drop.

    Raises
    ------
    FileFormatError
        There is none, or it is no receipt.
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
        raise FileFormatError(f"{file}: is no receipt of {FORMAT}", "restore it from a backup") from None


def _lying_there(source: Path) -> Drop:
    made = receipt(source)
    if made.state not in ("written", "confirmed") or _sums(contents(source)) != made.files:
        raise FileFormatError(f"{source}: these are not the files that lie at the control ({made.state})", "drop them again")
    return made


def _sums(files: Mapping[str, bytes | None]) -> dict[str, str]:
    return {name: "" if content is None else hashlib.sha256(content).hexdigest() for name, content in files.items()}


def _put(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        write_page(content, folder / name)
        if (folder / name).read_bytes() != content:
            raise FileFormatError(f"{folder / name}: holds other bytes than were written", "load nothing from it; try another medium")


def _keep(place: Path, made: Drop) -> Drop:
    write_page(json.dumps({"format": FORMAT} | asdict(made), indent=1, sort_keys=True), place / RECEIPT)
    return made
