"""`abbe accept-table`: a person vouches for the controller's active table."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer


def accept_table(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE.toml", help="Machine file.")],
    yes: Annotated[bool, typer.Option("--yes", help="I have checked the controller: its active table is right.")] = False,
) -> None:
    """Accept the active table as right, so that work can continue: after an interrupted push that Abbe could not resolve, under any name,
    or if this database did not push the table. The push journal records who and when.
    """
    from abbe.service.compensation.proposals import by_whom
    from abbe.service.compensation.recover import accept
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls, open_session
    from abbe.service.errors import ConfigError
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    if not yes:
        raise ConfigError("nothing was accepted", "look at the controller's active table, then add --yes")
    loaded = load_machine(machine)
    site = site_of(loaded.machine)

    async def work(store: Store) -> str:
        async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
            return await accept(session.controller, store, site, by_whom())

    with Store.open(loaded.database_url) as store:
        typer.echo(asyncio.run(work(store)))
