"""`abbe comp commission | push | rollback` and `abbe accept-table`: everything that proves, writes or accepts a controller's table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import JsonOption, MachineOption, answer, conclude, machine_file, print_json, print_table
from abbe.service.cli.measure import (
    AcceptTable,
    CheckOption,
    WaitOption,
    checking_poses,
    ready_session,
    say_correction,
    verification_before,
)
from abbe.service.cli.tables.comp_proposals import ProposalArgument

if TYPE_CHECKING:
    from abbe.service.compensation.commission import SignCommissioning
    from abbe.service.compensation.commission_levels import ProvedLevels
    from abbe.service.compensation.correct import Correction
    from abbe.service.compensation.rollback import RollbackResult
    from abbe.service.storage.store import Store


def push(
    proposal: ProposalArgument,
    before: Annotated[
        str, typer.Option(metavar="CAMPAIGN", help="Verification campaign measured with the present table; default: it is measured now.")
    ] = "",
    wait_s: WaitOption = 600.0,
    check: CheckOption = None,
    accept_table: AcceptTable = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Push a proposal, test the signs of its tables, measure again; roll back if the machine is not better (exit code 1)."""
    from abbe.service.cli.running import display, loaded_beside, rollback_when_safe, run_job
    from abbe.service.config import load_machine
    from abbe.service.errors import TableRefused
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)
    poses = checking_poses(site, check)
    hints: list[str] = []

    async def work(store: Store) -> Correction:
        async with ready_session(store, site, accept_table=accept_table) as session:
            await loaded_beside("abbe.service.compensation.correct", "rich.console", "rich.progress")
            from abbe.service.compensation.correct import push as work_push
            from abbe.service.compensation.gate import PushContext, admit

            with display() as sink:
                context = PushContext(session, store, site, sink, poses=poses)
                admission = await admit(context, proposal)
                hints.append(admission.hint)
                runs = await verification_before(context, before)
                async with rollback_when_safe(session, store, site, wait_s):
                    return await work_push(context, admission, runs)

    with Store.open(loaded.database_url) as store:
        try:
            found = run_job(work(store))
        except TableRefused as error:  # a negative answer, not a fault
            reasons = [*error.reasons, *getattr(error, "__notes__", [])]
            doc: dict[str, Any] = {"kept": False, "push": None, "text": "; ".join(reasons), "not_for_tables": []}
            answer(doc, *(f"not pushed: {reason}" for reason in reasons), as_json=as_json)
            conclude(f"abbe comp show {proposal}", machine=machine, as_json=as_json)
            raise typer.Exit(1) from None
    say_correction(found, hints, machine, as_json=as_json)


def rollback(
    to: Annotated[
        int | None,
        typer.Option(
            "--to",
            metavar="PUSH",
            help="Go back to the table that was in force after this push; 0: before the first push.",
            show_default=False,
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask: I know that the machine is unverified afterwards.")] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Restore the table that was in force before the last kept push: on a person's order, without measuring. Asks first."""
    from dataclasses import replace

    from abbe.service.cli.running import loaded_beside, run_job
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls
    from abbe.service.domain.push_entry import TERMINAL
    from abbe.service.errors import ConfigError
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store
    from abbe.service.verification.verified_by import measure_now

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)

    async def work(store: Store) -> RollbackResult | str | None:
        last = store.pushes.entries(site.name, site.urls.control)[-1:]
        finished = bool(last) and last[0].state not in TERMINAL
        if not (finished and to is None) and not yes and not await _confirmed(to):
            raise ConfigError("nothing was rolled back", "answer yes, or add --yes if no one is at the console")
        async with ready_session(store, replace(site, urls=DeviceUrls(site.urls.cnc))) as session:
            if finished and to is None:
                return f"push {last[0].push} was unfinished and is ended now; to go further back, run the command again"
            await loaded_beside("abbe.service.compensation.rollback")
            from abbe.service.compensation.rollback import rollback as work_rollback

            return await work_rollback(session.controller, store, site, to)

    with Store.open(loaded.database_url) as store:
        found = run_job(work(store))
    if found is None:
        lines = ["this table is in force already; nothing was written"]
    elif isinstance(found, str):
        lines = [found]
    else:
        lines = [f"the table is in force again (push {found.pushed.push_id}, CRC {found.pushed.crc:08X}): {found.how}"]
        lines += [f"the machine is unverified now: {measure_now(loaded.path)}"]
    push_id = None if found is None or isinstance(found, str) else found.pushed.push_id
    answer({"push": push_id, "text": "; ".join(lines)}, *lines, as_json=as_json)
    conclude(measure_now(loaded.path), as_json=as_json)


async def _confirmed(to: int | None) -> bool:
    """Return whether the person at the console wants the rollback; without a console: no."""
    from abbe.service.cli.running import console_confirm

    which = {None: "from before the last kept push", 0: "from before the first push"}.get(to, f"that was in force after push {to}")
    return await console_confirm(f"The table {which} comes back without a measurement, and the machine is unverified then. Really?")


def accept_table(
    yes: Annotated[bool, typer.Option("--yes", help="I have checked the controller: its active table is right.")] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Accept the active table as right, so that work can continue: after an interrupted push that Abbe could not resolve, or if this
    database did not push the table. Closes open pushes under any machine name. The push journal records who and when.
    """
    from abbe.service.errors import ConfigError

    if not yes:
        raise ConfigError("nothing was accepted", "look at the controller's active table, then add --yes")

    from abbe.service.audit.book import by_whom
    from abbe.service.compensation.recover import accept
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls, open_session
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store
    from abbe.service.verification.verified_by import measure_now

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)

    async def work(store: Store) -> str:
        async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
            return await accept(session.controller, store, site, by_whom())

    with Store.open(loaded.database_url) as store:
        import asyncio

        text = asyncio.run(work(store))
    answer({"text": text}, text, as_json=as_json)
    conclude(measure_now(loaded.path), as_json=as_json)


ALLOWED = {
    3: "unattended pushes",
    2: "pushes that a person attends",
    1: "attended pushes; no table acts while tables are exchanged",
    0: "no push: read and export only",
}


def commission(
    levels_only: Annotated[
        bool,
        typer.Option("--levels-only", help="Only prove the controller's level for pushes: one move of 3 mm, nothing is mounted."),
    ] = False,
    one_bank: Annotated[
        bool,
        typer.Option("--one-bank", help="The control has one table; I accept the lower level: no table acts while tables are exchanged."),
    ] = False,
    wait_s: WaitOption = 600.0,
    accept_table: AcceptTable = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Send requests that the controller must refuse; then write a small known step for each axis and measure it with the ball-bar.

    This proves which pushes the controller is safe for (its level), and sign, axis and unit of its tables. Exit code 1: not all is proved.
    """
    from abbe.service.cli.running import display, loaded_beside, rollback_when_safe, run_job
    from abbe.service.config import load_machine
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)

    async def work(store: Store) -> tuple[ProvedLevels, SignCommissioning | None]:
        async with ready_session(store, site, accept_table=accept_table) as session:
            names = ("commission", "commission_levels", "commission_one_bank")
            await loaded_beside(*(f"abbe.service.compensation.{name}" for name in names), "rich.console", "rich.progress")
            from abbe.service.compensation.commission import commission as work_commission
            from abbe.service.compensation.commission_levels import commission_levels
            from abbe.service.compensation.commission_one_bank import commission_one_bank
            from abbe.service.compensation.proved_levels import check_level

            levels = await (commission_one_bank if one_bank else commission_levels)(session.controller, store, site)
            if not as_json:
                _show_levels(levels)
            if levels_only:
                return levels, None
            await check_level(session.controller, store, site)
            with display() as sink:
                async with rollback_when_safe(session, store, site, wait_s):
                    return levels, await work_commission(session, store, site, progress=sink)

    with Store.open(loaded.database_url) as store:
        levels, found = run_job(work(store))
    if as_json:
        print_json({"levels": _levels_doc(levels)} | (_proof_doc(found) if found is not None else {}))
    elif found is not None:
        _show_proof(found)
    proved = levels.capabilities.level == (1 if one_bank else 3) and (found is None or found.proof.proved)
    conclude(
        "abbe measure --recipe identification" if proved and not levels_only else "abbe comp commission", machine=machine, as_json=as_json
    )
    raise typer.Exit(0 if proved else 1)


def _show_levels(levels: ProvedLevels) -> None:
    rows = [(name, "proved" if ok else "NOT PROVED", text) for name, ok, text in levels.rows()]
    level = levels.capabilities.level
    print_table(("flag", "", "how"), rows, title=f"the controller has level L{level}: {ALLOWED[level]}")
    for text in levels.not_shown:
        typer.echo(f"not shown: {text}")


def _levels_doc(levels: ProvedLevels) -> dict[str, Any]:
    flags = {name: {"proved": ok, "how": text} for name, ok, text in levels.rows()}
    return {
        "solution": levels.solution_id, "level": levels.capabilities.level, "flags": flags, "not_shown": list(levels.not_shown),
        "controller": levels.identity,
    }  # fmt: skip


def _proof_doc(found: SignCommissioning) -> dict[str, Any]:
    proof = found.proof
    doc = {"solution": found.solution_id, "step_um": 1e3 * proof.step_mm, "proved": proof.proved, "faults": list(proof.faults)}
    return doc | {"response": proof.response.tolist(), "u_response": proof.u.tolist()}


def _show_proof(found: SignCommissioning) -> None:
    proof = found.proof
    rows = [
        (f"{axis} by {1e3 * proof.step_mm:g} µm", *(f"{1e3 * proof.step_mm * r:+.2f} ± {2e3 * proof.step_mm * u:.2f}" for r, u in one))
        for axis, one in zip("XYZ", (zip(proof.response[:, a], proof.u[:, a], strict=True) for a in range(3)), strict=True)
    ]
    print_table(("written", "X moved, µm", "Y moved, µm", "Z moved, µm"), rows, title="± : k = 2")
    for text in proof.faults:
        typer.echo(f"not proved: {text}")
    if proof.proved:
        typer.echo("proved: a positive correction moves its own axis in its positive sense, by the written amount")
