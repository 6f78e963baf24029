"""Settings of the capture, and the folder of the segments: the configured one, else beside the SQLite file."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from itertools import count
from pathlib import Path

from abbe.service.domain.machine_file import CaptureSettings as CaptureSettings
from abbe.service.errors import ConfigError
from abbe.service.storage.engine import parse_url
from abbe.service.storage.store import Store

SUFFIX = ".seg"
ORPHAN = ".orphan"
"""Suffix of a segment set aside because this database has no run for it, or because its closed run lacks some of its records."""
CONFLICT = ".conflict"
"""Suffix of a segment set aside because it contradicts the database or cannot be read."""
DAMAGED_SUFFIX = ".damaged"
"""Suffix of a segment set aside because of damage between good records; its readable records are in the database."""
TAIL = ".tail"
"""Suffix of a copy of the tail that was cut off a segment."""


def is_memory(database_url: str) -> bool:
    """Whether the database is in memory only: it ends with the process, so segments that outlast it would belong to no database."""
    parsed = parse_url(database_url)
    return parsed.drivername == "sqlite" and parsed.database in {None, "", ":memory:"}


def segment_folder(database_url: str, settings: CaptureSettings, database_id: str = "") -> Path:
    """Return the folder of the segments of a database, independent of the form of its address; does not create it.

    Parameters
    ----------
    database_url : str
        Address with which the store was opened; symbolic links to an SQLite file are followed.
    database_id : str
        Identity of a database on a server (`Store.database_id`), because the same database may have several addresses.

    Raises
    ------
    ConfigError
        A PostgreSQL database, and no folder is configured.
    """
    parsed = parse_url(database_url)
    if is_memory(database_url):
        return Path(settings.folder or tempfile.gettempdir()) / f"abbe-capture-{os.getpid()}"
    if parsed.drivername == "sqlite":
        file = Path(str(parsed.database)).resolve()
        return _named(settings.folder, file.stem, str(file)) if settings.folder else Path(f"{file}-capture")
    if not settings.folder:
        raise ConfigError(
            "samples are written to a local file before they go to PostgreSQL, and no folder for it is configured",
            'add capture = "/var/lib/abbe/capture" under [store] of the machine file',
        )
    return _named(settings.folder, "postgresql", database_id)


def _named(folder: str, name: str, what: str) -> Path:
    """Return the subfolder of one database: several databases may share a folder, and use the same run numbers."""
    readable = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")
    return Path(folder) / f"{readable}-{hashlib.sha256(what.encode()).hexdigest()[:8]}"


def other_folders(database_url: str, settings: CaptureSettings, present: Path) -> list[Path]:
    """Return the folders where earlier versions or another machine file may have left segments of this database.

    They may also hold segments of other databases: touch a segment only if its run is in this database.
    """
    parsed = parse_url(database_url)
    found = []
    if parsed.drivername == "sqlite" and not is_memory(database_url):
        file = Path(str(parsed.database))
        found = [Path(f"{file}-capture"), Path(f"{file.resolve()}-capture")]
    if settings.folder and Path(settings.folder).is_dir():
        found += sorted(one for one in Path(settings.folder).iterdir() if one.is_dir())
    different = {one.resolve(): one for one in found if one.is_dir()}
    different.pop(present.resolve(), None)
    return list(different.values())


def segment_path(folder: Path, run_id: int) -> Path:
    """Return the path of a run's segment."""
    return folder / f"run-{run_id:08d}{SUFFIX}"


def free_name(path: Path, suffix: str) -> Path:
    """Return an unused name in the same folder with another suffix, e.g. ``run-00000012.orphan-2``."""
    names = (path.with_suffix(suffix if k == 1 else f"{suffix}-{k}") for k in count(1))
    return next(name for name in names if not name.exists())


def set_aside(path: Path, suffix: str) -> Path:
    """Rename a file so that it is no longer taken for a segment; overwrites nothing. Raises OSError."""
    name = free_name(path, suffix)
    path.rename(name)
    return name


def folder_of(store: Store, settings: CaptureSettings) -> Path:
    """Return the folder of the segments of a store; arguments and errors as for `segment_folder`."""
    on_server = parse_url(store.url).drivername != "sqlite"
    return segment_folder(store.url, settings, store.database_id() if on_server and settings.folder else "")
