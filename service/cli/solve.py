"""`abbe solve`: what the runs of a campaign say about the machine, without touching it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table

if TYPE_CHECKING:
    from service.workflows.campaign_folder import Campaign
    from service.workflows.solve_report import Account


STAGES = 10
"""Stages of a solution that the display counts; the last ones share one if the solver needs more rounds."""


class ModelName(StrEnum):
    """Models that a campaign can be solved for."""

    rigid6 = "rigid6"
    rigid21 = "rigid21"
    auto = "auto"


def solve(
    campaign: Annotated[
        str, typer.Argument(help="Campaign in the database, or a folder with campaign.json. Runs with the role identify are used.")
    ],
    model: Annotated[
        ModelName, typer.Option("--model", help="Three scales and three squareness; 21 error motions; or what held-out runs ask for.")
    ] = ModelName.rigid21,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
    report: Annotated[Path | None, typer.Option("--report", metavar="FILE.html", help="Also write a report.", show_default=False)] = None,
    without: Annotated[list[str] | None, typer.Option("--without", metavar="RUN", help="Leave a run out; may be repeated.")] = None,
) -> None:
    """Solve a campaign: parameters with uncertainty, and what these runs cannot tell. The result is stored; nothing is pushed.

    A folder's result is stored only if --db or --machine names a database. A run that cannot be what it says is refused (exit code 2).
    """
    from service.workflows.campaign_folder import from_folder, from_store, is_folder, keep

    if is_folder(campaign):
        found = from_folder(Path(campaign))
        told, doc = _solved(found.without(without or []), model)
        if db is not None or machine is not None:
            with open_store(database_url(db, machine), must_exist=False) as store:  # after the solution: what is refused leaves no database
                doc |= keep(store, found, doc)
    else:
        with open_store(database_url(db, machine)) as store:
            found = from_store(store, campaign)
            told, doc = _solved(found.without(without or []), model)
            doc |= keep(store, found, doc)
    if report is not None:
        _write_report(told, doc, found, report)
    if as_json:
        print_json(doc)
        return
    _print(told, doc)
    if report is not None:
        typer.echo(f"report: {report}")


def _solved(campaign: Campaign, model: ModelName) -> tuple[Account, dict[str, Any]]:
    """The solution and its document, with progress on stderr."""
    from service.cli.progress import display
    from service.events import Progress
    from service.workflows.solve import solve_runs
    from service.workflows.solve_report import account, solution_doc

    with display() as sink:
        stages = iter(range(1, STAGES))

        def say(text: str) -> None:
            sink(Progress("solve", float(next(stages, STAGES - 1)), float(STAGES), None, text))

        solved = solve_runs(campaign.site, campaign.runs, model=model.value, say=say)
        say("what these runs cannot tell, and how well the volume is known")
        told = account(solved)
        sink(Progress("solve", float(STAGES), float(STAGES), 0.0, "done"))
    return told, {"campaign": campaign.name, "machine": campaign.site.doc} | solution_doc(told)


def _write_report(told: Account, doc: dict[str, Any], campaign: Campaign, target: Path) -> None:
    from service.clock import SystemClock
    from service.report.page_file import write_page
    from service.report.solution_page import render_solution
    from service.workflows.solve_pages import solution_page

    made = SystemClock().utc().isoformat(timespec="seconds")
    write_page(render_solution(solution_page(told, doc, campaign.site, made)), target)


def _print(told: Account, doc: dict[str, Any]) -> None:
    from service.workflows.solve_report import noise_lines, outlier_lines, residual_lines, worst_line

    typer.echo(f"campaign {doc['campaign']}: model {doc['model']}, {len(doc['runs'])} runs")
    _lines("look at these runs:", doc["flags"])
    _parameters(told)
    _comparison(told)
    o = told.observability
    typer.echo(o.number.text)
    typer.echo(f"The readings show {o.rank} of {len(o.terms)} coefficients, {o.seen.effective_rank} of them well.")
    typer.echo(worst_line(told))
    _lines("noise found:", noise_lines(told.joint))
    _lines("outliers:", outlier_lines(told.joint))
    _lines("residuals that are not noise:", residual_lines(told.joint))
    _lines("these runs cannot tell:", doc["not_observable"])
    _lines("what would show more:", doc["advice"])
    if "solution_id" in doc:
        again = ", the same readings and model as solution " + ", ".join(map(str, doc["same_as"])) if doc["same_as"] else ""
        typer.echo(f"stored: solution {doc['solution_id']}{again}")


def _lines(heading: str, lines: list[str]) -> None:
    typer.echo(heading if lines else f"{heading} none")
    for text in lines:
        typer.echo(f"- {text}")


def _parameters(told: Account) -> None:
    from models.compensation.summary import SCALE_NOTE

    status = {m.name: m.status for m in told.observability.motions}
    rows: list[list[str]] = []
    for p in told.mean:
        unit, what = ("µm/m", f"mean over the volume, {SCALE_NOTE}") if p.name[0] == "E" else ("µrad", "mean over the volume")
        rows.append([p.name, f"{p.value * 1e6:.2f}", f"{2 * p.u * 1e6:.2f}", unit, what])
    for axis, (v, u) in told.joint.backlash_mm().items():
        rows.append([f"backlash {axis}", f"{v * 1e3:.2f}", f"{2 * u * 1e3:.2f}", "µm", "lost motion"])
    print_table(["parameter", "value", "U (k = 2)", "unit", "what"], rows)
    words = {s: ", ".join(n for n, v in status.items() if v == s) or "none" for s in ("observed", "weak", "not observable")}
    typer.echo("error motions, each for itself: " + "; ".join(f"{s}: {names}" for s, names in words.items()))


def _comparison(told: Account) -> None:
    from service.workflows.solve import HELIX_NOTE, STEP_NOTE

    solved = told.solved
    if solved.helices:
        names = next(iter(solved.helices.values())).estimate.names
        headings = ["ten parameters, about this sphere only (± U, k = 2)", *(f"{n} ({_helix_unit(n)[1]})" for n in names)]
        print_table(headings, [[label, *_helix_row(h.estimate)] for label, h in solved.helices.items()])
        typer.echo(HELIX_NOTE)
    for order, figures in solved.step_totals.items():
        print_table([f"step diagonals {order}", "value", "U (k = 2)", "unit"], _step_rows(figures))
    if solved.step_totals:
        typer.echo(STEP_NOTE)


def _helix_unit(name: str) -> tuple[float, str]:
    return (1e3, "µm") if name.startswith(("offset", "bar", "backlash")) else (1e6, "µm/m" if name[0] == "E" else "µrad")


def _helix_row(estimate: Any) -> list[str]:
    scales = {n: _helix_unit(n)[0] for n in estimate.names}
    return [f"{estimate.value(n) * f:.1f} ± {2 * estimate.u(n) * f:.1f}" for n, f in scales.items()]


def _step_rows(figures: dict[str, float]) -> list[list[str]]:
    """The papers' figures; keys end in their unit, ``u_`` + key is the standard uncertainty."""
    rows = []
    for key in (k for k in figures if not k.startswith("u_")):
        name, _, unit = key.rpartition("_")
        rows.append([name.replace("_", " "), f"{figures[key]:.2f}", f"{2 * figures['u_' + key]:.2f}", {"um": "µm", "urad": "µrad"}[unit]])
    return rows
