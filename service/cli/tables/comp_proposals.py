"""`abbe comp propose | show | diff | approve | reject`: tables as proposals, reviewed and approved before anything is written."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    check_endings,
    conclude,
    database_url,
    machine_file,
    named_machine,
    open_store,
    print_json,
    print_table,
    reader,
)
from abbe.service.cli.measure import ready_session

if TYPE_CHECKING:
    from abbe.service.compensation.proposals import StoredProposal
    from abbe.service.queries.tables import ProposalSummary
    from abbe.service.storage.store import Store

MOST = 100_000
ProposalArgument = Annotated[int, typer.Argument(metavar="PROPOSAL", help="Number of a proposal; abbe comp show lists them.")]


def propose(
    campaign: Annotated[str, typer.Argument(metavar="CAMPAIGN", help="Identification campaign in the store.")],
    without_scale: Annotated[bool, typer.Option("--without-scale", help="Leave out scales that the runs determine poorly.")] = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve a campaign and store the resulting tables as a proposal; nothing is written to the controller (exit code 1: objections)."""
    from abbe.service.config import load_machine
    from abbe.service.storage.store import Store

    loaded = load_machine(machine_file(machine))
    with Store.open(loaded.database_url) as store:
        store.campaigns.find(campaign)

    from dataclasses import replace

    from abbe.service.cli.running import display, run_job
    from abbe.service.compensation.proposals import gather, make
    from abbe.service.devices.session import DeviceUrls
    from abbe.service.identification.solve_report import assess
    from abbe.service.site import site_of

    site = site_of(loaded.machine)

    async def work(store: Store) -> StoredProposal:
        with display() as sink:
            async with ready_session(store, replace(site, urls=DeviceUrls(site.urls.cnc))) as session:
                gathered = await gather(session.controller, store, site, campaign)
                return await make(store, site, gathered, progress=sink, without_scale=without_scale)

    with Store.open(loaded.database_url) as store:
        made = run_job(work(store))
        _print_made(store, made, as_json=as_json)
    if made.proposed.reasons and not without_scale and not as_json and assess(made.solved).scale_free is not None:
        typer.echo(f"the runs determine the scales poorly; tables without the scales: abbe comp propose {quote(campaign)} --without-scale")
    conclude(f"abbe comp {'show' if made.proposed.reasons else 'diff'} {made.number}", machine=machine, as_json=as_json)
    raise typer.Exit(1 if made.proposed.reasons else 0)


def _print_made(store: Store, made: StoredProposal, *, as_json: bool) -> None:
    from abbe.service.queries.reader import json_value
    from abbe.service.queries.tables import proposal

    found = proposal(reader(store), made.number)
    if as_json:
        print_json(json_value(found))
        return
    typer.echo(f"proposal {found.number}: {_promise(found)}")
    for reason in found.reasons:
        typer.echo(f"against it: {reason}")
    typer.echo(f"holds at: {found.holds_at}")
    for line in found.not_for_tables:
        typer.echo(f"not in the tables: {line}")
    if found.reasons:
        typer.echo("the proposal is stored for review; it cannot be approved or pushed")


def show_proposals(
    proposal: Annotated[
        int | None, typer.Argument(metavar="PROPOSAL", help="Number; without it all are listed.", show_default=False)
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show proposals: the improvement they promise with its uncertainty, their state, the reasons against them."""
    with open_store(database_url(db, machine)) as store:
        if proposal is not None:
            store.proposals.get(proposal)

        from abbe.service.queries import tables
        from abbe.service.queries.reader import json_value

        if proposal is None:
            found_all = tables.proposals(reader(store), None, None, MOST)[0]
            _print_list(found_all, as_json=as_json)
            then = f"abbe comp show {found_all[0].number}" if found_all else "abbe runs"
            conclude(then, machine=machine, db=db, verdict=f"{len(found_all)} proposals", as_json=as_json)
            return
        found = tables.proposal(reader(store), proposal)
    if as_json:
        print_json(json_value(found))
        return
    typer.echo(f"proposal {proposal}: {found.state}{': ' if found.why else ''}{found.why}")
    typer.echo(_promise(found))
    for name in ("machine", "campaign", "solution", "by", "created_utc", "valid_until", "holds_at", "base_crc", "generation", "digest"):
        typer.echo(f"{name.replace('_', ' ')}: {getattr(found, name)}")
    for word, lines in (("against it", found.reasons), ("not in the tables", found.not_for_tables)):
        for line in lines:
            typer.echo(f"{word}: {line}")
    for one in found.approvals:
        typer.echo(f"approved by {one.name} (account {one.login}) at {one.utc} until {one.expiry}")
    conclude(f"abbe comp {'push' if found.approvals else 'diff'} {proposal}", machine=machine, db=None if found.approvals else db)


def _print_list(found: list[ProposalSummary], *, as_json: bool) -> None:
    from abbe.service.queries.reader import json_value

    if as_json:
        print_json({"proposals": [json_value(one) for one in found]})
        return
    heads = ("no", "machine", "campaign", "by", "created (UTC)", "promise", "state", "why")
    rows = [(str(p.number), p.machine, p.campaign, p.by, p.created_utc, _short(p), p.state, p.why) for p in reversed(found)]
    print_table(heads, rows)


def diff(
    proposal: ProposalArgument,
    other: Annotated[
        str,
        typer.Option(
            "--with",
            metavar="ACTIVE|PROPOSAL",
            help="ACTIVE: the table in force when the proposal was made; or the number of another proposal.",
        ),
    ] = "ACTIVE",
    html: Annotated[Path | None, typer.Option("--html", metavar="FILE.html", help="Write numbers and picture.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the changes of a proposal: each of the nine tables in numbers, and as a picture."""
    check_endings(html)
    with open_store(database_url(db, machine)) as store:
        store.proposals.get(proposal)

        from abbe.service.compensation.proposal_diff import HEADINGS, compare, diff_report, largest, rows
        from abbe.service.compensation.proposal_doc import load

        found = compare(store, proposal, other)
        proposed = load(store, proposal)
    if html is not None:
        from abbe.service.rendering.document_page import write_document

        write_document(diff_report(found, proposed), html)
    if as_json:
        from abbe.service.queries.reader import json_value
        from abbe.service.queries.tables import difference_of

        print_json(json_value(difference_of(found)))
        return
    print_table(HEADINGS, rows(found), title=f"{found.new} against {found.old}; U: k = 2")
    typer.echo(largest(found))
    if html is not None:
        typer.echo(f"wrote {html}")
    conclude(f"abbe comp approve {proposal}", machine=machine, db=db)


def approve(
    proposal: ProposalArgument,
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="Who approves. Default: the account.", show_default=False)] = "",
    hours: Annotated[
        float, typer.Option("--hours", metavar="H", help="Longest validity of the approval, hours.", min=0.01, max=720.0)
    ] = 24.0,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Approve this one table as replacement of the present one, for this machine and its limits (exit code 1: not approved)."""
    with open_store(database_url(db, machine)) as store:
        store.proposals.get(proposal)

        from abbe.service.audit.book import login
        from abbe.service.clock import SystemClock
        from abbe.service.compensation.proposal_decisions import approve as work_approve
        from abbe.service.errors import TableRefused
        from abbe.service.tables.push_journal import open_pushes

        try:
            done = work_approve(store, proposal, name.strip() or login(), hours, SystemClock())
        except TableRefused as error:
            answer({"proposal": proposal, "approved": False, "text": str(error)}, f"not approved: {error}", as_json=as_json)
            conclude(f"abbe comp show {proposal}", machine=machine, db=db, as_json=as_json)
            raise typer.Exit(1) from None
        owner = store.proposals.get(proposal).machine
        left_open = open_pushes(store, owner, _control(machine, owner))
    text = f"proposal {proposal} is approved by {done.name} until {done.expiry}"
    answer({"proposal": proposal, "approved": True, "text": text, "warnings": left_open}, text, as_json=as_json)
    for line in left_open:
        typer.echo(f"warning: {line}", err=True)
    conclude(f"abbe comp push {proposal}", machine=machine, as_json=as_json)


def _control(machine: Path | None, name: str) -> str:
    """Return the identity of a machine's control; empty without its machine file."""
    from abbe.service.config import load_machine
    from abbe.service.domain.machine import control_of

    file = named_machine(machine)
    found = None if file is None else load_machine(file).machine
    return control_of(found.devices.cnc) if found is not None and found.name == name else ""


def reject(
    proposal: ProposalArgument,
    reason: Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; the proposer reads it.", show_default=False)],
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="Who rejects. Default: the account.", show_default=False)] = "",
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Reject a proposal permanently: it cannot be approved or pushed (exit code 1: it cannot be rejected any more)."""
    with open_store(database_url(db, machine)) as store:
        store.proposals.get(proposal)

        from abbe.service.audit.book import login
        from abbe.service.clock import SystemClock
        from abbe.service.compensation.proposal_decisions import reject as work_reject
        from abbe.service.errors import TableRefused
        from abbe.service.queries import tables

        try:
            done = work_reject(store, proposal, name.strip() or login(), reason, SystemClock())
            campaign = tables.proposal(reader(store), proposal).campaign
        except TableRefused as error:
            answer({"proposal": proposal, "rejected": False, "text": str(error)}, f"not rejected: {error}", as_json=as_json)
            conclude(f"abbe comp show {proposal}", machine=machine, db=db, as_json=as_json)
            raise typer.Exit(1) from None
    text = f"proposal {proposal} is rejected by {done.name}: {done.reason}"
    answer({"proposal": proposal, "rejected": True, "text": text}, text, as_json=as_json)
    conclude(f"abbe comp propose {quote(campaign)}", machine=machine, as_json=as_json)


def _promise(found: ProposalSummary) -> str:
    p = found.predicted_rms_um
    if p is None:
        return ""
    gain, expanded = p.before - p.after, 2.0 * p.u_model
    return f"{p.before:.1f} → {p.after:.1f} µm rms over the volume, better by {gain:.1f} ± {expanded:.1f} µm (U, k = 2)"


def _short(found: ProposalSummary) -> str:
    p = found.predicted_rms_um
    return "" if p is None else f"{p.before:.1f} → {p.after:.1f} µm, U {2.0 * p.u_model:.1f}"
