"""`abbe comp push | rollback`: push a proposal with the checks of `abbe correct`, or restore the previous table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.measure import AcceptTable, MachineArgument, ready_session, verification_before
from abbe.service.cli.tables.comp_proposals import ProposalArgument

if TYPE_CHECKING:
    from abbe.service.compensation.correct import Correction
    from abbe.service.compensation.rollback import RollbackResult
    from abbe.service.storage.store import Store


def push(
    machine: MachineArgument,
    proposal: ProposalArgument,
    before: Annotated[
        str, typer.Option(metavar="CAMPAIGN", help="Verification campaign measured with the present table; default: it is measured now.")
    ] = "",
    wait_s: Annotated[
        float, typer.Option(help="How long to wait for a safe machine if an unverified table is active; 0: not at all.")
    ] = 600.0,
    accept_table: AcceptTable = False,
) -> None:
    """Push a proposal, prove it, measure again; roll back to the old table if the machine is not better (exit code 1)."""
    from abbe.service.cli.progress import display
    from abbe.service.cli.running import run_job
    from abbe.service.cli.waiting import rollback_when_safe
    from abbe.service.compensation.correct import push as work_push
    from abbe.service.compensation.gate import PushContext, admit
    from abbe.service.config import load_machine
    from abbe.service.errors import TableRefused
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine)
    site = site_of(loaded.machine)
    hints: list[str] = []

    async def work(store: Store) -> Correction:
        with display() as sink:
            async with ready_session(store, site, accept_table=accept_table) as session:
                context = PushContext(session, store, site, sink)
                admission = await admit(context, proposal)
                hints.append(admission.hint)
                runs = await verification_before(session, store, site, before, sink)
                async with rollback_when_safe(session, store, site, wait_s):
                    return await work_push(context, admission, runs)

    with Store.open(loaded.database_url) as store:
        try:
            found = run_job(work(store))
        except TableRefused as error:  # the answer is no, not a fault
            for reason in (*error.reasons, *getattr(error, "__notes__", [])):
                typer.echo(f"not pushed: {reason}")
            raise typer.Exit(1) from None
    typer.echo(("kept: " if found.decision.keep else "rolled back: ") + found.decision.text)
    for line in (*(f"not in the tables: {text}" for text in found.not_for_tables), *filter(None, hints)):
        typer.echo(line)
    raise typer.Exit(0 if found.decision.keep else 1)


def rollback(
    machine: MachineArgument,
    to: Annotated[
        int | None,
        typer.Option("--to", metavar="PUSH", help="To the table in force after this push; 0: before the first.", show_default=False),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask: I know that the machine is unverified afterwards.")] = False,
) -> None:
    """Restore the table that was in force before the last kept push: on a person's order, without measuring. Asks first."""
    from dataclasses import replace

    from abbe.service.cli.running import run_job
    from abbe.service.compensation.rollback import rollback as work_rollback
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls
    from abbe.service.domain.push_entry import TERMINAL
    from abbe.service.errors import ConfigError
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store
    from abbe.service.verification.verified_by import measure_now

    loaded = load_machine(machine)
    site = site_of(loaded.machine)

    async def work(store: Store) -> RollbackResult | str | None:
        last = store.pushes.entries(site.name, site.control)[-1:]
        finished = bool(last) and last[0].state not in TERMINAL
        if not (finished and to is None) and not yes and not await _confirmed(to):
            raise ConfigError("nothing was taken back", "answer yes, or add --yes if no one is at the console")
        async with ready_session(store, replace(site, urls=DeviceUrls(site.urls.cnc))) as session:
            if finished and to is None:
                return f"push {last[0].push} was open and is finished; to go further back, run the command again"
            return await work_rollback(session.controller, store, site, to)

    with Store.open(loaded.database_url) as store:
        found = run_job(work(store))
    if found is None:
        typer.echo("this table is in force already; nothing was written")
    elif isinstance(found, str):
        typer.echo(found)
    else:
        typer.echo(f"in force again (push {found.pushed.push_id}, CRC {found.pushed.crc:08X}): {found.how}")
        typer.echo(f"the machine is unverified now: {measure_now(str(machine))}")


async def _confirmed(to: int | None) -> bool:
    """Return whether the person at the console wants the rollback; without a console: no."""
    from abbe.service.cli.ask import console_confirm

    which = {None: "from before the last kept push", 0: "from before the first push"}.get(to, f"that was in force after push {to}")
    return await console_confirm(f"The table {which} comes back without a measurement, and the machine is unverified then. Really?")
