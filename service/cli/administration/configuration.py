"""``abbe check-config`` and ``abbe schema``: the values of a machine file, and its schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json, print_table


def check_config(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Machine file (TOML).", show_default=False)],
    as_json: JsonOption = False,
) -> None:
    """Check a machine file and print its effective values with their origins; exit code 2 if something cannot work."""
    from abbe.service.campaigns.plausibility import check_plausibility
    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.errors import ConfigError
    from abbe.service.secrets import mask_secrets, visible

    loaded = load_machine(file)
    found = check_plausibility(loaded.machine, loaded.path.resolve().parent, SystemClock().utc().date())
    database = mask_secrets(loaded.database_url)
    if as_json:
        values = {key: {"value": value, "origin": origin} for key, value, origin in loaded.values()}
        result = {"good": found.good, "errors": found.errors, "warnings": found.warnings}
        print_json({"file": str(file), "database": database, "values": values} | result)
        raise typer.Exit(2 if found.errors else 0)
    rows = [(key, "-" if value is None else json.dumps(value, ensure_ascii=False), origin) for key, value, origin in loaded.values()]
    print_table(("key", "value", "from"), rows, title=f"{file} is good" if found.good else str(file))
    typer.echo(f"database: {database}")
    for line in found.warnings:
        typer.echo(f"warning: {visible(line)}", err=True)
    for line in found.errors:
        typer.echo(f"error {ConfigError.code}: {visible(line)}", err=True)
    raise typer.Exit(2 if found.errors else 0)


def schema(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to.")] = Path("docs/schemas")) -> None:
    """Write the JSON Schemas of the machine file and of the exchange files."""
    from abbe.service.errors import ConfigError
    from abbe.service.schemas import write_schemas

    try:
        for path in write_schemas(folder):
            typer.echo(str(path))
    except OSError as err:
        raise ConfigError(f"{folder}: cannot be written: {err.strerror}", "give a writable folder") from None
