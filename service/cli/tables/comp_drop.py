"""`abbe comp drop`: put table files into the folder of a control without an interface, confirm them, take them back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, MachineOption, answer, conclude, machine_file
from abbe.service.cli.tables.comp import ReferenceOption, StepOption


def drop(  # noqa: PLR0913 - one argument for each option
    source: Annotated[Path, typer.Argument(metavar="OUT", help="File or folder of abbe comp export.", show_default=False)],
    form: Annotated[
        str | None, typer.Option("--format", metavar="F", help="With --to: format or control of the export.", show_default=False)
    ] = None,
    to: Annotated[
        str | None,
        typer.Option("--to", metavar="PLACE", help="The control's folder, or opc.tcp://HOST:PORT/?FILE=NODE.", show_default=False),
    ] = None,
    back: Annotated[
        Path | None,
        typer.Option(
            "--back", metavar="PATH", help="Files of its tables that the control exported: they confirm the drop.", show_default=False
        ),
    ] = None,
    seen: Annotated[
        bool, typer.Option("--seen", help="I have seen at the control that the tables are loaded: recorded as your statement.")
    ] = False,
    take_back: Annotated[bool, typer.Option("--take-back", help="Put the earlier files back into the folder.")] = False,
    reference: ReferenceOption = None,
    step_moved: StepOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Put exported tables where a control reads them, keep the previous files, and confirm by the files that the control exports.

    Give one of --to, --back, --seen, --take-back. A person loads the tables at the control.
    """
    from abbe.service.errors import FormatRefused

    if sum((to is not None, back is not None, seen, take_back)) != 1 or (to is None) != (form is None):
        raise FormatRefused("give one of --to PLACE --format F, --back PATH, --seen, --take-back", "abbe comp drop --help")

    from abbe.service.audit.book import by_whom
    from abbe.service.clock import SystemClock
    from abbe.service.compensation import file_drop
    from abbe.service.compensation.comp_export import control_for, reference_of, settings_for, sign_is_turned
    from abbe.service.config import load_machine
    from abbe.service.site import site_of

    site = site_of(load_machine(machine_file(machine)).machine)
    if to is not None and form is not None:
        control_for(form)
        made = file_drop.drop(source, file_drop.place_at(to), machine=site.name, form=form, now=SystemClock().utc())
        text = f"{len(made.files)} files lie in {made.folder}, read back; now load them at the control"
    elif back is not None:
        control, at = control_for(file_drop.receipt(source).form), reference_of(reference)
        settings = settings_for(control, site.machine, site.machine.stroke_mm[:, 0] if at is None else at)
        made = file_drop.confirm(source, back, settings, turned=sign_is_turned(step_moved) or False)
        text = "confirmed: the control holds the same corrections"
    elif seen:
        made = file_drop.seen(source, by_whom())
        text = f"recorded: {made.seen_by} says that the tables are loaded; not confirmed by the control's own files"
    else:
        made = file_drop.take_back(source)
        text = f"taken back: {made.folder} holds what lay there before; load that at the control"
    answer(asdict(made), text, as_json=as_json)
    conclude("abbe measure --recipe verification", machine=machine, as_json=as_json)
