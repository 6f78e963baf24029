"""`abbe model`: the model book of a machine - list, show, compare, revert; `abbe effects`: the catalogue of effects."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    answer,
    conclude,
    database_url,
    named_machine,
    open_store,
    print_json,
    print_table,
)

if TYPE_CHECKING:
    from abbe.service.domain.model_book import ModelVersion
    from abbe.service.effects.effect_sums import LabelSize
    from abbe.service.storage.store import Store


model = typer.Typer(
    help="The model book of a machine: versions with their effects, where each came from, and how to revert.", no_args_is_help=True
)

OfOption = Annotated[
    str | None,
    typer.Option(
        "--of", metavar="NAME", help="Name of the machine. Default: the machine file's, else the database's only one.", show_default=False
    ),
]


@model.command("list")
def list_models(
    of: Annotated[str | None, typer.Option("--of", metavar="NAME", help="Only the versions of this machine.", show_default=False)] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the versions of models, oldest first; the last version of a machine is its current one."""
    from abbe.service.effects.model_book import versions

    with open_store(database_url(db, machine)) as store:
        found = versions(store, of)
    if as_json:
        print_json([_doc(m) for m in found])
        return
    rows = [(m.machine, str(m.version), m.created_utc[:19], ", ".join(e.label for e in m.book.effects), m.book.why) for m in found]
    print_table(("machine", "version", "made (UTC)", "effects", "why"), rows)
    then = f"abbe model show --of {quote(found[-1].machine)}" if found else "abbe runs"
    conclude(then, machine=machine, db=db, verdict=f"{len(found)} versions")


@model.command("show")
def show_model(
    version: Annotated[
        int | None, typer.Argument(metavar="VERSION", help="Number of a version. Default: the current one.", show_default=False)
    ] = None,
    of: OfOption = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show one version: its effects with their size, their remedy, and the runs they came from."""
    with open_store(database_url(db, machine)) as store:
        found = _version(store, _name(store, of, db, machine), version)
    if as_json:
        print_json(_doc(found))
        return

    from abbe.service.discovery.discovery_text import size_text
    from abbe.service.effects.model_book import REMEDIES

    typer.echo(f"machine {found.machine}, model version {found.version}: {found.book.why}")
    rows = [(e.full_title, size_text(e), f"{REMEDIES[e.remedy]}: {e.remedy_text}", e.origin.campaign) for e in found.book.effects]
    print_table(("effect", "size, U (k = 2)", "remedy", "from campaign"), rows)
    if found.book.gone:
        typer.echo("removed: " + ", ".join(found.book.gone))
    source = found.book.provenance
    if source is not None:
        typer.echo(f"{len(source.runs)} runs of campaign {source.campaign}, Abbe {source.versions.get('abbe', '?')}")
    then = f"abbe model diff {found.version - 1} {found.version}" if found.version > 1 else "abbe model list"
    conclude(f"{then} --of {quote(found.machine)}", machine=machine, db=db)


@model.command("diff")
def diff_models(
    first: Annotated[int, typer.Argument(metavar="FIRST", help="Number of a version.", show_default=False)],
    second: Annotated[
        int | None, typer.Argument(metavar="SECOND", help="Number of a version. Default: the current one.", show_default=False)
    ] = None,
    of: OfOption = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the effects that were added, removed or resized between two versions."""
    from abbe.service.effects.model_book import differences, version

    with open_store(database_url(db, machine)) as store:
        name = _name(store, of, db, machine)
        a, b = version(store, name, first), _version(store, name, second)

    from abbe.service.discovery.effect_pages import unit
    from abbe.service.effects.effect_catalogue import catalogue
    from abbe.service.rendering.numbers import with_uncertainty

    found = differences(a, b, catalogue())
    if as_json:
        rows = [{"label": d.label, "what": d.what, "unit": d.unit, "before": _size(d.before), "after": _size(d.after)} for d in found]
        print_json({"machine": name, "first": a.version, "second": b.version, "differences": rows})
        return
    conclude_with = partial(conclude, f"abbe model show --of {quote(name)}", machine=machine, db=db)
    if not found:
        typer.echo(f"versions {a.version} and {b.version} hold the same effects")
        conclude_with()
        return

    def cell(size: LabelSize | None) -> str:
        return "-" if size is None else "{} ± {}".format(*with_uncertainty(size.strength, size.u))

    cells = [(d.label, d.what, cell(d.before), cell(d.after), unit(d.unit)) for d in found]
    print_table(("effect", "", f"version {a.version}", f"version {b.version}", "unit"), cells)
    conclude_with(verdict=f"{len(found)} effects differ")


@model.command("revert")
def revert_model(
    version: Annotated[int, typer.Argument(metavar="VERSION", help="Make this version the current one.", show_default=False)],
    of: OfOption = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make an older version current again. Nothing is deleted: a new version is appended."""
    from abbe.service.effects.model_book import revert

    with open_store(database_url(db, machine)) as store:
        name = _name(store, of, db, machine)
        number = revert(store, name, version)
    text = f"machine {name}: version {number} is current; it equals version {version}"
    answer({"machine": name, "version": number, "equals": version}, text, as_json=as_json)
    conclude(f"abbe model show --of {quote(name)}", machine=machine, db=db, as_json=as_json)


def _size(size: LabelSize | None) -> dict[str, float] | None:
    return None if size is None else {"strength": size.strength, "u": size.u}


def _name(store: Store, of: str | None, db: str | None, machine: Path | None) -> str:
    """Return the name of the machine: ``--of``, else the machine file's, else the only one in the database."""
    from abbe.service.config import load_machine
    from abbe.service.errors import ConfigError

    if of is not None:
        return of
    if db is None and (file := named_machine(machine)) is not None:
        return load_machine(file).machine.name
    names = [one.name for one in store.machines.all()]
    if len(names) != 1:
        raise ConfigError(f"which machine? {store.url} holds {', '.join(names) or 'none'}", "add --of NAME")
    return names[0]


def _version(store: Store, machine: str, number: int | None) -> ModelVersion:
    """Return a version, or the current one."""
    from abbe.service.effects.model_book import current, version

    newest = current(store, machine)
    return version(store, machine, number if number is not None else (newest.version if newest is not None else 0))


def _doc(found: ModelVersion) -> dict[str, Any]:
    from abbe.service.domain.document import document

    return {"machine": found.machine, "version": found.version, "created_utc": found.created_utc} | document(found.book)


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Name of an effect; without it all are listed.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show the catalogue of physical effects: how each looks, what shows it, how large it usually is, what to do about it."""
    from abbe.service.discovery.effect_pages import HEADINGS, effect_doc, effect_lines, effect_row
    from abbe.service.effects.axis_test import SLOW_DRIFT
    from abbe.service.effects.effect_catalogue import catalogue, effect_named, plugins

    for broken in plugins().broken:
        typer.echo(f"{broken.code}: {broken}", err=True)
    if name is None:
        found = (*catalogue(), SLOW_DRIFT)
        if as_json:
            print_json([effect_doc(e) for e in found])
            return
        print_table(HEADINGS, [effect_row(e) for e in found])
        conclude(f"abbe effects {found[0].name}", verdict=f"{len(found)} effects")
        return
    effect = effect_named(name)
    if as_json:
        print_json(effect_doc(effect))
        return
    print_table((effect.name, ""), effect_lines(effect))
    conclude("abbe runs")
