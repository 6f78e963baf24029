"""`abbe backup` and `abbe restore`: copy everything that is stored into a folder, and restore it."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import DbOption, JsonOption, MachineOption, conclude, database_url, named_machine, print_json

if TYPE_CHECKING:
    from abbe.service.backup.backup import BackupSource


def backup(
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="New folder.", show_default=False)],
    without_key: Annotated[bool, typer.Option("--without-key", help="Leave out the audit's key; keep it elsewhere.")] = False,
    share: Annotated[
        bool,
        typer.Option(
            "--share",
            help="Share unchanged pieces of the database, by links, with the latest --share backup in the same parent folder, and write "
            "only the rest. Every backup is complete by itself.",
        ),
    ] = False,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Copy the database, samples that are not yet in it, and the audit into a new folder, and check the copy. The service may run."""
    from abbe.service.backup.backup import back_up
    from abbe.service.clock import SystemClock
    from abbe.service.domain.document import document

    made = back_up(_source(db, machine), target, SystemClock().utc, with_key=not without_key, share=share)
    if as_json:
        print_json(document(made))
    else:
        rows, size = made.rows, f"{made.bytes / 1e6:.1f} MB"
        if made.pieces is not None:
            size += f" ({made.new_bytes / 1e6:.1f} MB new)"
        typer.echo(f"{target}: {rows['runs']} runs, {rows['verifications']} checks, {made.segments} files of samples, {size}, checked")
        for text in made.audit.faults[:3]:
            typer.echo(f"audit: {text}")
        if made.audit.records and not made.audit.key:
            typer.echo("the backup does not contain the audit's key: abbe restore needs it (--audit-key FILE)")
        then = "abbe audit verify" if made.audit.faults else f"abbe restore {quote(str(target))} --db sqlite:////tmp/restored.sqlite3"
        conclude(then, machine=machine if made.audit.faults else None, db=db if made.audit.faults else None)
    raise typer.Exit(1 if made.audit.faults else 0)


def restore(
    folder: Annotated[Path, typer.Argument(metavar="BACKUP", help="Folder of a backup.", show_default=False)],
    replace: Annotated[bool, typer.Option("--replace", help="Set an existing database aside; it is renamed, not deleted.")] = False,
    audit_key: Annotated[
        Path | None, typer.Option("--audit-key", metavar="FILE", help="Key of the audit, for a backup without it.", show_default=False)
    ] = None,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check a backup's files, schema and audit, then restore it. Refuse a database in use, or, without --replace, one that exists."""
    from abbe.service.backup.restore import restore as restore_backup
    from abbe.service.clock import SystemClock
    from abbe.service.domain.document import document

    done = restore_backup(folder, _source(db, machine), SystemClock().utc, replace=replace, key_file=audit_key)
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
    conclude("abbe audit verify", machine=machine, db=db)


def _source(db: str | None, machine: Path | None) -> BackupSource:
    """Return what to back up: the database given by ``db`` or by the machine file, which also gives the folder of samples."""
    from abbe.service.backup.backup import BackupSource
    from abbe.service.config import load_machine
    from abbe.service.domain.machine_file import CaptureSettings

    url, file = database_url(db, machine), named_machine(machine) if db is None else None
    return BackupSource(url, CaptureSettings() if file is None else load_machine(file).machine.store.for_capture(), file)
