"""`abbe key`: the keys with which compensation files are signed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import DbOption, MachineOption

key = typer.Typer(help="Keys with which compensation files are signed.", no_args_is_help=True)


@key.command("new")
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New file for the private key.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Make a key. The private one stays in FILE, for its owner only; the public one is printed, for [signatures] trusted."""
    from abbe.service.signed.keys import new_key

    typer.echo(new_key(file))
