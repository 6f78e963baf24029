"""``abbe show CAMPAIGN``: its runs, and incidents of the links while it was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from abbe.service.cli.common import print_json, print_table

if TYPE_CHECKING:
    from abbe.service.domain.measured import CampaignRecord
    from abbe.service.sequences.journal import Trouble
    from abbe.service.storage.store import Store


def show_campaign(store: Store, campaign: CampaignRecord, *, as_json: bool) -> None:
    """Print a campaign: one line for each run, one for each kind of incident and how it ended."""
    from abbe.service.sequences.journal import not_written, troubles

    runs, journal = store.runs.all(campaign.id), store.checkpoints.of_campaign(campaign.id)
    found, lost = troubles(journal), not_written(journal)
    who = {"number": campaign.id, "campaign": campaign.name, "machine": store.machines.get(campaign.machine_id).name}
    who |= {"created_utc": campaign.created_utc}
    if as_json:
        states = [{"number": one.id, "run_id": one.label, "test": one.test, "status": one.visible_status} for one in runs]
        print_json(who | {"runs": states, "incidents": [one.doc() for one in found], "incidents_not_written": lost})
        return
    print_table(("key", "value"), [(key, str(value)) for key, value in who.items()], title=f"campaign {campaign.name}")
    rows = [(str(one.id), one.label, one.test, one.visible_status, one.reason) for one in runs]
    print_table(("number", "run", "test", "status", "reason"), rows, title="runs")
    if journal:  # an imported campaign has no journal
        _incidents(found, lost)


def _incidents(found: list[Trouble], lost: int) -> None:
    if found:
        heads = ("link", "code", "times", "how it ended", "runs", "latest")
        print_table(heads, [_row(one) for one in found], title=f"incidents of the links: {sum(one.times for one in found)}")
    else:
        typer.echo("no incident of a link")
    if lost:
        typer.echo(f"{lost} incidents could not be written: the database was locked or gone")


def _row(one: Trouble) -> tuple[str, ...]:
    doc: dict[str, Any] = one.doc()
    ends = ", ".join(f"{state} {count}" for state, count in doc["ends"].items())
    return (one.link, one.code, str(one.times), ends, ", ".join(one.runs), one.last)
