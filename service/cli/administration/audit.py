"""`abbe audit`: who did what, and the proof that no record was changed."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table, warn_of_readers

audit = typer.Typer(help="The audit: who did what, when, on what, and how it ended.", no_args_is_help=True)
SHOWN = 10


@audit.command("show")
def show_audit(
    last: Annotated[int, typer.Option("--last", min=1, help="Number of records, the newest.")] = 50,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the newest records, oldest first."""
    from abbe.service.secrets import visible

    with open_store(database_url(db, machine)) as store:
        found = store.audit.events(last)
    if as_json:
        print_json([asdict(record) for record in found])
        return
    # A line break in a target must not look like another record: tables alone would keep it.
    rows = [tuple(map(visible, (str(r.id), r.utc[:19], r.who, r.action, r.target, r.outcome))) for r in found]
    print_table(("record", "when (UTC)", "who", "what", "on", "outcome"), rows)


@audit.command("verify")
def verify_audit(db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Prove that no record was changed, removed, exchanged or cut off at the end (exit code 1: one was)."""
    from abbe.service.audit.book import AuditBook
    from abbe.service.secrets import visible

    url = database_url(db, machine)
    with open_store(url) as store:
        warn_of_readers(url)
        faults = AuditBook(store, url).verify()
        last = store.audit.events(1)
    head = f"{last[0].id} {last[0].digest}" if last else ""
    if as_json:
        print_json({"records": last[0].id if last else 0, "head": head, "faults": faults})
    else:
        for text in faults[:SHOWN]:
            typer.echo(visible(text))
        if len(faults) > SHOWN:
            typer.echo(f"{len(faults) - SHOWN} more; --json lists all")
        if not faults:
            typer.echo(f"{last[0].id if last else 0} records, all there and as written")
            typer.echo(f"head: {head}" if head else "the audit is empty")
    raise typer.Exit(1 if faults else 0)
