"""`abbe discover`: find, size and prove the effects that the model of a machine lacks; nothing is written to the machine."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
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
    conclude,
    database_url,
    named_machine,
    open_store,
    print_json,
)
from abbe.service.cli.measure import AcceptTable
from abbe.service.cli.results.solve import stored_campaign

if TYPE_CHECKING:
    from collections.abc import Iterator

    from abbe.service.campaign_data.campaign_folder import Campaign
    from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal
    from abbe.service.discovery.discover_live import LiveAddition
    from abbe.service.domain.finding import Finding
    from abbe.service.site import Site
    from abbe.service.storage.store import Store


def discover(  # noqa: PLR0913 - one argument for each option
    campaign: CampaignArgument,
    report: ReportOption = None,
    db: DbOption = None,
    machine: MachineOption = None,
    without: WithoutOption = None,
    live: Annotated[bool, typer.Option("--live", help="Measure what is proposed on the machine, and continue.")] = False,
    accept_table: AcceptTable = False,
    as_json: JsonOption = False,
) -> None:
    """Find where measurement and simulation disagree, and name the missing effect: its size, the remedy, alternatives, the next experiment.

    Runs with the role identify are fitted, runs with the role holdout only judge the fit, and sealed runs are predicted. A folder's
    result is stored only if --db or -m names a database. After Ctrl-C the same command resumes. Two kinds of runs need no search: runs at
    standstill with temperatures show the thermal response (ISO 230-3), and points of artefacts show which errors move with the part and
    which belong to the machine. Neither result is stored.
    """
    check_endings(report)
    if live:
        machine = _checked_live(campaign, machine)
    with opened(campaign, db, machine, without or []) as (found, store):
        from abbe.service.clock import SystemClock
        from abbe.service.discovery.discovery_answer import answer_doc
        from abbe.service.rendering.document_page import write_document
        from abbe.service.report.report_discovery import found_report

        if _without_search(found, plain=report is None and not live, as_json=as_json):
            conclude(f"abbe {'report' if found.folder is None else 'import'} {quote(campaign)}", machine=machine, db=db, as_json=as_json)
            return
        job, journal = _started(found, store)
        finding = _searched(job, journal)
        if live and store is not None and machine is not None:
            job, journal, finding = _run_live(store, machine, (job, journal, finding), accept_table=accept_table)
        if report is not None:
            made = SystemClock().utc().isoformat(timespec="seconds")
            write_document(found_report(job, journal, finding, made), report)
    if as_json:
        print_json(answer_doc(finding))
        return
    _print(job, journal, finding)
    if report is not None:
        typer.echo(f"report: {report}")
    more = finding.next_test is not None and store is not None
    then = f"abbe discover {quote(campaign)} --live" if more else f"abbe solve {quote(campaign)}"
    conclude(then, machine=machine, db=None if more else db)


def _without_search(campaign: Campaign, *, plain: bool, as_json: bool) -> bool:
    """Print the thermal response of runs at standstill, or the errors that move with an artefact; False if the runs are of another kind."""
    from abbe.service.cli.common import answer
    from abbe.service.discovery import artefact_finding, standstill
    from abbe.service.errors import ConfigError

    thermal = standstill.at_standstill(campaign.runs)
    if not thermal and not artefact_finding.only_artefacts(campaign):
        return False
    if not plain:
        what = "runs at standstill" if thermal else "points of artefacts"
        raise ConfigError(f"--report and --live are not for {what}", "leave them out; --json gives all figures")
    if thermal:
        response = standstill.standstill_answer(campaign.name, campaign.runs)
        answer(standstill.answer_doc(response), *standstill.lines_of(response), as_json=as_json)
    else:
        found = artefact_finding.artefact_finding(campaign)
        answer(artefact_finding.answer_doc(found), *artefact_finding.lines_of(found), as_json=as_json)
    return True


@contextmanager
def opened(campaign: str, db: str | None, machine: Path | None, without: list[str]) -> Iterator[tuple[Campaign, Store | None]]:
    """Yield a campaign and its store; the store is None for a folder if no database is named."""
    if Path(campaign).is_dir():
        from abbe.service.campaign_data.campaign_folder import from_folder

        found = from_folder(Path(campaign)).without(without)
        with ExitStack() as stack:
            named = db is not None or machine is not None
            yield found, stack.enter_context(open_store(database_url(db, machine), must_exist=False)) if named else None
    else:
        with stored_campaign(campaign, database_url(db, machine)) as (store, found):
            yield found.without(without), store


def _started(campaign: Campaign, store: Store | None) -> tuple[DiscoveryJob, DiscoveryJournal]:
    """Return the job and its journal."""
    from abbe.service.discovery.changed_since import reference_solution
    from abbe.service.discovery.discover import DiscoveryJournal, prepare
    from abbe.service.discovery.discovery_store import journal_of
    from abbe.service.effects.effect_catalogue import catalogue
    from abbe.service.effects.model_book import current
    from abbe.service.identification.removal import campaign_table

    base = None if store is None else current(store, campaign.site.name)
    since = None if store is None else reference_solution(store, campaign)
    job = prepare(campaign, catalogue(), base, table=campaign_table(store, campaign), since=since)
    return job, DiscoveryJournal() if store is None else journal_of(store, job)


def _checked_live(campaign: str, machine: Path | None) -> Path:
    """Return the machine file for --live; refuse, before anything is read, if there is none or the campaign is in a folder."""
    from abbe.service.errors import ConfigError

    if (found := named_machine(machine)) is None:
        raise ConfigError("--live needs the machine", "give -m FILE")
    if Path(campaign).is_dir():
        raise ConfigError("--live needs a campaign of the store, not a folder", "measure it with `abbe measure`")
    return found


def _run_live(
    store: Store, machine: Path, at: tuple[DiscoveryJob, DiscoveryJournal, Finding], *, accept_table: bool = False
) -> tuple[DiscoveryJob, DiscoveryJournal, Finding]:
    """Measure the proposed test and search again, until no test is proposed, a person must act, or `ROUNDS` rounds are done."""
    from dataclasses import replace
    from datetime import timedelta

    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.discovery.discover_live import ROUNDS, addition_count, find_addition, next_search
    from abbe.service.discovery.discovery_store import StoredJournal
    from abbe.service.discovery.experiment_recipes import next_plan
    from abbe.service.site import site_of

    site = site_of(load_machine(machine).machine)
    job, journal, finding = at
    for _ in range(ROUNDS):
        if finding.next_test is None or not isinstance(journal, StoredJournal):
            break
        _print(job, journal, finding)
        number = addition_count(store, job.campaign.name) + 1
        name = (f"next{number} {SystemClock().utc():%Y-%m-%d %H:%M:%S}", f"n{number}")
        test = finding.next_test
        about = replace(finding.location, runs=(test.like,)) if finding.verdict == "unknown" and test.like else None
        wanted = next_plan(test.adds, site.machine, job.campaign.runs, name=name, max_feed_mm_min=site.max_feed_mm_min, about=about)
        if wanted.plan is None:
            typer.echo(f"measure by hand: Abbe cannot run {', '.join(wanted.by_hand)} on this machine")
            break
        addition = find_addition(store, job.campaign, wanted.plan, wanted.after_s)
        wait_s = _measured(store, site, job.campaign, addition, accept_table=accept_table)
        accept_table = accept_table and addition.remaining is None  # the person has accepted the present table, not a later one
        if wait_s > 0.0:
            start = SystemClock().utc() + timedelta(seconds=wait_s + 1.0)
            what_for = ", ".join(test.adds)
            typer.echo(f"too early for {what_for}: give the same command at {start:%H:%M:%S} UTC or later; nothing has moved")
            break
        job, journal = next_search(store, job, journal, addition.plan.name)
        finding = _searched(job, journal)
    return job, journal, finding


def _measured(store: Store, site: Site, campaign: Campaign, addition: LiveAddition, *, accept_table: bool) -> float:
    """Measure the missing runs of an addition to a campaign. Return the seconds to wait if it is too early to measure, else 0."""
    from abbe.service.cli.measure import ready_session
    from abbe.service.cli.running import display, run_job
    from abbe.service.discovery.discover_live import measure_added

    if addition.begun is not None:
        done = len(addition.plan.tests) - (0 if addition.remaining is None else len(addition.remaining.tests))
        typer.echo(f"resuming campaign {addition.plan.name!r}: {done} of {len(addition.plan.tests)} runs are measured")
    if addition.remaining is None:
        return 0.0

    async def work() -> float:
        with display() as sink:
            async with ready_session(store, site, accept_table=accept_table) as session:
                return await measure_added(session, store, site, campaign, addition, sink)

    try:
        return run_job(work())
    except SystemExit:
        typer.echo("stopped: completed runs are kept; the same command resumes there", err=True)
        raise


def _searched(job: DiscoveryJob, journal: DiscoveryJournal) -> Finding:
    """Return the finding, with progress on stderr; Ctrl-C reports what is kept."""
    from abbe.service.cli.running import display
    from abbe.service.discovery.discover import discover as work
    from abbe.service.discovery.discover import search

    with display() as sink:
        try:
            return work(job, journal, search, sink)
        except KeyboardInterrupt:
            state = journal.steps[-1].state if journal.steps else "nothing"
            kept = (
                f"discovery {journal.id} is in state {state}; the same command resumes there"
                if journal.id
                else "nothing is kept: the discovery of a folder is stored only with --db or -m"
            )
            typer.echo(f"stopped: {kept}", err=True)
            raise


def _print(job: DiscoveryJob, journal: DiscoveryJournal, finding: Finding) -> None:
    from abbe.service.discovery.discovery_text import lines_of

    typer.echo(f"campaign {job.campaign.name}: {len(finding.runs)} runs, {len(job.effects)} effects in the catalogue")
    for line in job.flags:
        typer.echo(f"look at this: {line}")
    for line in lines_of(finding):
        typer.echo(line)
    if journal.id is not None:
        brought = f", model version {journal.version} of {job.campaign.site.name}" if journal.version else ""
        typer.echo(f"stored: discovery {journal.id}, {journal.steps[-1].state}{brought}")
