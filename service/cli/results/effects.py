"""`abbe effects`: the catalogue of known effects, and one effect's page."""

from __future__ import annotations

from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json, print_table


def effects(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="One effect; without it all are listed.", show_default=False)] = None,
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
        typer.echo("one effect's page: abbe effects NAME")
        return
    effect = effect_named(name)
    if as_json:
        print_json(effect_doc(effect))
        return
    print_table((effect.name, ""), effect_lines(effect))
