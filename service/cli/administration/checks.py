"""`abbe alarm`, `abbe fleet`, `abbe trend`: results of the scheduled checks of one machine or of all."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, answer, conclude, machine_file, open_store, print_json, print_table

alarm = typer.Typer(help="Alarms of the scheduled checks.", no_args_is_help=True)


@alarm.command("list")
def list_alarms(
    every: Annotated[bool, typer.Option("--all", help="Also alarms that are over and acknowledged.")] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List alarms with their figures and the reactions of the service: campaign, finding, proposal, push."""
    from abbe.service.config import load_machine
    from abbe.service.queries.reader import json_value
    from abbe.service.queries.status import alarms

    loaded = load_machine(machine_file(machine))
    with open_store(loaded.database_url) as store:
        found = alarms(store, loaded.machine.name, every=every)
    if as_json:
        print_json({"alarms": [json_value(one) for one in found]})
        return
    if not found:
        typer.echo(f"no alarm of {loaded.machine.name} is open")
        conclude("abbe trend", machine=machine)
        return
    rows = [
        (str(one.alarm), one.state, one.recipe, f"{one.raised_utc:%Y-%m-%d %H:%M:%S}", one.acknowledged_by, one.text, one.outcome)
        for one in found
    ]
    print_table(("no", "state", "recipe", "raised (UTC)", "acknowledged by", "text", "outcome"), rows)
    unseen = [one.alarm for one in found if not one.acknowledged_by]
    then = f"abbe alarm acknowledge {unseen[0]}" if unseen else "abbe trend"
    conclude(then, machine=machine, verdict=f"{len(found)} alarms of {loaded.machine.name}, {len(unseen)} that nobody has seen")


@alarm.command("acknowledge")
def acknowledge(
    number: Annotated[int, typer.Argument(metavar="ALARM", help="Number of an alarm; abbe alarm list shows them.")],
    name: Annotated[
        str, typer.Option("--as", metavar="NAME", help="Who has seen the alarm. Default: the account.", show_default=False)
    ] = "",
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Note that a person has seen an alarm. The alarm stays active until a check clears it."""
    from abbe.service.audit.book import login
    from abbe.service.config import load_machine
    from abbe.service.verification.alarms import acknowledge as work

    loaded = load_machine(machine_file(machine))
    with open_store(loaded.database_url) as store:
        done = work(store, loaded.machine.name, number, name.strip() or login())
    text = f"alarm {number} is {done.word}: seen by {done.acknowledged_by} at {done.acknowledged_utc:%Y-%m-%d %H:%M:%S} UTC"
    answer({"alarm": number, "state": done.word, "acknowledged_by": done.acknowledged_by, "text": text}, text, as_json=as_json)
    conclude("abbe alarm list", machine=machine, as_json=as_json)


def fleet(
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List every machine of a database: state, last check with figures and U, next check, and which limit is reached first."""
    from abbe.service.cli.common import database_url
    from abbe.service.clock import SystemClock
    from abbe.service.queries.fleet import HEADINGS, as_doc, row
    from abbe.service.queries.fleet import fleet as lines_of
    from abbe.service.storage.store import Store

    url = database_url(db, machine)
    open_store(url).close()  # a missing file is one line of error and is not created
    with Store.open(url) as store:
        lines = lines_of(store, SystemClock().utc())
    if as_json:
        print_json(as_doc(lines))
    elif not lines:
        typer.echo("no machine is in this database yet: run abbe serve or abbe measure")
    else:
        print_table(HEADINGS, [row(one) for one in lines])
    conclude("abbe runs", machine=machine, db=db, verdict=f"{len(lines)} machines", as_json=as_json)


def trend(
    after: Annotated[
        str | None,
        typer.Option(
            "--after",
            metavar="UTC",
            help="Only checks after this time, e.g. after a repair; default: after the last kept push.",
            show_default=False,
        ),
    ] = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show whether each judged figure is in control or drifts (since when), and the days until its limit, with their uncertainty."""
    from abbe.service.cli.common import reader_of
    from abbe.service.queries.checks import trends
    from abbe.service.queries.reader import json_value
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
        typer.echo(f"{known.text}: {measure_now(machine_file(machine))}" if known.state == "unverified" else known.text)
    if not found.figures and known.changes:
        typer.echo(f"no check of {found.machine} has figures since the present table came into force: --after UTC shows older ones")
        conclude(measure_now(machine_file(machine)))
        return
    if not found.figures:
        typer.echo(f"no check of {found.machine} has figures yet: run abbe serve, or abbe serve --once")
        conclude("abbe serve --once", machine=machine)
        return
    print_table(HEADINGS, [row(one) for one in found.figures])
    conclude("abbe alarm list" if known.holds else measure_now(machine_file(machine)), machine=machine if known.holds else None)


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
