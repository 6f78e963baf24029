"""`abbe backup` and `abbe restore`: copy everything that is stored into a folder, and restore it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json

if TYPE_CHECKING:
    from abbe.service.backup.backup import BackupSource

StoreOption = Annotated[
    str | None, typer.Option("--store", "--db", metavar="URL", help="Database, instead of a machine file's.", show_default=False)
]


def backup(
    places: Annotated[
        list[Path], typer.Argument(metavar="[MACHINE.toml] TARGET", help="Machine file, and a new folder.", show_default=False)
    ],
    store: StoreOption = None,
    without_key: Annotated[bool, typer.Option("--without-key", help="Leave out the audit's key; keep it elsewhere.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Copy the database, samples that are not yet in it, and the audit into a new folder, and check the copy. The service may run."""
    from abbe.service.backup.backup import back_up
    from abbe.service.clock import SystemClock
    from abbe.service.domain.document import document

    source, target = _places(places, store, "TARGET")
    made = back_up(source, target, SystemClock().utc, with_key=not without_key)
    if as_json:
        print_json(document(made))
    else:
        rows, size = made.rows, sum(one.bytes for one in made.files.values())
        typer.echo(
            f"{target}: {rows['runs']} runs, {rows['verifications']} checks, {made.segments} files of samples, {size / 1e6:.1f} MB, checked"
        )
        for text in made.audit.faults[:3]:
            typer.echo(f"audit: {text}")
        if made.audit.records and not made.audit.key:
            typer.echo("the backup does not contain the audit's key: abbe restore needs it (--audit-key FILE)")
    raise typer.Exit(1 if made.audit.faults else 0)


def restore(
    places: Annotated[
        list[Path], typer.Argument(metavar="[MACHINE.toml] BACKUP", help="Machine file, and the folder of a backup.", show_default=False)
    ],
    store: StoreOption = None,
    replace: Annotated[bool, typer.Option("--replace", help="Set an existing database aside; it is renamed, not deleted.")] = False,
    audit_key: Annotated[
        Path | None, typer.Option("--audit-key", metavar="FILE", help="Key of the audit, for a backup without it.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a backup's files, schema and audit, then restore it. Refuse a database in use, or, without --replace, one that exists."""
    from abbe.service.backup.restore import restore as restore_backup
    from abbe.service.clock import SystemClock
    from abbe.service.domain.document import document

    into, folder = _places(places, store, "BACKUP")
    done = restore_backup(folder, into, SystemClock().utc, replace=replace, key_file=audit_key)
    aside = [str(path) for path in done.aside]
    if as_json:
        print_json({"database": str(done.database), "backup": document(done.backup.listed), "audit_records": done.records, "aside": aside})
        return
    rows = done.backup.listed.rows
    typer.echo(f"{done.database}: as of {done.backup.listed.made_utc}, {rows['runs']} runs, {rows['verifications']} checks")
    typer.echo(f"audit: {done.records} records: none missing, none changed")
    if done.segments:
        typer.echo(f"{done.segments} files of samples: the next command that connects to the machine stores them in the database")
    for path in aside:
        typer.echo(f"set aside: {path}")


def _places(places: list[Path], store: str | None, last: str) -> tuple[BackupSource, Path]:
    """Return the database and the backup folder that the arguments name; ``last``: the folder's name in the error text."""
    from abbe.service.backup.backup import BackupSource
    from abbe.service.capture.settings import CaptureSettings
    from abbe.service.config import load_machine
    from abbe.service.errors import ConfigError
    from abbe.service.site import site_of

    if len(places) != (2 if store is None else 1):
        raise ConfigError("a database and one folder are needed", f"write MACHINE.toml {last}, or --store URL {last}")
    if store is not None:
        return BackupSource(store, CaptureSettings()), places[0]
    loaded = load_machine(places[0])
    return BackupSource(loaded.database_url, site_of(loaded.machine).capture, places[0]), places[1]
