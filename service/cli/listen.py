"""`abbe listen`: the operator starts the NC program, Abbe records the laser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.measure import AcceptTable, MachineArgument, ready_session

if TYPE_CHECKING:
    from abbe.service.storage.store import Store


def listen(
    machine: MachineArgument,
    recipe: Annotated[Path, typer.Option(metavar="FILE.toml", help="The recipe that the NC program was written from; laser tests.")],
    name: Annotated[str, typer.Option(help="Name of the campaign in the store; default: name of the recipe and time.")] = "",
    accept_table: AcceptTable = False,
) -> None:
    """Listen to the laser while the operator runs the NC program of a recipe; its standstills become the readings."""
    from abbe.service.campaigns.listen import listen_campaign
    from abbe.service.cli.running import run_job
    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.sequences.check import paced
    from abbe.service.sequences.recipes.recipe_file import read_recipe
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine)
    site = site_of(loaded.machine)
    title, recipes = read_recipe(recipe)
    plan = CampaignPlan(title, tuple(r.plan(site.machine) for r in recipes))
    plan = replace(paced(plan, site.max_feed_mm_min), name=name or f"{title} {SystemClock().utc():%Y-%m-%d %H:%M:%S}")

    async def work(store: Store) -> None:
        async with ready_session(store, site, accept_table=accept_table) as session:
            await listen_campaign(session, store, site, plan, lambda text: typer.echo(text))

    with Store.open(loaded.database_url) as store:
        run_job(work(store))
    typer.echo(f"measured: campaign {plan.name!r}, {len(plan.tests)} runs")
