"""`abbe solve` and `abbe solve-all`: identify a machine's errors from the runs of campaigns, without touching the machine."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    ReportOption,
    WithoutOption,
    answer_into,
    check_endings,
    conclude,
    database_url,
    missing_file,
    named_machine,
    open_store,
    print_json,
    print_table,
)
from abbe.service.cli.results.solve_text import print_solution

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from abbe.models.arrays import F2
    from abbe.service.campaign_data.campaign_folder import Campaign
    from abbe.service.identification.reanalysis import Executor
    from abbe.service.identification.solve_report import Assessment
    from abbe.service.storage.store import Store


STAGES = 10
"""Stages of the progress display; if the solver needs more, the rest share the last one."""


class ModelName(StrEnum):
    """Models that a campaign can be solved for."""

    rigid6 = "rigid6"
    rigid21 = "rigid21"
    auto = "auto"


def solve(  # noqa: PLR0913 - every one of them is an option of the command
    campaign: Annotated[
        str, typer.Argument(help="Campaign in the database, or a folder with campaign.json. Runs with the role identify are used.")
    ],
    model: Annotated[
        ModelName | None,
        typer.Option(
            "--model",
            help="rigid6: three scales and three squareness errors; rigid21: 21 error motions; auto: whichever predicts left-out "
            "set-ups and regions better. Default: rigid21, or rigid6 if the readings are too few.",
            show_default=False,
        ),
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
    report: ReportOption = None,
    tables: Annotated[bool, typer.Option("--tables", help="Also show what each kind of table could reach.")] = False,
    grid: Annotated[
        Path | None, typer.Option("--grid", metavar="FILE.csv", help="Also write the 3-D grid of corrections.", show_default=False)
    ] = None,
    at: Annotated[
        Path | None,
        typer.Option("--at", metavar="POINTS.csv", help="Predict the deviation and U at these points, into --out.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="File for the points of --at; without --at, for the answer.", show_default=False),
    ] = None,
    nodes: Annotated[int, typer.Option("--nodes", min=2, max=33, help="Nodes of the grid on each axis.")] = 9,
    unit_um: Annotated[float, typer.Option("--unit-um", min=1e-6, max=10.0, help="The machine's unit for tables and grid, µm.")] = 0.1,
    trials: Annotated[bool, typer.Option("--monte-carlo", help="Also check the stated uncertainty by trials.")] = False,
    without: WithoutOption = None,
    without_scale: Annotated[
        bool, typer.Option("--without-scale", help="Leave scales that the runs determine poorly out of --grid, --tables and --at.")
    ] = False,
    details: Annotated[bool, typer.Option("--details", help="Also print all parameters, comparisons, noise, and what is missing.")] = False,
) -> None:
    """Solve a campaign: parameters with uncertainty, and those that these runs do not determine. The result is stored; nothing is pushed.

    A folder's result is stored only if --db or -m names a database; tables of this database are then used, too. A run that
    contradicts its description is refused (exit code 2).
    """
    from abbe.service.errors import ConfigError

    check_endings(report)
    if at is not None and out is None:
        raise ConfigError("--at and --out belong together", "give both: --at POINTS.csv --out FILE.csv")
    # A folder and another database may be of another machine: its file has to be named.
    file = machine if db is not None or Path(campaign).is_dir() else named_machine(machine)
    points, target = (None, None) if at is None else (_points(at), out)
    wanted = _SolveRequest(model, tables, grid, nodes, unit_um * 1e-3, trials, points, file, target, without_scale)
    if Path(campaign).is_dir():
        from abbe.service.campaign_data.campaign_folder import from_folder, store_solution

        found = from_folder(Path(campaign))
        chosen = found.without(without or [])
        url = None if db is None and machine is None else database_url(db, machine)
        with ExitStack() as stack:
            known_store = None if url is None or missing_file(url) else stack.enter_context(open_store(url))
            summary, doc = _solved(known_store, chosen, wanted)
            if url is not None:  # a new database only after the solution: a refusal creates none
                store = known_store or stack.enter_context(open_store(url, must_exist=False))
                doc |= store_solution(store, found, doc)
        if report is not None:
            _write_report(None, chosen, summary, doc, machine, report)
    else:
        with stored_campaign(campaign, database_url(db, machine)) as (store, found):
            from abbe.service.campaign_data.campaign_folder import store_solution

            chosen = found.without(without or [])
            summary, doc = _solved(store, chosen, wanted)
            doc |= store_solution(store, found, doc)
            if report is not None:
                _write_report(store, chosen, summary, doc, file, report)
    with answer_into(out if at is None else None):
        if as_json:
            print_json(doc)
            return
        from abbe.service.domain.solution_file import SolutionFile

        print_solution(summary, SolutionFile.read(doc), details=details)
        _name_files({"report": report, "grid": grid, "deviation": target})
    _conclude(campaign, doc, db, machine)


def _points(file: Path) -> F2:
    """Return the points of ``--at``, mm."""
    from abbe.service.runs.points import read_points

    return read_points(file).axes_mm


def _name_files(files: dict[str, Path | None]) -> None:
    for name, file in files.items():
        if file is not None:
            typer.echo(f"{name}: {file}")


def _conclude(campaign: str, doc: dict[str, Any], db: str | None, machine: Path | None) -> None:
    if (doc.get("verdict") or {}).get("word") == "mostly assumption":
        conclude("abbe plan", machine=machine)
    else:
        conclude(f"abbe discover {quote(campaign)}", machine=machine, db=db)


@dataclass(frozen=True)
class _SolveRequest:
    """Options of a call of `abbe solve`."""

    model: ModelName | None
    tables: bool
    grid: Path | None
    nodes: int
    unit_mm: float
    trials: bool
    points_mm: F2 | None
    machine: Path | None
    out: Path | None
    without_scale: bool


@contextmanager
def stored_campaign(name: str, url: str) -> Iterator[tuple[Store, Campaign]]:
    """Yield the store and its campaign of that name. Raises StoreError if there is no such campaign."""
    from abbe.service.errors import StoreError

    with ExitStack() as stack:
        try:
            store = stack.enter_context(open_store(url))
            store.campaigns.find(name)
        except StoreError as exc:
            raise type(exc)(
                f"{name} is neither a folder with campaign.json nor a campaign of the database ({exc.detail})", exc.remedy
            ) from exc
        from abbe.service.campaign_data.campaign_folder import from_store  # numpy and the solver's data: not for a wrong name

        yield store, from_store(store, name)


def _solved(store: Store | None, chosen: Campaign, wanted: _SolveRequest) -> tuple[Assessment, dict[str, Any]]:
    """Solve a campaign after subtracting its known effects; return the assessment of the solution and its document. Progress goes to
    stderr."""
    from abbe.service.cli.running import display
    from abbe.service.config import load_machine
    from abbe.service.domain.progress import Progress
    from abbe.service.identification.removal import campaign_table, remove_effects
    from abbe.service.identification.solve import solve_runs
    from abbe.service.identification.solve_report import as_doc, assess, solution_of

    known = remove_effects(store, chosen, campaign_table(store, chosen))
    campaign = known.campaign
    if wanted.machine is not None:
        campaign = replace(campaign, site=replace(campaign.site, materials=load_machine(wanted.machine).machine.material.by_axis()))
    with display() as sink:
        stages = iter(range(1, STAGES))

        def report_stage(text: str) -> None:
            sink(Progress("solve", float(next(stages, STAGES - 1)), float(STAGES), None, text))

        solved = solve_runs(
            campaign.site,
            campaign.runs,
            model=None if wanted.model is None else wanted.model.value,
            instruments=campaign.doc.get("instruments"),
            progress=report_stage,
        )
        report_stage("errors that these runs do not determine, and the uncertainty in the volume")
        summary = assess(solved, unknown_table=bool(known.not_removed))
        solution = solution_of(summary).model_copy(update=_more(summary, wanted, report_stage))
        doc = {"campaign": campaign.name, "machine": campaign.site.doc} | as_doc(solution) | known.doc
        sink(Progress("solve", float(STAGES), float(STAGES), 0.0, "done"))
    return summary, doc


def _more(summary: Assessment, wanted: _SolveRequest, report_stage: Callable[[str], None]) -> dict[str, Any]:
    """Return the results that take longer, as requested. The grid is written here: if it is refused, nothing is stored."""
    out: dict[str, Any] = {}
    if not (wanted.tables or wanted.grid or wanted.trials or wanted.out):
        return out
    from abbe.service.files import write_page
    from abbe.service.identification.solve_tables import deviation_text, grid_text, machine_grid, monte_carlo, scale_free, table_rows

    whole, summary = summary, scale_free(summary) if wanted.without_scale else summary

    if wanted.grid is not None:
        report_stage(f"grid of {wanted.nodes} x {wanted.nodes} x {wanted.nodes} nodes")
        write_page(grid_text(machine_grid(summary, wanted.nodes, wanted.unit_mm)), wanted.grid)
    if wanted.out is not None and wanted.points_mm is not None:
        write_page(deviation_text(summary, wanted.points_mm), wanted.out)
    if wanted.tables:
        report_stage("what each kind of table could reach")
        out["tables"] = table_rows(summary, wanted.unit_mm)
    if wanted.trials:
        out["monte_carlo"] = monte_carlo(whole, report_stage)
    return out


def _write_report(
    store: Store | None, campaign: Campaign, summary: Assessment, doc: dict[str, Any], machine: Path | None, target: Path
) -> None:
    from abbe.service.clock import SystemClock
    from abbe.service.config import load_machine
    from abbe.service.domain.solution_file import SolutionFile
    from abbe.service.rendering.document_page import write_document
    from abbe.service.report.report import solution_report
    from abbe.service.report.report_measured import SolutionResult
    from abbe.service.site import rules_of

    solution = SolutionFile.read(doc)
    rules = rules_of(None if machine is None else load_machine(machine).machine)
    made = SystemClock().utc().isoformat(timespec="seconds")
    write_document(solution_report(store, campaign, SolutionResult(solution, solution.solution_id, summary), made, rules), target)


def solve_all(  # noqa: PLR0913 - every one of them is an option of the command
    pattern: Annotated[str, typer.Argument(metavar="PATTERN", help="Campaigns by name, e.g. 'june-*'.")] = "*",
    model: Annotated[ModelName, typer.Option("--model", help="As for abbe solve.")] = ModelName.rigid21,
    workers: Annotated[int, typer.Option("--workers", min=1, max=256, help="Number of processes on this computer.")] = 1,
    dask: Annotated[
        str | None, typer.Option("--dask", metavar="ADDRESS", help="Use this scheduler of a Dask cluster instead.", show_default=False)
    ] = None,
    store_solutions: Annotated[bool, typer.Option("--keep", help="Store each solution.")] = False,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve many campaigns of a database again, each as abbe solve does with this model; exit code 1 if one was refused."""
    from abbe.service.errors import NotStored

    url = database_url(db, machine)
    with open_store(url) as store:
        if not store.campaigns.matching(pattern):
            raise NotStored(f"no campaign matches {pattern!r} in {store.url}", "`abbe runs` lists what there is")

        from abbe.service.identification.reanalysis import HEADINGS, row, tasks_of
        from abbe.service.identification.reanalysis import solve_all as run

        tasks = tasks_of(store, url, pattern, model.value)
        answers = list(run(tasks, _executor(workers, dask), store if store_solutions else None))
    if as_json:
        print_json([answer.doc or {"campaign": answer.campaign, "refused": answer.refused} for answer in answers])
    else:
        print_table(HEADINGS, [row(answer) for answer in answers])
        refused = [answer.campaign for answer in answers if answer.doc is None]
        then = f"abbe solve {quote(refused[0])}" if refused else "abbe runs"
        conclude(then, machine=machine, db=db, verdict=f"{len(answers)} campaigns, {len(refused)} refused")
    raise typer.Exit(1 if any(answer.doc is None for answer in answers) else 0)


def _executor(workers: int, dask: str | None) -> Executor:
    from abbe.service.errors import ConfigError
    from abbe.service.identification.reanalysis import DaskExecutor, ProcessExecutor, SerialExecutor

    if dask is None:
        return SerialExecutor() if workers == 1 else ProcessExecutor(workers)
    if workers != 1:
        raise ConfigError("--workers and --dask exclude each other", "give one of them")
    return DaskExecutor(dask)
