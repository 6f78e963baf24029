"""`abbe key`: keys that sign compensation files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import DbOption, MachineOption

key = typer.Typer(help="Keys that sign compensation files.", no_args_is_help=True)


@key.command("new")
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New file for the private key.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Create a key. The private one stays in FILE, readable by its owner only; the public one is printed, for [signatures] trusted."""
    from abbe.service.signed.keys import new_key

    typer.echo(new_key(file))
