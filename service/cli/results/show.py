"""``abbe runs`` and ``abbe show``: the measured runs and campaigns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table, run_or_campaign

if TYPE_CHECKING:
    from abbe.service.domain.measured import ChunkRecord, RunRecord


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
        found = [json_value(run) for run in all_runs(store, campaign)]
    if as_json:
        print_json(found)
        return
    keys = ("number", "campaign", "machine", "run_id", "test", "role", "status", "reason", "started_utc", "ended_utc")
    heads = ("number", "campaign", "machine", "run", "test", "role", "status", "reason", "started (UTC)", "ended (UTC)")
    print_table(heads, [[str(run[key] or "") for key in keys] for run in found])


def show(
    run: Annotated[
        str,
        typer.Argument(metavar="RUN", help="Number, label (r01) or campaign/label of a run; or a campaign's name.", show_default=False),
    ],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one run: state, set-up and statistics of its columns (--json: as an exchange file). Or a campaign: runs and incidents."""
    from abbe.service.cli.results.show_campaign import show_campaign
    from abbe.service.domain.measured import RunRecord
    from abbe.service.queries.measured import run_summary
    from abbe.service.queries.reader import json_value
    from abbe.service.runs.columns import run_document, single_run, whole_run
    from abbe.service.runs.coverage import not_judged, with_state

    with open_store(database_url(db, machine)) as store:
        record = run_or_campaign(store, run)
        if not isinstance(record, RunRecord):
            show_campaign(store, record, as_json=as_json)
            return
        chunks = store.chunks.of_run(record.id)
        facts = json_value(run_summary(record, store.machines.get(store.campaigns.find(record.campaign_id).machine_id).name))
        found = whole_run(store, record) if record.visible_status == "complete" else with_state(single_run(record, chunks), record)
        document = run_document(found, record, chunks)
    if as_json:
        print_json(document)
        return
    pieces = found.timing.pieces
    extra = {"pieces": ", ".join(f"{one.readings} of {one.run}" for one in pieces) + " and its own"} if pieces else {}
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


def _samples(run: RunRecord, chunks: list[ChunkRecord]) -> dict[str, str]:
    """Return the account of all ball-bar samples: stored, flagged, or in which gap."""
    from abbe.drivers.flags import BAR_REASONS
    from abbe.service.capture.ledger import ledger_of, streams_from_end_doc

    streams = streams_from_end_doc(run.end_doc)
    ledger = ledger_of(chunks, streams)
    if not ledger.stored and not ledger.gaps:
        return {}
    sums = ledger.doc()
    flags = ", ".join(f"{reason} {sums['flags'][reason]}" for reason in BAR_REASONS if reason in sums["flags"])
    rows = {"samples": f"{sums['stored_valid']} valid, {sums['stored_flagged']} flagged" + (f" ({flags})" if flags else "")}
    rows["missing"] = f"{sums['in_gaps']} in {sums['gaps']} gaps" + (f", {sums['unaccounted']} unaccounted" if sums["unaccounted"] else "")
    if (count := len(ledger.ends())) > 1:
        rows["streams"] = str(count) if streams is not None else f"{count} (guessed: the run does not say)"
    for number, gap in enumerate(ledger.gaps, start=1):
        last = "?" if gap.last is None else str(gap.last)
        rows[f"gap {number}"] = f"samples {gap.first} to {last}: {gap.cause}"
    return rows


def _statistics(key: str, values: list[float] | None) -> tuple[str, ...]:
    if not values:
        return (key, "sealed" if values is None else "0", "", "", "")
    return (key, str(len(values)), f"{min(values):.9g}", f"{max(values):.9g}", f"{sum(values) / len(values):.9g}")
