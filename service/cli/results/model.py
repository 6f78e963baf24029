"""`abbe model`: the model book of a machine - list, show, compare, go back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, database_url, open_store, print_json, print_table

if TYPE_CHECKING:
    from abbe.service.domain.results import ModelRecord

model = typer.Typer(
    help="The model book of a machine: versions with their effects, where each came from, and the way back.", no_args_is_help=True
)

Machine = Annotated[str, typer.Argument(metavar="MACHINE", help="Name of the machine.", show_default=False)]


@model.command("list")
def list_models(
    machine: Annotated[str | None, typer.Argument(metavar="MACHINE", help="Only this machine's.", show_default=False)] = None,
    db: DbOption = None,
    machine_file: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the versions of models, oldest first; the last one of a machine is its current one."""
    with open_store(database_url(db, machine_file)) as store:
        found = store.models(machine)
    if as_json:
        print_json([_doc(m) for m in found])
        return
    rows = [(m.machine, str(m.version), m.created_utc[:19], ", ".join(e["label"] for e in m.doc["effects"]), m.doc["why"]) for m in found]
    print_table(("machine", "version", "made (UTC)", "effects", "why"), rows)


@model.command("show")
def show_model(
    machine: Machine,
    version: Annotated[int | None, typer.Argument(metavar="VERSION", help="Default: the current one.", show_default=False)] = None,
    db: DbOption = None,
    machine_file: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one version: its effects with their size, what takes them out, and the runs they came from."""
    from abbe.service.discovery.discovery_words import size_text
    from abbe.service.effects.model_book import REMEDIES, name_of

    with open_store(database_url(db, machine_file)) as store:
        found = _version(store, machine, version)
    if as_json:
        print_json(_doc(found))
        return
    typer.echo(f"machine {machine}, model version {found.version}: {found.doc['why']}")
    rows = [(name_of(e), size_text(e), f"{REMEDIES[e['remedy']]}: {e['remedy_text']}", e["from"]["campaign"]) for e in found.doc["effects"]]
    print_table(("effect", "size, U (k = 2)", "taken out by", "from campaign"), rows)
    if found.doc["gone"]:
        typer.echo("no longer there: " + ", ".join(found.doc["gone"]))
    source = found.doc["provenance"]
    typer.echo(f"{len(source['runs'])} runs of campaign {source['campaign']}, Abbe {source['versions']['abbe']}")


@model.command("diff")
def diff_models(
    machine: Machine,
    first: Annotated[int, typer.Argument(metavar="FIRST", help="Version.", show_default=False)],
    second: Annotated[int | None, typer.Argument(metavar="SECOND", help="Default: the current one.", show_default=False)] = None,
    db: DbOption = None,
    machine_file: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what one version has more, less or of another size than another."""
    from abbe.service.discovery.discovery_words import unit
    from abbe.service.effects.effect_catalogue import catalogue
    from abbe.service.effects.model_book import differences, version
    from abbe.service.rendering.numbers import with_uncertainty

    with open_store(database_url(db, machine_file)) as store:
        a, b = version(store, machine, first), _version(store, machine, second)
    found = differences(a, b, catalogue())
    if as_json:
        print_json({"machine": machine, "first": a.version, "second": b.version, "differences": found})
        return
    if not found:
        typer.echo(f"versions {a.version} and {b.version} hold the same effects")
        return

    def cell(value: dict[str, float] | None) -> str:
        return "-" if value is None else "{} ± {}".format(*with_uncertainty(value["strength"], value["u"]))

    rows = [(d["label"], d["what"], cell(d["before"]), cell(d["after"]), unit(d["unit"])) for d in found]
    print_table(("effect", "", f"version {a.version}", f"version {b.version}", "unit"), rows)


@model.command("revert")
def revert_model(
    machine: Machine,
    version: Annotated[int, typer.Argument(metavar="VERSION", help="Make this version the current one.", show_default=False)],
    db: DbOption = None,
    machine_file: MachineOption = None,
) -> None:
    """Make an older version current again. Nothing is deleted: it is appended as a new version."""
    from abbe.service.effects.model_book import revert

    with open_store(database_url(db, machine_file)) as store:
        number = revert(store, machine, version)
    typer.echo(f"machine {machine}: version {number} is version {version} again")


def _version(store: Any, machine: str, number: int | None) -> ModelRecord:
    """A version, or the current one."""
    from abbe.service.effects.model_book import current, version

    newest = current(store, machine)
    return version(store, machine, number if number is not None else (newest.version if newest is not None else 0))


def _doc(found: ModelRecord) -> dict[str, Any]:
    return {"machine": found.machine, "version": found.version, "created_utc": found.created_utc} | found.doc
