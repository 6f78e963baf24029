"""`abbe runs`, `show` and `export`: campaigns and runs of a database."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    conclude,
    database_url,
    open_store,
    print_json,
    print_table,
    reader,
    run_or_campaign,
)

if TYPE_CHECKING:
    from abbe.service.domain.measured import ChunkRecord, RunRecord
    from abbe.service.queries.measured import CampaignDetail
    from abbe.service.sequences.journal import Trouble
    from abbe.service.storage.store import Store


def show_campaign(store: Store, number: int, *, as_json: bool) -> None:
    """Print a campaign: one line for each run, one for each kind of incident and how it ended."""
    from abbe.service.queries.measured import campaign
    from abbe.service.queries.reader import json_value

    found = campaign(reader(store), number)
    if as_json:
        print_json(json_value(found))
        return
    head = [(name, str(getattr(found, name))) for name in ("number", "name", "machine", "created_utc")]
    print_table(("key", "value"), head, title=f"campaign {found.name}")
    rows = [(str(one.number), one.run_id, one.test, one.status, one.reason) for one in found.runs]
    print_table(("number", "run", "test", "status", "reason"), rows, title="runs")
    _print_incidents(found)


def _print_incidents(found: CampaignDetail) -> None:
    if found.incidents is None:
        return
    if found.incidents:
        heads = ("link", "code", "times", "how it ended", "runs", "latest")
        times = sum(one.times for one in found.incidents)
        print_table(heads, [_row(one) for one in found.incidents], title=f"incidents on the links to devices: {times}")
    else:
        typer.echo("no incident on a link to a device")
    if found.incidents_not_written:
        typer.echo(f"{found.incidents_not_written} incidents could not be written: the database was locked or gone")


def _row(one: Trouble) -> tuple[str, ...]:
    ends = ", ".join(f"{state} {count}" for state, count in one.ends.items())
    return (one.link, one.code, str(one.times), ends, ", ".join(one.runs), one.last)


def runs(
    campaign: Annotated[str | None, typer.Option("--campaign", help="Only the runs of this campaign.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the runs in the database."""
    from abbe.service.queries.measured import all_runs
    from abbe.service.queries.reader import json_value

    with open_store(database_url(db, machine)) as store:
        found = all_runs(store, campaign)
    if as_json:
        print_json([json_value(run) for run in found])
        return
    keys = ("number", "campaign", "machine", "run_id", "test", "role", "status", "reason", "started_utc", "ended_utc")
    heads = ("number", "campaign", "machine", "run", "test", "role", "status", "reason", "started (UTC)", "ended (UTC)")
    print_table(heads, [[str(getattr(run, key) or "") for key in keys] for run in found])
    complete = sum(run.status == "complete" for run in found)
    then = f"abbe show {quote(f'{found[-1].campaign}/{found[-1].run_id}')}" if found else "abbe measure --dry-run"
    conclude(then, machine=machine, db=db, verdict=f"{len(found)} runs, {complete} complete")


def show(
    run: Annotated[
        str,
        typer.Argument(metavar="RUN", help="Number, label (r01) or campaign/label of a run; or a campaign's name.", show_default=False),
    ],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one run: state, set-up and statistics of its columns (--json: as an exchange file). For a campaign, show its runs and
    incidents."""
    from abbe.service.domain.measured import RunRecord

    with open_store(database_url(db, machine)) as store:
        record = run_or_campaign(store, run)
        if not isinstance(record, RunRecord):
            show_campaign(store, record.id, as_json=as_json)
            conclude(f"abbe solve {quote(record.name)}", machine=machine, db=db, as_json=as_json)
            return

        from abbe.service.queries.measured import run_summary
        from abbe.service.queries.reader import json_value
        from abbe.service.runs.columns import run_document, single_run, whole_run
        from abbe.service.runs.coverage import not_judged, with_state

        chunks = store.chunks.of_run(record.id)
        facts = json_value(run_summary(record, store.machines.get(store.campaigns.find(record.campaign_id).machine_id).name))
        found = whole_run(store, record) if record.visible_status == "complete" else with_state(single_run(record, chunks), record)
        document = run_document(found, record, chunks)
    if as_json:
        print_json(document)
        return
    pieces = found.timing.pieces
    extra = {"pieces": ", ".join(f"{one.readings} of {one.run}" for one in pieces) + " and the run's own"} if pieces else {}
    extra |= {"judged": why} if (why := not_judged(found)) else {}
    setup = {f"setup.{key}": value for key, value in found.setup.document.items()}
    print_table(
        ("key", "value"),
        [(key, "" if value is None else str(value)) for key, value in (facts | extra | setup | _samples(record, chunks)).items()],
        title=f"run {record.campaign}/{record.label}",
    )
    print_table(
        ("column", "rows", "smallest", "largest", "mean"), [_statistics(key, values) for key, values in document["columns"].items()]
    )
    conclude(f"abbe report {quote(f'{record.campaign}/{record.label}')}", machine=machine, db=db)


def _samples(run: RunRecord, chunks: list[ChunkRecord]) -> dict[str, str]:
    """Return rows that say how many ball-bar samples of a run are valid, flagged, or missing, and list each gap."""
    from abbe.drivers.api import BAR_REASONS
    from abbe.service.capture.ledger import ledger_of, streams_from_end_doc

    streams = streams_from_end_doc(run.end_doc)
    ledger = ledger_of(chunks, streams)
    if not ledger.stored and not ledger.gaps:
        return {}
    flags = ", ".join(f"{reason} {ledger.flagged[reason]}" for reason in BAR_REASONS if reason in ledger.flagged)
    unaccounted = f", {ledger.uncovered} unaccounted" if ledger.uncovered else ""
    rows = {
        "samples": f"{ledger.stored - ledger.invalid} valid, {ledger.invalid} flagged" + (f" ({flags})" if flags else ""),
        "missing": f"{ledger.in_gaps} in {len(ledger.gaps)} gaps{unaccounted}",
    }
    if (count := len(ledger.ends())) > 1:
        rows |= {"streams": str(count) if streams is not None else f"{count} (guessed: the run does not say)"}
    for number, gap in enumerate(ledger.gaps, start=1):
        last = "?" if gap.last is None else str(gap.last)
        rows[f"gap {number}"] = f"samples {gap.first} to {last}: {gap.cause}"
    return rows


def _statistics(key: str, values: list[float] | None) -> tuple[str, ...]:
    if not values:
        return (key, "sealed" if values is None else "0", "", "", "")
    return (key, str(len(values)), f"{min(values):.9g}", f"{max(values):.9g}", f"{sum(values) / len(values):.9g}")


def export_campaign(
    campaign: Annotated[str, typer.Argument(metavar="CAMPAIGN", help="Name or number of the campaign.", show_default=False)],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder.", show_default=False)],
    csv: Annotated[bool, typer.Option("--csv", help="Also the columns of each run as CSV, their units in the headings.")] = False,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a campaign as a folder with campaign.json, one file for each run, and the compensation tables in force, if any."""
    with open_store(database_url(db, machine)) as store:
        store.campaigns.find(campaign)

        from abbe.service.runs.exchange import export_folder  # numpy: not for a wrong name
        from abbe.service.tables.measured_with import images_of

        written = export_folder(store, campaign, folder, images_of(store), csv=csv)
        count = len(store.runs.all(store.campaigns.find(campaign).id))
    text = f"exported campaign {campaign!r} with {count} runs to {written}"
    answer({"campaign": campaign, "runs": count, "folder": str(written)}, text, as_json=as_json)
    conclude(f"abbe solve {quote(str(written))}", as_json=as_json)
