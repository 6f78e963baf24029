"""`abbe measure` and `abbe correct`: the job by hand, on the devices of a machine file."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from models.machine import Machine
    from service.devices.session import Session
    from service.sequences.check import DryRun
    from service.sequences.steps import CampaignPlan
    from service.site import Site
    from service.storage.store import Store

MachineArgument = Annotated[Path, typer.Argument(metavar="MACHINE.toml", help="Machine file.")]
RECIPES = "identification, verification, quick-check"


def measure(
    machine: MachineArgument,
    recipe: Annotated[str, typer.Option(help=f"One of: {RECIPES}; or a recipe FILE.toml (`abbe plan` writes one).")] = "quick-check",
    helix: Annotated[str, typer.Option(help="Instead of a recipe: one ball-bar helix, X,Y,Z,RADIUS in mm.")] = "",
    name: Annotated[str, typer.Option(help="Name of the campaign in the store; default: name of the recipe and time.")] = "",
    rate_hz: Annotated[int, typer.Option(help="Ball-bar samples per second; must divide 1000.")] = 100,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would move and how long it takes; move nothing.")] = False,
    path: Annotated[bool, typer.Option("--path", help="With --dry-run: every commanded position, as CSV.")] = False,
) -> None:
    """Measure a campaign on the machine and store every sample."""
    from service.cli.running import run_job
    from service.clock import SystemClock
    from service.config import load_machine
    from service.sequences.check import dry_run_campaign, paced
    from service.site import site_of
    from service.storage.store import Store
    from service.workflows import measure as workflow

    loaded = load_machine(machine)
    site = site_of(loaded.machine)
    plan = _plan(site.machine, recipe, helix, rate_hz)
    plan = replace(paced(plan, site.max_feed_mm_min), name=name or f"{plan.name} {SystemClock().utc():%Y-%m-%d %H:%M:%S}")
    runs = dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    if dry_run:
        print_path(plan) if path else print_dry_run(plan.name, runs)
        return

    async def work(store: Store) -> None:
        from service.cli.progress import display

        with display() as sink:
            async with ready_session(store, site) as session:
                await workflow.measure(session, store, site, plan, progress=sink)

    with Store.open(loaded.database_url) as store:
        run_job(work(store))
    typer.echo(f"measured: campaign {plan.name!r}, {len(plan.tests)} runs")


def correct(
    machine: MachineArgument,
    campaign: Annotated[str, typer.Argument(help="Identification campaign in the store.")],
    before: Annotated[str, typer.Option(help="Verification campaign measured with the present table; default: it is measured now.")] = "",
) -> None:
    """Solve a campaign, push nine tables, measure again; the old table comes back by itself if the machine is not better (exit code 1)."""
    from service.cli.running import run_job
    from service.clock import SystemClock
    from service.config import load_machine
    from service.sequences.campaigns import verification
    from service.site import site_of
    from service.storage.store import Store
    from service.workflows.correct import Correction, load_runs
    from service.workflows.correct import correct as work_correct
    from service.workflows.measure import measure as work_measure

    loaded = load_machine(machine)
    site = site_of(loaded.machine)

    async def work(store: Store) -> Correction:
        from service.cli.progress import display

        store.campaign(campaign)
        with display() as sink:
            async with ready_session(store, site) as session:
                if before:
                    ids = [r.id for r in store.runs(before) if r.visible_status == "complete"]
                else:
                    plan = verification(site.machine, name=f"verify-before {SystemClock().utc():%Y-%m-%d %H:%M:%S}")
                    ids = await work_measure(session, store, site, plan, progress=sink)
                return await work_correct(session, store, site, campaign, await load_runs(store, ids), progress=sink)

    with Store.open(loaded.database_url) as store:
        found = run_job(work(store))
    typer.echo(("kept: " if found.decision.keep else "rolled back: ") + found.decision.text)
    for line in found.not_for_tables:
        typer.echo(f"not in the tables: {line}")
    raise typer.Exit(0 if found.decision.keep else 1)


@asynccontextmanager
async def ready_session(store: Store, site: Site) -> AsyncIterator[Session]:
    """The machine's devices, after what an interrupted push may have left active was taken back: nothing is measured with it."""
    from service.cli.ask import console_ask
    from service.devices.session import open_session
    from service.workflows.recover import recover

    async with open_session(site.urls, console_ask) as session:
        said = await recover(session.controller, store, site)
        if said is not None:
            typer.echo(said, err=True)
        yield session


def _plan(machine: Machine, recipe: str, helix: str, rate_hz: int) -> CampaignPlan:
    """The campaign, named after its recipe."""
    from service.errors import ConfigError
    from service.sequences.campaigns import identification, quick_check, verification
    from service.sequences.recipes import Helix
    from service.sequences.steps import CampaignPlan

    if rate_hz < 1 or 1000 % rate_hz:
        raise ConfigError(f"rate {rate_hz} Hz does not divide 1000", "use 1000, 500, 250, 200, 125, 100, 50 ...")
    if helix:
        try:
            x, y, z, radius = (float(v) for v in helix.split(","))
        except ValueError:
            raise ConfigError(f"--helix {helix!r} is not X,Y,Z,RADIUS", "for example --helix 300,250,100,150") from None
        return CampaignPlan("helix", (Helix("helix", "B1", "identify", (x, y, z), radius, rate_hz=rate_hz).plan(machine),))
    plans = {"identification": identification, "verification": verification, "quick-check": quick_check}
    if recipe.endswith(".toml"):
        from service.sequences.recipe_file import read_recipe

        name, recipes = read_recipe(Path(recipe))
        return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))
    if recipe not in plans:
        raise ConfigError(f"there is no recipe {recipe!r}", f"use one of: {RECIPES}, or a FILE.toml")
    return plans[recipe](machine, rate_hz=rate_hz, name=recipe)


def print_path(plan: CampaignPlan) -> None:
    """Every commanded position of the plan, one CSV line each: test, X, Y, Z in mm."""
    from service.sequences.check import positions

    typer.echo("test,x_mm,y_mm,z_mm")
    for test in plan.tests:
        for x, y, z in positions(test.steps):
            typer.echo(f"{test.label},{x:.5f},{y:.5f},{z:.5f}")


def print_dry_run(name: str, runs: tuple[DryRun, ...]) -> None:
    """One line a test: time, path, extent, readings."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{name}: {sum(r.duration_s for r in runs) / 60:.1f} min of machine time, mounting not counted")
    for column in ("test", "kind", "s", "path mm", "X", "Y", "Z", "readings"):
        table.add_column(column, justify="left" if column in ("test", "kind") else "right")
    for r in runs:
        extent = [f"{r.lowest_mm[a]:.0f}..{r.highest_mm[a]:.0f}" for a in range(3)]
        table.add_row(r.label, r.test, f"{r.duration_s:.0f}", f"{r.path_mm:.0f}", *extent, str(r.readings))
    Console().print(table)
