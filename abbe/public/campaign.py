"""Where measurements come from: a campaign folder, or a campaign of the database."""

from __future__ import annotations

from pathlib import Path

from abbe.models.functions.motions import ErrorMotions
from abbe.service.campaign_data.campaign_folder import Campaign, from_folder, from_store
from abbe.service.errors import FileFormatError
from abbe.service.runs.errors_file import read_errors as read_file
from abbe.service.storage.store import Store


def read_campaign(source: str | Path, *, database: str | None = None) -> Campaign:
    """Read and check a campaign.

    Parameters
    ----------
    source : str or Path
        Folder with campaign.json (docs/schemas); with ``database`` the name of a campaign there.
    database : str, optional
        Address of the store, e.g. ``"sqlite:///abbe.sqlite3"``.

    Raises
    ------
    FileFormatError
        The first mistake in any file: file, key, row, and what was expected.
    StoreError
        There is no such campaign or database.
    """
    if database is not None:
        with Store.open(database) as store:
            return from_store(store, str(source))
    folder = Path(source)
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: no such folder", "give a folder with campaign.json, or the database of the campaign")
    return from_folder(folder)


def read_errors(source: str | Path) -> ErrorMotions:
    """Read the error motions of an errors file (``abbe-errors/1``), in mm and rad; its covariance is not read here.

    Raises
    ------
    FileFormatError
        The first mistake: file and key.
    """
    return read_file(Path(source)).motions
