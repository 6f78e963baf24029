"""`abbe fleet`: every machine of a database in one line each."""

from __future__ import annotations

from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, MachineOption, print_json, print_table


def fleet(
    db: Annotated[
        str | None, typer.Option("--store", "--db", metavar="URL", help="Database that the services write to.", show_default=False)
    ] = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List every machine of a database: state, last check with figures and U, next due, and which limit comes first."""
    from abbe.service.cli.common import database_url, open_store
    from abbe.service.clock import SystemClock
    from abbe.service.scheduler.fleet import HEADINGS, as_doc, row
    from abbe.service.scheduler.fleet import fleet as lines_of
    from abbe.service.storage.store import Store

    url = database_url(db, machine)
    open_store(url).close()  # a missing file is one line of error and is not created
    with Store.open(url) as store:
        lines = lines_of(store, SystemClock().utc())
    if as_json:
        print_json(as_doc(lines))
    elif not lines:
        typer.echo("no machine is in this database yet: abbe serve, or abbe measure")
    else:
        print_table(HEADINGS, [row(one) for one in lines])
