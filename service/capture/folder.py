"""Where the segments of an open store lie."""

from __future__ import annotations

from pathlib import Path

from abbe.service.capture.settings import CaptureSettings, segment_folder
from abbe.service.storage.engine import parse_url
from abbe.service.storage.store import Store


def folder_of(store: Store, settings: CaptureSettings) -> Path:
    """Folder of the segments of a store; the same whatever address it was opened by. Not created.

    Raises
    ------
    ConfigError
        A PostgreSQL database, and no folder is configured.
    """
    on_server = parse_url(store.url).drivername != "sqlite"
    return segment_folder(store.url, settings, store.database_id() if on_server and settings.folder else "")
