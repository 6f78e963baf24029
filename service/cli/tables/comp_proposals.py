"""`abbe comp propose | show | diff | approve | reject`: tables as proposals, looked at and agreed to before anything is written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table
from abbe.service.cli.measure import MachineArgument, ready_session

if TYPE_CHECKING:
    from abbe.service.compensation.proposal_doc import Proposed
    from abbe.service.compensation.proposals import Made
    from abbe.service.storage.store import Store

ProposalArgument = Annotated[int, typer.Argument(metavar="PROPOSAL", help="Number of a proposal; abbe comp show lists them.")]


def propose(
    machine: MachineArgument,
    campaign: Annotated[str, typer.Argument(metavar="CAMPAIGN", help="Identification campaign in the store.")],
    as_json: JsonOption = False,
) -> None:
    """Solve a campaign and store the tables that follow as a proposal; writes nothing to the controller (exit code 1: reasons against)."""
    from dataclasses import replace

    from abbe.service.cli.progress import display
    from abbe.service.cli.running import run_job
    from abbe.service.compensation.proposals import gather, make
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine)
    site = site_of(loaded.machine)

    async def work(store: Store) -> Made:
        store.campaign(campaign)
        with display() as sink:
            async with ready_session(store, replace(site, urls=DeviceUrls(site.urls.cnc))) as session:
                return await make(store, site, await gather(session.controller, store, site, campaign), progress=sink)

    with Store.open(loaded.database_url) as store:
        made = run_job(work(store))
        _print_made(store, made, as_json=as_json)
    raise typer.Exit(1 if made.proposed.reasons else 0)


def _print_made(store: Store, made: Made, *, as_json: bool) -> None:
    if as_json:
        print_json(_row(store, made.number, made.proposed))
        return
    typer.echo(f"proposal {made.number}: {_promise(made.proposed)}")
    for reason in made.proposed.reasons:
        typer.echo(f"against it: {reason}")
    for line in made.proposed.not_for_tables:
        typer.echo(f"not in the tables: {line}")
    if made.proposed.reasons:
        typer.echo("it is stored to be looked at, and cannot be approved or pushed")


def show_proposals(
    proposal: Annotated[
        int | None, typer.Argument(metavar="PROPOSAL", help="Number; without it all are listed.", show_default=False)
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Proposals: what they promise, with uncertainty, where they stand, what spoke against them."""
    from abbe.service.compensation.proposal_doc import load

    with open_store(database_url(db, machine)) as store:
        if proposal is None:
            _print_list(store, as_json=as_json)
            return
        proposed = load(store, proposal)
        row = _row(store, proposal, proposed)
    if as_json:
        print_json(row)
        return
    typer.echo(f"proposal {proposal}: {row['state']}{': ' if row['why'] else ''}{row['why']}")
    typer.echo(_promise(proposed))
    for name in ("machine", "campaign", "solution", "by", "utc", "valid_until", "base_crc", "generation", "digest"):
        typer.echo(f"{name.replace('_', ' ')}: {row[name]}")
    for word, lines in (("against it", row["reasons"]), ("not in the tables", row["not_for_tables"])):
        for line in lines:
            typer.echo(f"{word}: {line}")
    for a in row["approvals"]:
        typer.echo(f"approved by {a['name']} (account {a['login']}) at {a['utc']} until {a['expiry']}")


def _print_list(store: Store, *, as_json: bool) -> None:
    from abbe.service.compensation.proposal_doc import load
    from abbe.service.errors import StoreError

    rows: list[dict[str, Any]] = []
    for record in store.proposals():
        try:
            rows.append(_row(store, record.id, load(store, record.id)))
        except StoreError as error:  # one bad row must not hide the others
            blank = dict.fromkeys(("campaign", "by", "utc"), "")
            rows.append({"proposal": record.id, "machine": record.machine, "state": "changed", "why": error.detail, "promise": ""} | blank)
    if as_json:
        print_json({"proposals": rows})
        return
    keys = ("proposal", "machine", "campaign", "by", "utc", "promise", "state", "why")
    print_table(("no", *keys[1:]), [tuple(str(r[k]) for k in keys) for r in rows])


def diff(
    proposal: ProposalArgument,
    other: Annotated[
        str, typer.Option("--with", metavar="ACTIVE|PROPOSAL", help="The table in force when it was made, or another proposal.")
    ] = "ACTIVE",
    html: Annotated[Path | None, typer.Option("--html", metavar="FILE.html", help="Write numbers and picture.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """What a proposal changes: each of the nine tables in numbers, and as a picture."""
    from abbe.service.compensation.proposal_diff import HEADINGS, compare, diff_html, diff_json, largest, rows
    from abbe.service.compensation.proposal_doc import load
    from abbe.service.rendering.page_file import write_page

    with open_store(database_url(db, machine)) as store:
        found = compare(store, proposal, other)
        proposed = load(store, proposal)
    if html is not None:
        write_page(diff_html(found, proposed), html)
    if as_json:
        print_json(diff_json(found))
        return
    print_table(HEADINGS, rows(found), title=f"{found.new} against {found.old}; U: k = 2")
    typer.echo(largest(found))
    if html is not None:
        typer.echo(f"wrote {html}")


def approve(
    proposal: ProposalArgument,
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="Who approves. Default: the account.", show_default=False)] = "",
    hours: Annotated[float, typer.Option("--hours", metavar="H", help="How long it holds, at most.", min=0.01, max=720.0)] = 24.0,
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Approve exactly this table on exactly this base, for this machine, under these limits (exit code 1: it cannot be approved)."""
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.proposal_checks import approve as work_approve
    from abbe.service.compensation.proposal_doc import load
    from abbe.service.compensation.proposal_states import check_waiting
    from abbe.service.compensation.proposals import login
    from abbe.service.errors import TableRefused
    from abbe.service.tables.push_outcome import open_pushes

    with open_store(database_url(db, machine)) as store:
        proposed = load(store, proposal)
        try:
            check_waiting(store, proposal, proposed, SystemClock().utc().timestamp())
            done = work_approve(store, proposal, proposed, name.strip() or login(), hours, SystemClock())
        except TableRefused as error:
            typer.echo(f"not approved: {error}")
            raise typer.Exit(1) from None
        left_open = open_pushes(store, proposed.candidate.machine, _control(machine, proposed.candidate.machine))
    typer.echo(f"proposal {proposal} is approved by {done.name} until {done.expiry}")
    for line in left_open:
        typer.echo(f"warning: {line}", err=True)


def _control(machine: Path | None, name: str) -> str:
    """Identity of a machine's control; empty where its machine file was not given."""
    from abbe.service.config import load_machine
    from abbe.service.devices.urls import control_of

    found = None if machine is None else load_machine(machine).machine
    return control_of(found.devices.cnc) if found is not None and found.name == name else ""


def reject(
    proposal: ProposalArgument,
    reason: Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; the proposer reads it.", show_default=False)],
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="Who rejects. Default: the account.", show_default=False)] = "",
    db: DbOption = None,
    machine: MachineOption = None,
) -> None:
    """Reject a proposal for good: it cannot be approved or pushed any more (exit code 1: it cannot be rejected any more)."""
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.proposal_checks import reject as work_reject
    from abbe.service.compensation.proposal_doc import load
    from abbe.service.compensation.proposal_states import check_waiting
    from abbe.service.compensation.proposals import login
    from abbe.service.errors import TableRefused

    with open_store(database_url(db, machine)) as store:
        try:
            check_waiting(store, proposal, load(store, proposal), SystemClock().utc().timestamp())
            done = work_reject(store, proposal, name.strip() or login(), reason)
        except TableRefused as error:
            typer.echo(f"not rejected: {error}")
            raise typer.Exit(1) from None
    typer.echo(f"proposal {proposal} is rejected by {done.name}: {done.reason}")


def _promise(proposed: Proposed) -> str:
    p = proposed.predicted
    before, after, expanded = p.before_mm * 1e3, p.after_mm * 1e3, 2e3 * p.u_model_mm
    return f"{before:.1f} → {after:.1f} µm rms over the volume, better by {before - after:.1f} ± {expanded:.1f} µm (U, k = 2)"


def _row(store: Store, number: int, proposed: Proposed) -> dict[str, Any]:
    """Everything about a proposal that people and programs ask for, and where it stands."""
    from datetime import UTC, datetime

    from abbe.service.clock import SystemClock
    from abbe.service.compensation.proposal_states import proposal_status
    from abbe.service.storage.base import utc_text

    now = proposal_status(store, number, proposed, SystemClock().utc().timestamp())
    p, c = proposed.predicted, proposed.candidate
    approvals = [{"name": a.name, "login": a.login, "utc": a.utc, "expiry": a.expiry} for a in store.approvals(number)]
    return {
        "proposal": number, "machine": c.machine, "campaign": proposed.campaign, "solution": proposed.solution_id,
        "state": now.word, "why": now.text, "by": proposed.by, "utc": proposed.utc,
        "valid_until": utc_text(datetime.fromtimestamp(proposed.valid_until_s, UTC)),
        "promise": f"{p.before_mm * 1e3:.1f} → {p.after_mm * 1e3:.1f} µm, U {2e3 * p.u_model_mm:.1f}",
        "predicted_rms_um": {"before": p.before_mm * 1e3, "after": p.after_mm * 1e3, "u_model": p.u_model_mm * 1e3},
        "base_crc": f"{c.base_crc:08X}", "generation": proposed.base.gen, "boot": f"{proposed.base.boot:08X}", "digest": c.digest,
        "two_people": proposed.two_people, "reasons": list(proposed.reasons), "not_for_tables": list(proposed.not_for_tables),
        "approvals": approvals,
    }  # fmt: skip
