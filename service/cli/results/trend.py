"""``abbe trend``: do the figures of the checks drift, since when, and when do they reach their limits."""

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
    """Trend of each judged figure: in control or drifting since when, and days until the limit with their uncertainty."""
    from abbe.service.cli.common import open_store
    from abbe.service.config import load_machine
    from abbe.service.devices.urls import control_of
    from abbe.service.scheduler.store import ServiceStore
    from abbe.service.verification.trend_table import HEADINGS, as_doc, row, trends
    from abbe.service.verification.verified_by import measure_now, verified_by

    loaded = load_machine(machine)
    since = _moment(after)
    open_store(loaded.database_url).close()  # a missing file is one line, and none is made
    with ServiceStore.open(loaded.database_url) as store:
        known = verified_by(store, loaded.machine.name, control=control_of(loaded.machine.devices.cnc))
        found = trends(store.verifications_of(loaded.machine.name, limit=100_000), since or known.since)
    if as_json:
        print_json(as_doc(loaded.machine.name, found) | {"verified": known.as_doc()})
        return
    if not known.holds:
        typer.echo(f"{known.text}: {measure_now(str(machine))}" if known.state == "unverified" else known.text)
    if not found and known.changes:
        typer.echo(f"no check of {loaded.machine.name} has figures since the table in force came: --after shows those before it")
        return
    if not found:
        typer.echo(f"no check of {loaded.machine.name} has figures yet: abbe serve, or abbe serve --once")
        return
    print_table(HEADINGS, [row(one) for one in found])


def _moment(text: str | None) -> datetime | None:
    from datetime import UTC

    from abbe.service.errors import ConfigError

    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"--after {text!r} is not a date or time", "write e.g. 2026-11-21 or 2026-11-21T03:00:00Z") from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
