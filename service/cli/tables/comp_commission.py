"""`abbe comp commission`: prove how the controller handles a push and a correction, before a real table is written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import JsonOption, print_json, print_table
from abbe.service.cli.measure import AcceptTable, MachineArgument, ready_session

if TYPE_CHECKING:
    from abbe.service.compensation.commission import SignCommissioning
    from abbe.service.compensation.commission_levels import ProvedLevels
    from abbe.service.storage.store import Store

ALLOWED = {3: "unattended pushes", 2: "pushes that a person attends", 1: "no push", 0: "no push: read and export only"}


def commission(
    machine: MachineArgument,
    levels_only: Annotated[
        bool,
        typer.Option("--levels-only", help="Only prove the controller's level for pushes: one move of 3 mm, nothing is mounted."),
    ] = False,
    wait_s: Annotated[
        float, typer.Option(help="How long to wait for a safe machine if an unverified table is active; 0: not at all.")
    ] = 600.0,
    accept_table: AcceptTable = False,
    as_json: JsonOption = False,
) -> None:
    """Try what the controller must refuse; then write a small known step for each axis and measure it with the ball-bar.

    This proves its level for pushes, and sign, axis and unit of its tables. Exit code 1: something was not proved.
    """
    from abbe.service.cli.progress import display
    from abbe.service.cli.running import run_job
    from abbe.service.cli.waiting import rollback_when_safe
    from abbe.service.compensation.commission import commission as work_commission
    from abbe.service.compensation.commission_levels import commission_levels
    from abbe.service.compensation.proved_levels import check_level
    from abbe.service.config import load_machine
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine)
    site = site_of(loaded.machine)

    async def work(store: Store) -> tuple[ProvedLevels, SignCommissioning | None]:
        async with ready_session(store, site, accept_table=accept_table) as session:
            levels = await commission_levels(session.controller, store, site)
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
    raise typer.Exit(0 if levels.capabilities.level == 3 and (found is None or found.proof.proved) else 1)


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
        typer.echo("proved: a positive correction moves its own axis in its positive sense, by what was written")
