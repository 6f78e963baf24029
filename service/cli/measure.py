"""`abbe measure`, `abbe correct` and `abbe listen`: measure and correct by hand, on the devices of a machine file.

`abbe measure` also works without a machine: it prints the dry run, draws it, or writes an NC program.
"""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import JsonOption, MachineOption, answer, answer_into, check_endings, conclude, machine_file

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from abbe.service.compensation.correct import Correction
    from abbe.service.compensation.gate import PushContext
    from abbe.service.config import LoadedMachine
    from abbe.service.config_schema import MachineFile
    from abbe.service.devices.session import Session
    from abbe.service.domain.run import Run
    from abbe.service.sequences.control import Control
    from abbe.service.sequences.recipes.campaigns import RecipeSource
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import Site
    from abbe.service.storage.store import Store
import math
from typing import TYPE_CHECKING

from abbe.service.cli.common import print_json, print_table

if TYPE_CHECKING:
    from abbe.service.sequences.check import DryRun
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import Site

AcceptTable = Annotated[
    bool,
    typer.Option("--accept-table", help="I have looked: the table in force, which this database did not push, is right."),
]
WaitOption = Annotated[float, typer.Option(help="How long to wait for a safe machine if an unverified table is active; 0: not at all.")]
CheckOption = Annotated[
    Path | None,
    typer.Option("--check", metavar="FILE.toml", help="Verify with these poses of the artefact, not with diagonals and a helix."),
]
RECIPES = "identification, verification, quick-check"


def measure(  # noqa: PLR0913 - one argument for each option
    recipe: Annotated[
        str, typer.Option(help=f"One of: {RECIPES}; or a recipe FILE.toml (`abbe plan` writes one). Default: quick-check.")
    ] = "",
    helix: Annotated[str, typer.Option(help="Instead of a recipe: one ball-bar helix, X,Y,Z,RADIUS in mm.")] = "",
    name: Annotated[str, typer.Option(help="Name of the campaign in the store; default: name of the recipe and time.")] = "",
    rate_hz: Annotated[int, typer.Option(help="Ball-bar samples per second; must divide 1000.")] = 100,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would move and how long it takes; move nothing.")] = False,
    path: Annotated[bool, typer.Option("--path", help="With --dry-run: every commanded position, as CSV.")] = False,
    picture: Annotated[Path | None, typer.Option(metavar="FILE.html", help="With --dry-run: a page with the paths in three views.")] = None,
    nc: Annotated[str, typer.Option(help="Write an NC program to --out: siemens, fanuc, heidenhain, linuxcnc or iso.")] = "",
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="File for the NC program; without --nc, for the answer.")] = None,
    resume: Annotated[str, typer.Option(help="Resume this interrupted campaign; its recipe is in the store.")] = "",
    untouched: Annotated[bool, typer.Option("--untouched", help="With --resume: the mounted instruments were not touched.")] = False,
    accept_table: AcceptTable = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure a campaign on the machine and store every sample. Ctrl-C stops at a safe place, a second one at once; SIGUSR1 pauses."""
    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.site import site_of

    rehearsal, file = Rehearsal(dry_run, path, picture, nc, out), machine_file(machine)
    instead = rehearsal.check((file, Path(recipe)))
    loaded = load_machine(file)
    site, source = site_of(loaded.machine), _source(recipe, helix, rate_hz)
    if resume:
        source = _begun(loaded, resume, source if recipe or helix else None)
    plan = source.plan(site.machine)

    from abbe.service.sequences.check import dry_run_campaign, paced

    plan = replace(paced(plan, site.max_feed_mm_min), name=resume or name or f"{plan.name} {SystemClock().utc():%Y-%m-%d %H:%M:%S}")
    runs = dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    with answer_into(None if nc else out):
        if instead:
            rehearsal.run(site, plan, runs, as_json=as_json)
        if not nc:
            _warn_before(loaded, site, plan, dry=instead)
        if instead:
            warn_of_open_push(loaded.database_url, site)
            _conclude_rehearsal(source, nc, machine, as_json=as_json)
            return
        _measure(loaded, plan, source, ConsoleOptions(resume=bool(resume), untouched=untouched, accept_table=accept_table), as_json=as_json)


def _conclude_rehearsal(source: RecipeSource, nc: str, machine: Path | None, *, as_json: bool) -> None:
    words = f"--helix {source.helix}" if source.helix else f"--recipe {quote(source.recipe)}"
    conclude(f"abbe {'listen' if nc else 'measure'} {words}", machine=machine, as_json=as_json)


def _measure(loaded: LoadedMachine, plan: CampaignPlan, source: RecipeSource, options: ConsoleOptions, *, as_json: bool) -> None:
    """Measure a plan, judge it if its recipe is a check, and say what comes next."""
    from abbe.service.cli.running import run_job
    from abbe.service.clock import SystemClock
    from abbe.service.sequences.control import Control
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    site, control = site_of(loaded.machine), Control()
    begun_s = SystemClock().monotonic_s()
    with Store.open(loaded.database_url) as store:
        try:
            run_job(_measured(store, site, plan, control, source, options), control)
        except SystemExit:
            conclude(f"abbe measure --resume {quote(plan.name)}", machine=loaded.path, as_json=as_json)
            raise
        doc: dict[str, Any] = {"campaign": plan.name, "runs": len(plan.tests), "check": None}
        lines = [f"measured: campaign {plan.name!r}, {len(plan.tests)} runs"]
        is_check = source.recipe in CHECKS and not source.helix
        if is_check:
            doc["check"], line = _check(store, loaded.machine, plan.name, source.recipe, begun_s)
            lines.append(line)
    answer(doc, *lines, as_json=as_json)
    conclude(f"abbe {'report' if is_check else 'solve'} {quote(plan.name)}", machine=loaded.path, as_json=as_json)


CHECKS = ("quick-check", "verification")
"""Built-in recipes that end with a verdict, as scheduled checks do."""


def _check(store: Store, config: MachineFile, campaign: str, recipe: str, begun_s: float) -> tuple[dict[str, Any], str]:
    """Judge the measured runs and store them as a check that began with its campaign; return the check as JSON object and as one line."""
    from datetime import datetime

    from abbe.service.clock import SystemClock
    from abbe.service.domain.schedule import Schedule
    from abbe.service.errors import MeasurementFault
    from abbe.service.runs.columns import load_run
    from abbe.service.verification.verify import Occasion, check_doc, judged

    record = store.campaigns.find(campaign)
    started = datetime.fromisoformat(record.created_utc)
    try:
        runs = [load_run(store, run.id) for run in store.runs.all(record.id) if run.visible_status == "complete"]
        result = judged(config, runs, campaign, started, SystemClock().monotonic_s() - begun_s)
    except MeasurementFault as fault:
        return {"verdict": "not judged", "text": fault.detail}, f"not judged: {fault.detail}"
    doc = check_doc(Occasion(config.name, Schedule("by hand", "", "UTC", recipe), started), result)
    number = store.verifications.add(record.machine_id, record.id, str(doc["verdict"]), doc)
    return {"number": number} | doc, f"check {number}: {result.verdict}: {result.text}"


def _warn_before(loaded: LoadedMachine, site: Site, plan: CampaignPlan, *, dry: bool) -> None:
    """Warn of an expired certificate and of a timetable that cannot be kept; refuse a plan whose devices are not in the machine file.

    If the machine file has a controller, `abbe.service.campaigns.measure` checks the devices, after rolling back an interrupted push.
    """
    from abbe.service.campaigns.device_checks import check_configured, needed_by
    from abbe.service.clock import SystemClock
    from abbe.service.site import certificates

    needed = needed_by(plan, air=site.watching.air_c is not None)
    if dry or site.urls.cnc is None:
        check_configured(needed, site.urls.named())
    today, probed = SystemClock().utc().date(), {"artefact"} if any(test.artefact for test in plan.tests) else set()
    warnings = certificates(site, today, {*needed.first, *probed})
    if loaded.machine.schedule:
        from abbe.service.campaigns.plausibility import unattended

        warnings += unattended(loaded.machine, site, loaded.path.resolve().parent)
    for line in warnings:
        typer.echo(f"warning: {line}", err=True)


@dataclass(frozen=True, slots=True)
class ConsoleOptions:
    """Options of the person at the console.

    ``resume``: continue a campaign; ``untouched``: the set-up was not touched; ``accept_table``: the unknown table in force is right.
    """

    resume: bool
    untouched: bool
    accept_table: bool


async def _measured(store: Store, site: Site, plan: CampaignPlan, control: Control, source: RecipeSource, options: ConsoleOptions) -> None:
    """Measure a campaign, from the beginning or from where it was interrupted."""
    from abbe.service.campaigns.measure import MeasureOptions
    from abbe.service.campaigns.measure import measure as work
    from abbe.service.campaigns.resume import resume as find
    from abbe.service.cli.running import console_confirm, display

    async def yes(_: str) -> bool:
        return True

    async def ask(text: str) -> bool:
        return await control.unless_stopped(console_confirm(text))  # the first Ctrl-C also ends the question

    confirm = yes if options.untouched else ask
    async with ready_session(store, site, accept_table=options.accept_table) as session:
        found = await find(session, store, site, plan, plan.name, confirm) if options.resume else None
        for line in found.messages if found is not None else ():
            typer.echo(line, err=True)
        with display() as sink:
            await work(session, store, site, plan, progress=sink, options=MeasureOptions(control, confirm, source, found))


def _begun(loaded: LoadedMachine, campaign: str, source: RecipeSource | None) -> RecipeSource:
    """Return the source of a campaign to resume: the given one, else its own from the store."""
    from abbe.service.campaigns.resume import begun_source
    from abbe.service.storage.store import Store

    with Store.open(loaded.database_url) as store:
        store.campaigns.find(campaign)
        return source or begun_source(store, campaign)


def _source(recipe: str, helix: str, rate_hz: int) -> RecipeSource:
    """Return the source of a plan; it includes a recipe file's text, so that a resumed campaign does not need the file."""
    from abbe.service.sequences.recipes.campaigns import RecipeSource
    from abbe.service.sequences.recipes.recipe_file import recipe_source

    text = recipe_source(Path(recipe)) if recipe.endswith(".toml") else None
    return RecipeSource(recipe=recipe or "quick-check", helix=helix, rate_hz=rate_hz, text=text)


def correct(
    campaign: Annotated[str, typer.Argument(help="Identification campaign in the store.")],
    before: Annotated[str, typer.Option(help="Verification campaign measured with the present table; default: it is measured now.")] = "",
    wait_s: WaitOption = 600.0,
    check: CheckOption = None,
    accept_table: AcceptTable = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve a campaign, push nine tables, measure again; roll back to the old table if the machine is not better (exit code 1)."""
    from abbe.service.config import load_machine
    from abbe.service.site import check_certificates, site_of

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)
    check_certificates(site)

    from abbe.service.cli.running import rollback_when_safe, run_job
    from abbe.service.compensation.correct import correct as work_correct
    from abbe.service.compensation.gate import PushContext, check_preconditions
    from abbe.service.compensation.proposals import gather
    from abbe.service.errors import TakenBack
    from abbe.service.storage.store import Store

    poses = checking_poses(site, check)

    hints: list[str] = []

    async def work(store: Store) -> Correction:
        from abbe.service.cli.running import display

        store.campaigns.find(campaign)
        with display() as sink:
            async with ready_session(store, site, accept_table=accept_table) as session:
                context = PushContext(session, store, site, sink, poses=poses)
                control = await check_preconditions(context)
                await gather(session.controller, store, site, campaign)  # a campaign that is refused is refused before anything moves
                hints.append(control.hint)
                runs = await verification_before(context, before)
                async with rollback_when_safe(session, store, site, wait_s):
                    return await work_correct(context, campaign, runs, control)

    with Store.open(loaded.database_url) as store:
        try:
            found = run_job(work(store))
        except TakenBack as error:  # a negative answer, not a fault
            text = "; ".join([error.detail, *getattr(error, "__notes__", [])])
            answer({"kept": False, "push": None, "text": text, "not_for_tables": []}, f"rolled back: {text}", as_json=as_json)
            conclude(f"abbe discover {quote(campaign)}", machine=machine, as_json=as_json)
            raise typer.Exit(1) from None
    say_correction(found, hints, machine, as_json=as_json)


def say_correction(found: Correction, hints: list[str], machine: Path | None, *, as_json: bool) -> None:
    """Say whether a pushed table was kept, and exit with code 1 if it was not."""
    kept = found.decision.keep
    doc = {"kept": kept, "push": found.pushed.push_id, "text": found.decision.text, "not_for_tables": list(found.not_for_tables)}
    lines = [
        ("kept: " if kept else "rolled back: ") + found.decision.text,
        *(f"not in the tables: {text}" for text in found.not_for_tables),
    ]
    answer(doc, *lines, *filter(None, hints), as_json=as_json)
    conclude(f"abbe report push {found.pushed.push_id}", machine=machine, as_json=as_json)
    raise typer.Exit(0 if kept else 1)


def checking_poses(site: Site, check: Path | None) -> CampaignPlan | None:
    """Return the poses of an artefact in a recipe that verify a table in place of diagonals and a helix; None without a recipe."""
    if check is None:
        return None

    from abbe.service.sequences.recipes.artefact import verifying_poses
    from abbe.service.sequences.recipes.recipe_file import read_recipe

    return verifying_poses(site.machine, *read_recipe(check))


async def verification_before(context: PushContext, campaign: str) -> list[Run]:
    """Return the runs of a verification with the present table: those of the named campaign, or, without a name, runs measured now."""
    from abbe.service.campaigns.measure import measure as work_measure
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.proposals import load_runs
    from abbe.service.sequences.check import paced

    store, site = context.store, context.site
    if campaign:
        ids = [r.id for r in store.runs.all(campaign) if r.visible_status == "complete"]
    else:
        plan = paced(context.verification(f"verify-before {SystemClock().utc():%Y-%m-%d %H:%M:%S}"), site.max_feed_mm_min)
        ids = await work_measure(context.session, store, site, plan, progress=context.progress)
    return await load_runs(store, ids)


@asynccontextmanager
async def ready_session(store: Store, site: Site, *, accept_table: bool = False, listening: bool = False) -> AsyncIterator[Session]:
    """Open the machine's devices; roll back an interrupted push first, so that nothing is measured with its table.

    ``accept_table``: the person at the console vouches for a table in force that this database did not push. ``listening``: an operator
    moves the machine.
    """
    from abbe.service.audit.book import by_whom
    from abbe.service.cli.running import person_at_console
    from abbe.service.compensation.recover import recovered_session
    from abbe.service.devices.session import lock_machine

    def report(text: str) -> None:
        typer.echo(text, err=True)

    with lock_machine(site.urls.cnc):
        accept_by = by_whom() if accept_table else ""
        ask = person_at_console()
        async with recovered_session(store, site, ask=ask, accept_by=accept_by, report=report, listening=listening) as session:
            yield session


def warn_of_open_push(url: str, site: Site) -> None:
    """Warn on stderr of unfinished pushes in the push journals, without connecting to the control.

    Pushes into another address that may be the same control are included (`open_pushes`).
    """
    from abbe.service.cli.common import open_store
    from abbe.service.errors import StoreError
    from abbe.service.tables.push_journal import open_pushes

    try:
        store = open_store(url)
    except StoreError:  # no database yet: there is no journal
        return
    with store:
        warnings = open_pushes(store, site.name, site.urls.control)
    for line in warnings:
        typer.echo(f"warning: {line}", err=True)


def listen(
    recipe: Annotated[Path, typer.Option(metavar="FILE.toml", help="The recipe from which the NC program was written; laser tests only.")],
    name: Annotated[str, typer.Option(help="Name of the campaign in the store; default: name of the recipe and time.")] = "",
    accept_table: AcceptTable = False,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Record the laser while the operator runs the NC program of a recipe; each standstill of the program becomes a reading."""
    from abbe.service.sequences.recipes.recipe_file import read_recipe

    title, recipes = read_recipe(recipe)

    from abbe.service.campaigns.listen import listen_campaign
    from abbe.service.cli.running import run_job
    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.sequences.check import paced
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store

    loaded = load_machine(machine_file(machine))
    site = site_of(loaded.machine)
    plan = CampaignPlan(title, tuple(r.plan(site.machine) for r in recipes))
    plan = replace(paced(plan, site.max_feed_mm_min), name=name or f"{title} {SystemClock().utc():%Y-%m-%d %H:%M:%S}")

    async def work(store: Store) -> None:
        async with ready_session(store, site, accept_table=accept_table, listening=True) as session:
            await listen_campaign(session, store, site, plan, lambda text: typer.echo(text, err=as_json))

    with Store.open(loaded.database_url) as store:
        run_job(work(store))
    doc = {"campaign": plan.name, "runs": len(plan.tests)}
    answer(doc, f"measured: campaign {plan.name!r}, {len(plan.tests)} runs", as_json=as_json)
    conclude(f"abbe solve {quote(plan.name)}", machine=machine, as_json=as_json)


HAIR = 1e-6
"""Tolerance, mm: a position this close to a whole number counts as whole."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Replacement of a measurement: a dry run, optionally with all positions or a picture, or an NC program in the dialect ``nc``."""

    dry_run: bool
    path: bool
    picture: Path | None
    nc: str
    out: Path | None

    def check(self, sources: tuple[Path, ...]) -> bool:
        """Return whether anything is requested instead of a measurement.

        Raises
        ------
        ConfigError
            Two options do not go together, or an output file would overwrite an input.
        """
        from abbe.service.errors import ConfigError

        if self.picture is not None and not self.dry_run:
            raise ConfigError("--picture draws a dry run", "add --dry-run")
        check_endings(self.picture)
        if self.path and not self.dry_run:
            raise ConfigError("--path prints the positions of a dry run", "add --dry-run")
        if self.nc and self.out is None:
            raise ConfigError("--nc DIALECT and --out FILE go together", "give both")
        if self.nc and self.dry_run:
            raise ConfigError("--nc and --dry-run do not go together", "give one of them")
        for target in (self.picture, self.out):
            if target is not None and any(target.resolve() == s.resolve() for s in sources):
                raise ConfigError(f"{target} would be overwritten", "give another file name")
        return self.dry_run or bool(self.nc)

    def run(self, site: Site, plan: CampaignPlan, runs: tuple[DryRun, ...], *, as_json: bool) -> None:
        """Print or draw the dry run, or write the NC program."""
        from abbe.service.files import write_page
        from abbe.service.rendering.document_page import write_document
        from abbe.service.report.dry_run_page import dry_run_report
        from abbe.service.sequences.nc.write import nc_program

        if self.nc and self.out is not None:
            made = nc_program(site.name, site.machine, plan, self.nc, site.nc)
            write_page(made.text, self.out)
            if made.warning:
                typer.echo(f"warning: {made.warning}", err=True)
            doc = {"program": str(self.out), "dialect": self.nc, "size": made.size, "warning": made.warning}
            answer(doc, f"NC program: {self.out} ({self.nc}), {made.size}; read it before you run it", as_json=as_json)
            return
        if self.picture is not None:
            write_document(dry_run_report(site.name, site.machine, plan, runs), self.picture)
        if as_json:
            print_json(dry_run_doc(plan, runs, every=self.path))
            return
        print_path(plan) if self.path else print_dry_run(plan.name, runs)
        if self.picture is not None:
            typer.echo(f"picture: {self.picture}")


def dry_run_doc(plan: CampaignPlan, runs: tuple[DryRun, ...], *, every: bool) -> dict[str, Any]:
    """Return the dry run for programs: one object per test; ``every``: include each commanded position, mm."""
    from abbe.service.domain.document import document
    from abbe.service.sequences.check import positions

    tests = [document(run) for run in runs]
    if every:
        for doc, test in zip(tests, plan.tests, strict=True):
            doc["positions_mm"] = [list(map(float, at)) for at in positions(test.steps)]
    return {"campaign": plan.name, "duration_s": sum(run.duration_s for run in runs), "tests": tests}


def print_path(plan: CampaignPlan) -> None:
    """Print every commanded position of the plan, one CSV line each: test, X, Y, Z in mm."""
    from abbe.service.sequences.check import positions

    typer.echo("test,x_mm,y_mm,z_mm")
    for test in plan.tests:
        for x, y, z in positions(test.steps):
            typer.echo(f"{test.label},{x:.5f},{y:.5f},{z:.5f}")


HEADINGS = ("test", "kind", "s", "mm", "X", "Y", "Z", "mm/min", "points")


def print_dry_run(name: str, runs: tuple[DryRun, ...]) -> None:
    """Print one line per test: time, path, extent, largest speed, readings."""
    rows = [
        (r.label, r.test, f"{r.duration_s:.0f}", f"{r.path_mm:.0f}", *_extent(r), f"{r.fastest_mm_min:.0f}", str(r.readings)) for r in runs
    ]
    typer.echo(f"{name}: {sum(r.duration_s for r in runs) / 60:.1f} min of machine time, mounting not counted; X, Y, Z in mm")
    print_table(HEADINGS, rows)


def _extent(run: DryRun) -> tuple[str, ...]:
    """Return lowest and highest position of each axis, rounded outwards to whole mm."""
    return tuple(f"{math.floor(lo + HAIR)}..{math.ceil(hi - HAIR)}" for lo, hi in zip(run.lowest_mm, run.highest_mm, strict=True))
