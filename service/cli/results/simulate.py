"""`abbe simulate` predicts readings with the present model; `abbe errors` computes the tool's deviation from known error functions."""

from __future__ import annotations

import sys
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import (
    CampaignArgument,
    DbOption,
    JsonOption,
    MachineOption,
    ReportOption,
    WithoutOption,
    check_endings,
    check_inputs,
    conclude,
    machine_file,
    print_json,
    print_table,
)
from abbe.service.cli.results.discover import opened

if TYPE_CHECKING:
    from abbe.service.campaign_data.campaign_folder import Campaign
    from abbe.service.discovery.discover import DiscoveryJob
    from abbe.service.discovery.simulate import Simulation
    from abbe.service.storage.store import Store
    from abbe.service.verification.deviations import Deviations


def simulate(
    campaign: CampaignArgument,
    as_json: JsonOption = False,
    report: ReportOption = None,
    db: DbOption = None,
    machine: MachineOption = None,
    without: WithoutOption = None,
) -> None:
    """Predict every run with the present model, fitted to the identify runs, and show measured against simulated. Nothing is stored.

    The present model is the campaign's, with the effects of the machine's model book.
    """
    check_endings(report)
    with opened(campaign, db, machine, without or []) as (found, store):
        job, simulation = _simulated(found, store)
    if report is not None:
        _write_report(job, simulation, report)
    if as_json:
        from abbe.service.discovery.simulate import simulation_doc

        print_json(simulation_doc(job, simulation))
        return
    _print_simulation(job, simulation)
    if report is not None:
        typer.echo(f"report: {report}")
    conclude(f"abbe discover {quote(campaign)}", machine=machine, db=db)


def _simulated(campaign: Campaign, store: Store | None) -> tuple[DiscoveryJob, Simulation]:
    """Fit the present model and predict every run, with progress on stderr."""
    from abbe.service.cli.running import display
    from abbe.service.discovery.discover import prepare
    from abbe.service.discovery.simulate import simulate as work
    from abbe.service.domain.progress import Progress
    from abbe.service.effects.effect_catalogue import catalogue
    from abbe.service.effects.model_book import current
    from abbe.service.identification.removal import campaign_table

    with display() as sink:
        sink(Progress("simulate", 0.0, 2.0, None, "runs checked against each other"))
        base = None if store is None else current(store, campaign.site.name)
        job = prepare(campaign, catalogue(), base, table=campaign_table(store, campaign))
        sink(Progress("simulate", 1.0, 2.0, None, "present model fitted to the identify runs"))
        simulation = work(job)
        sink(Progress("simulate", 2.0, 2.0, 0.0, "done"))
    return job, simulation


def _write_report(job: DiscoveryJob, simulation: Simulation, target: Path) -> None:
    from abbe.service.clock import SystemClock
    from abbe.service.discovery.simulate import simulated_finding, verdict_line
    from abbe.service.rendering.document_page import write_document
    from abbe.service.report.report_discovery import simulation_report

    finding = simulated_finding(job, simulation)
    made = SystemClock().utc().isoformat(timespec="seconds")
    write_document(simulation_report(job, finding, verdict_line(finding), made), target)


def _print_simulation(job: DiscoveryJob, simulation: Simulation) -> None:
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


ROWS = 20


def errors(
    errors_file: Annotated[Path, typer.Option("--errors", metavar="FILE", help="Error functions (abbe-errors/1).")],
    points: Annotated[Path, typer.Option("--points", metavar="FILE", help="CSV: x_mm,y_mm,z_mm; optional direction_x.., tool_x_mm..")],
    exact: Annotated[bool, typer.Option("--exact", help="Finite rotations instead of first order.")] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the tool's deviation at given points of a machine whose error functions are known. Points outside the strokes are refused.

    -m also takes a machine object (docs/schemas/machine.schema.json), as TOML or JSON.
    """
    check_inputs(errors_file, points)

    from abbe.service.verification.deviations import deviations, deviations_json

    found = deviations(machine_file(machine), errors_file, points, exact=exact)
    if as_json:
        for piece in deviations_json(found):  # one line: indenting a hundred thousand points takes seconds
            sys.stdout.write(piece)
        sys.stdout.write("\n")
    else:
        _print_deviations(found)
        then = f"abbe errors --errors {quote(str(errors_file))} --points {quote(str(points))} --json --out deviations.json"
        conclude(then, machine=machine)


def _print_deviations(found: Deviations) -> None:
    from abbe.service.verification.deviations import CONVENTION

    count, norm, u = len(found.points.lines), found.norm_mm, found.u_mm
    headings = ["x", "y", "z", "dX", "dY", "dZ", "norm"]
    if u is not None:
        headings += [f"U({name})" for name in headings[3:]]
    rows = []
    for k in range(min(count, ROWS)):
        cells = [f"{value:g}" for value in found.points.axes_mm[k]]
        cells += [f"{value * 1e3:.4f}" for value in (*found.deviation_mm[k], norm[k])]
        rows.append(cells + ([] if u is None else [f"{2e3 * value:.4f}" for value in u[k]]))
    expanded = "" if u is None else ", U = expanded uncertainty (k = 2)"
    print_table(headings, rows, title=f"{found.machine}: deviation in µm at positions in mm, {found.model}{expanded}")
    if count > ROWS:
        typer.echo(f"{count - ROWS} more points; --json lists all")
    worst = int(norm.argmax())
    at = ", ".join(f"{value:g}" for value in found.points.axes_mm[worst])
    spread = "" if u is None else f" (U = {2e3 * u[worst, 3]:.4f} µm)"
    typer.echo(f"{count} points, largest deviation {norm[worst] * 1e3:.4f} µm{spread} at ({at})")
    typer.echo(CONVENTION)
    typer.echo(found.uncertainty)
    for text in found.warnings:
        typer.echo(f"warning: {text}")
