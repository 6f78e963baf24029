"""Read measurements from a campaign folder or the database."""

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
        Folder with campaign.json (docs/schemas), or, with ``database``, the name of a campaign.
    database : str, optional
        URL of the database, e.g. ``"sqlite:///abbe.sqlite3"``.

    Raises
    ------
    FileFormatError
        A file has a mistake; the message names file, key, row and expected value of the first mistake.
    StoreError
        The campaign or the database does not exist.
    """
    if database is not None:
        with Store.open(database) as store:
            return from_store(store, str(source))
    folder = Path(source)
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: no such folder", "give a folder with campaign.json, or the URL of the campaign's database")
    return from_folder(folder)


def read_errors(source: str | Path) -> ErrorMotions:
    """Read the error motions of an errors file (``abbe-errors/1``), in mm and rad, without its covariance.

    Raises
    ------
    FileFormatError
        The file has a mistake; the message names file and key of the first mistake.
    """
    return read_file(Path(source)).motions
