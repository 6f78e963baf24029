"""``abbe export`` and ``abbe import``: campaigns as folders of plain files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import DbOption, MachineOption, database_url, open_store


def export_campaign(
    campaign: Annotated[str, typer.Argument(metavar="CAMPAIGN", help="Name or number of the campaign.", show_default=False)],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Write a campaign as a folder with campaign.json and one file a run."""
    from abbe.service.runs.exchange import export_folder

    with open_store(database_url(db, machine)) as store:
        written = export_folder(store, campaign, folder)
        count = len(store.runs.all(store.campaigns.find(campaign).id))
    typer.echo(f"exported campaign {campaign!r} with {count} runs to {written}")


def import_campaign(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with campaign.json.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Check a campaign folder and store it: all of it or, after any mistake, nothing."""
    from abbe.service.runs.exchange import import_folder, read_folder

    read_folder(folder)  # before a database is created
    with open_store(database_url(db, machine), must_exist=False) as store:
        record = store.campaigns.find(import_folder(store, folder))
        typer.echo(f"imported campaign {record.name!r} with {len(store.runs.all(record.id))} runs into {store.url}")
