"""`abbe plan` chooses the most informative measurements for the available minutes, and writes them as a recipe for `abbe measure`."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, MachineOption, check_endings, conclude, machine_file, print_json, print_table

if TYPE_CHECKING:
    from abbe.service.campaigns.plan import PlannedCampaign
    from abbe.service.site import Site

HEADINGS = ("no", "label", "measurement", "min", "until min", "worst U µm", "mean U µm")


def plan(  # noqa: PLR0913 - one argument for each option
    minutes: Annotated[float, typer.Option(min=1.0, max=1440.0, help="Available minutes, set-ups included.")] = 60.0,
    goal_um: Annotated[
        float | None, typer.Option(min=0.001, help="Wanted worst U = 2u of the deviation, µm; the plan ends when it is reached.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.toml", help="Write the campaign recipe.")] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE.html", help="Write a page with a picture of the set-ups.")
    ] = None,
    instruments: Annotated[
        Path | None, typer.Option("--instruments", metavar="FILE.toml", help="Bars, noise and set-up times; default: usual ones.")
    ] = None,
    artefact: Annotated[
        Path | None, typer.Option("--artefact", metavar="FILE.toml", help="Plan poses of this artefact for the touch probe instead.")
    ] = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Plan a campaign: what to measure, in which order, and how far each measurement lowers U. Nothing moves."""
    file = machine_file(machine)
    _check_targets((out,) if artefact is not None else (out, picture), (file, instruments, artefact))
    check_endings(picture)

    from abbe.service.campaigns.plan import plan_doc, plan_for, plan_report, read_instruments
    from abbe.service.cli.running import display
    from abbe.service.config import load_machine
    from abbe.service.files import write_page
    from abbe.service.rendering.document_page import write_document
    from abbe.service.site import site_of

    site = site_of(load_machine(file).machine)
    if artefact is not None:
        _plan_poses(site, artefact, minutes, out, as_json=as_json)
        return
    tools = read_instruments(instruments)
    with display() as sink:
        planned = plan_for(site, minutes=minutes, goal_um=goal_um, tools=tools, progress=sink)
    if out is not None:
        write_page(planned.text, out)
    if picture is not None:
        write_document(plan_report(site, planned), picture)
    if as_json:
        print_json(plan_doc(planned))
        return
    _print(planned, out, picture)
    then = f"abbe plan --minutes {minutes:g} --out plan.toml" if out is None else f"abbe measure --recipe {quote(str(out))} --dry-run"
    conclude(then, machine=machine)


def _plan_poses(site: Site, artefact: Path, minutes: float, out: Path | None, *, as_json: bool) -> None:
    """Plan the poses of an artefact; print the gain of each, and write the recipe."""
    from abbe.service.campaigns.plan_poses import HEADINGS as POSE_HEADINGS
    from abbe.service.campaigns.plan_poses import plan_poses, pose_doc, pose_rows, read_artefact
    from abbe.service.cli.running import display
    from abbe.service.files import write_page

    name, plate = read_artefact(artefact)
    with display() as sink:
        planned = plan_poses(site, name, plate, minutes, sink)
    if out is not None:
        write_page(planned.text, out)
    if as_json:
        print_json(pose_doc(planned))
        return
    print_table(POSE_HEADINGS, pose_rows(planned), f"{planned.poses[-1].until_min:.0f} minutes, mounting included")
    rank = planned.poses[-1].rank
    if rank is not None:
        typer.echo(rank.text)
    if out is not None:
        typer.echo(f"recipe: {out}")
        conclude(f"abbe measure --recipe {quote(str(out))} --dry-run")


def _check_targets(targets: tuple[Path | None, ...], sources: tuple[Path | None, ...]) -> None:
    """Refuse an output file that cannot be written, is also an input, or is named twice. Call this before planning, which takes half a
    minute."""
    from abbe.service.errors import ConfigError

    taken = [p.resolve() for p in sources if p is not None]
    for target in targets:
        if target is None:
            continue
        if target.is_dir() or not target.parent.is_dir():
            wrong = "is a folder" if target.is_dir() else f"cannot be written: {target.parent} is not a folder"
            raise ConfigError(f"{target}: {wrong}", "give the name of a file in a folder that exists")
        if target.resolve() in taken:
            raise ConfigError(f"{target}: would overwrite a file that this command reads or writes", "give another name")
        taken.append(target.resolve())


def _print(planned: PlannedCampaign, out: Path | None, picture: Path | None) -> None:
    from abbe.service.campaigns.plan import BOUND_NOTE, goal_lines, step_rows, temperature_note

    print_table(HEADINGS, step_rows(planned.plan), f"{planned.plan.minutes:.0f} minutes, set-ups included")
    typer.echo(BOUND_NOTE)
    typer.echo(temperature_note(planned.plan))
    for line in planned.notes:
        typer.echo(f"note: {line}")
    for line in goal_lines(planned.plan):
        typer.echo(line)
    typer.echo("this campaign cannot determine:")
    for text in planned.plan.open_questions:
        typer.echo(f"- {text}")
    if picture is not None:
        typer.echo(f"picture: {picture}")
    if out is not None:
        typer.echo(f"recipe: {out}")
