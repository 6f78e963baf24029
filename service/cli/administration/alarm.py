"""``abbe alarm list | acknowledge``: warnings of the scheduled checks, the service's work on them, and a person's acknowledgement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json, print_table

alarm = typer.Typer(help="Alarms of the scheduled checks.", no_args_is_help=True)

MachineFile = Annotated[Path, typer.Argument(metavar="MACHINE.toml", help="Machine file.")]


@alarm.command("list")
def list_alarms(
    machine: MachineFile,
    every: Annotated[bool, typer.Option("--all", help="Also those that are over and acknowledged.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Alarms with their figures, and what the service did about each: campaign, finding, proposal, push."""
    from abbe.service.cli.common import open_store
    from abbe.service.config import load_machine
    from abbe.service.verification.alarms import alarm_doc, alarms_of, open_alarms

    loaded = load_machine(machine)
    with open_store(loaded.database_url) as store:
        name = loaded.machine.name
        docs = [alarm_doc(one) for one in (reversed(alarms_of(store, name)) if every else open_alarms(store, name))]
    if as_json:
        print_json({"alarms": docs})
        return
    if not docs:
        typer.echo(f"no alarm of {name} is open")
        return
    keys = ("alarm", "state", "recipe", "raised_utc", "acknowledged_by", "text", "outcome")
    print_table(("no", *keys[1:]), [tuple(str(doc[key]) for key in keys) for doc in docs])


@alarm.command("acknowledge")
def acknowledge(
    machine: MachineFile,
    number: Annotated[int, typer.Argument(metavar="ALARM", help="Number of an alarm; abbe alarm list shows them.")],
    name: Annotated[
        str, typer.Option("--as", metavar="NAME", help="Who has seen the alarm. Default: the account.", show_default=False)
    ] = "",
) -> None:
    """Note that a person has seen an alarm. It stays active until a check clears it."""
    from abbe.service.cli.common import open_store
    from abbe.service.compensation.proposals import login
    from abbe.service.config import load_machine
    from abbe.service.verification.alarms import acknowledge as work

    loaded = load_machine(machine)
    with open_store(loaded.database_url) as store:
        done = work(store, loaded.machine.name, number, name.strip() or login())
    typer.echo(f"alarm {number} is {done.word}: seen by {done.acknowledged_by} at {done.acknowledged_utc}")
