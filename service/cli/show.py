"""``abbe runs`` and ``abbe show``: what was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table

if TYPE_CHECKING:
    from service.storage.records import RunRecord


def runs(
    campaign: Annotated[str | None, typer.Option("--campaign", help="Only the runs of this campaign.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the runs in the database."""
    with open_store(database_url(db, machine)) as store:
        found = store.runs(store.campaign(campaign).id if campaign is not None else None)
        if as_json:
            print_json([_summary(run) for run in found])
            return
        rows = [[str(value) for value in _summary(run).values()] for run in found]
        print_table(("number", "campaign", "run", "test", "role", "status", "reason", "started (UTC)", "ended (UTC)"), rows)


def show(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Number, label (r01) or campaign/label.", show_default=False)],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one run: state, setup and what its columns hold; with --json the whole run as an exchange file."""
    from service.runs.columns import run_document

    with open_store(database_url(db, machine)) as store:
        record = store.run(run)
        document = run_document(record, store.chunks(record.id))
    if as_json:
        print_json(document)
        return
    setup = {f"setup.{key}": value for key, value in document["setup"].items()}
    print_table(
        ("key", "value"),
        [(key, str(value)) for key, value in (_summary(record) | setup).items()],
        title=f"run {record.campaign}/{record.label}",
    )
    print_table(
        ("column", "rows", "smallest", "largest", "mean"), [_statistics(key, values) for key, values in document["columns"].items()]
    )


def _summary(run: RunRecord) -> dict[str, Any]:
    who = {"number": run.id, "campaign": run.campaign, "run_id": run.label, "test": run.test, "role": run.role}
    return who | {"status": run.visible_status, "reason": run.reason, "started_utc": run.started_utc, "ended_utc": run.ended_utc or ""}


def _statistics(key: str, values: list[float] | None) -> tuple[str, ...]:
    if not values:
        return (key, "sealed" if values is None else "0", "", "", "")
    return (key, str(len(values)), f"{min(values):.9g}", f"{max(values):.9g}", f"{sum(values) / len(values):.9g}")
