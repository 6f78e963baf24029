"""`abbe simulate`: the present model's prediction of every run, beside the measurement."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, print_json, print_table
from abbe.service.cli.results.discover import opened

if TYPE_CHECKING:
    from abbe.service.discovery.discover import DiscoveryJob
    from abbe.service.discovery.simulate import Simulation


def simulate(
    campaign: Annotated[str, typer.Argument(help="Campaign in the database, or a folder with campaign.json.")],
    as_json: JsonOption = False,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="FILE", help="Also write a report: FILE.pdf, .html, .csv or .json.", show_default=False),
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    without: Annotated[list[str] | None, typer.Option("--without", metavar="RUN", help="Leave a run out; may be repeated.")] = None,
) -> None:
    """Predict every run with the present model, fitted to the identify runs, and show measured against simulated. Nothing is stored.

    The present model is the campaign's, with the effects of the machine's model book.
    """
    from abbe.service.cli.progress import display
    from abbe.service.discovery.discover import prepare
    from abbe.service.discovery.simulate import simulate as work
    from abbe.service.discovery.simulate import simulation_doc
    from abbe.service.domain.progress import Progress
    from abbe.service.effects.effect_catalogue import catalogue
    from abbe.service.effects.model_book import current
    from abbe.service.identification.table_removal import NO_TABLE, campaign_table
    from abbe.service.rendering.document_page import form_of

    if report is not None:
        form_of(report)  # refuse a wrong suffix before the work
    with opened(campaign, db, machine, without or []) as (found, store), display() as sink:
        sink(Progress("simulate", 0.0, 2.0, None, "runs checked against each other"))
        base, table = (None, NO_TABLE) if store is None else (current(store, found.site.name), campaign_table(store, found))
        job = prepare(found, catalogue(), base, table=table)
        sink(Progress("simulate", 1.0, 2.0, None, "present model fitted to the identify runs"))
        simulation = work(job)
        sink(Progress("simulate", 2.0, 2.0, 0.0, "done"))
    if report is not None:
        _write_report(job, simulation, report)
    if as_json:
        print_json(simulation_doc(job, simulation))
        return
    _print(job, simulation)
    if report is not None:
        typer.echo(f"report: {report}")


def _write_report(job: DiscoveryJob, simulation: Simulation, target: Path) -> None:
    from abbe.service.clock import SystemClock
    from abbe.service.discovery.simulate import simulated_finding, verdict_line
    from abbe.service.rendering.document_page import write_document
    from abbe.service.report.report_discovery import simulation_report

    finding = simulated_finding(job, simulation)
    made = SystemClock().utc().isoformat(timespec="seconds")
    write_document(simulation_report(job, finding, verdict_line(finding), made), target)


def _print(job: DiscoveryJob, simulation: Simulation) -> None:
    from abbe.service.discovery.simulate import simulated_finding, verdict_line
    from abbe.service.rendering.numbers import plain

    found = simulated_finding(job, simulation)
    version = "" if job.base is None else f", model version {job.base.version} ({', '.join(job.known) or 'no effect'})"
    typer.echo(f"campaign {job.campaign.name}: present model {', '.join(sorted(job.case.includes))}{version}")
    for line in job.flags:
        typer.echo(f"look at this: {line}")
    rows = []
    for label, r in found.runs.items():
        times = "sealed" if r.rms_before_um is None else f"{r.rms_before_um / r.floor_um:.2f}"
        rows.append((label, r.test, r.role, str(r.readings), plain(r.rms_before_um), plain(r.floor_um), times))
    headings = ("run", "test", "role", "readings", "measured - simulated, rms (µm)", "noise (µm)", "times the noise")
    print_table(headings, rows)
    typer.echo(" ".join(verdict_line(found)[1:]))
