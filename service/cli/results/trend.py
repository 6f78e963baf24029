"""``abbe trend``: the trend of the checks' figures, since when they drift, and when they reach their limits."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json, print_table


def trend(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE.toml", help="Machine file.")],
    after: Annotated[
        str | None,
        typer.Option(
            "--after",
            metavar="UTC",
            help="Only checks after this, e.g. a repair; default: the last kept push.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show the trend of each judged figure: in control or drifting since when, and days until the limit with their uncertainty."""
    from abbe.service.cli.common import reader_of
    from abbe.service.queries.reader import json_value
    from abbe.service.queries.results import trends
    from abbe.service.verification.trend_table import HEADINGS, chart, row
    from abbe.service.verification.verified_by import measure_now

    since = _utc(after)
    with reader_of(machine) as reader:
        found = trends(reader, reader.machine, since)
    if as_json:
        print_json({"schema": 1, "chart": chart()} | json_value(found))
        return
    known = found.verified
    if not known.holds:
        typer.echo(f"{known.text}: {measure_now(str(machine))}" if known.state == "unverified" else known.text)
    if not found.figures and known.changes:
        typer.echo(f"no check of {found.machine} has figures since the table in force came: --after shows those before it")
        return
    if not found.figures:
        typer.echo(f"no check of {found.machine} has figures yet: abbe serve, or abbe serve --once")
        return
    print_table(HEADINGS, [row(one) for one in found.figures])


def _utc(text: str | None) -> datetime | None:
    from datetime import UTC

    from abbe.service.errors import ConfigError

    if text is None:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"--after {text!r} is not a date or time", "write e.g. 2026-11-21 or 2026-11-21T03:00:00Z") from None
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
