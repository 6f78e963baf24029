"""`abbe solve`: what the runs of a campaign say about the machine, without touching it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table

if TYPE_CHECKING:
    from service.workflows.solve import Solved


def solve(
    campaign: Annotated[str, typer.Argument(help="Campaign in the database; its complete runs with the role identify are used.")],
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve a stored campaign: parameters with uncertainty, and what these runs cannot tell. Nothing is pushed."""
    from service.devices.session import DeviceUrls
    from service.runs.columns import load_run
    from service.site import Site, machine_from_doc
    from service.workflows.solve import solution_doc, solve_runs

    with open_store(database_url(db, machine)) as store:
        record = store.campaign(campaign)
        runs = [load_run(store, r.id) for r in store.runs(record.id) if r.visible_status == "complete"]
        doc = store.machine(record.machine_id).doc
    solved = solve_runs(Site(str(doc["name"]), machine_from_doc(doc), doc, DeviceUrls()), runs)
    if as_json:
        print_json(solution_doc(solved))
        return
    _print(solved)


def _print(solved: Solved) -> None:
    from models.compensation.summary import SCALE_NOTE, mean_linear
    from service.workflows.solve import HELIX_NOTE, STEP_NOTE, not_observable

    rows: list[list[str]] = []
    for p in mean_linear(solved.joint):
        unit, what = ("µm/m", f"mean over the volume, {SCALE_NOTE}") if p.name[0] == "E" else ("µrad", "mean over the volume")
        rows.append([p.name, f"{p.value * 1e6:.2f}", f"{2 * p.u * 1e6:.2f}", unit, what])
    for axis, (v, u) in solved.joint.backlash_mm().items():
        rows.append([f"backlash {axis}", f"{v * 1e3:.2f}", f"{2 * u * 1e3:.2f}", "µm", "lost motion"])
    print_table(["parameter", "value", "U (k = 2)", "unit", "what"], rows)
    for label, helix in solved.helices.items():
        print_table([f"{label}, ten parameters, about this sphere only", "value", "U (k = 2)", "unit"], _helix_rows(helix.estimate))
    if solved.helices:
        typer.echo(HELIX_NOTE)
    for order, figures in solved.step_totals.items():
        print_table([f"step diagonals {order}", "value", "U (k = 2)", "unit"], _step_rows(figures))
    if solved.step_totals:
        typer.echo(STEP_NOTE)
    typer.echo("these runs cannot tell:")
    for text in not_observable(solved.joint):
        typer.echo(f"- {text}")


def _helix_rows(estimate: Any) -> list[list[str]]:
    rows = []
    for name in estimate.names:
        scale, unit = (1e3, "µm") if name.startswith(("offset", "bar", "backlash")) else (1e6, "µm/m" if name[0] == "E" else "µrad")
        rows.append([name, f"{estimate.value(name) * scale:.2f}", f"{2 * estimate.u(name) * scale:.2f}", unit])
    return rows


def _step_rows(figures: dict[str, float]) -> list[list[str]]:
    """The papers' figures; keys end in their unit, ``u_`` + key is the standard uncertainty."""
    rows = []
    for key in (k for k in figures if not k.startswith("u_")):
        name, _, unit = key.rpartition("_")
        rows.append([name.replace("_", " "), f"{figures[key]:.2f}", f"{2 * figures['u_' + key]:.2f}", {"um": "µm", "urad": "µrad"}[unit]])
    return rows
