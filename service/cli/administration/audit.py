"""`abbe audit` shows and verifies the audit; `record_all` makes every command that changes something write a record.

A command that cannot be recorded does not begin. A command that is in no list of this module is recorded, and a test fails until it is
listed.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import (
    DbOption,
    JsonOption,
    MachineOption,
    conclude,
    database_url,
    open_store,
    print_json,
    print_table,
    warn_of_readers,
)

if TYPE_CHECKING:
    from abbe.service.domain.service_records import AuditEvent


audit = typer.Typer(help="The audit: who did what, when, on what, and how it ended.", no_args_is_help=True)
SHOWN = 10


@audit.command("show")
def show_audit(
    last: Annotated[int, typer.Option("--last", min=1, help="How many of the newest records.")] = 50,
    db: DbOption = None,
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the newest records of the audit in the order of their time."""
    from abbe.service.queries.people import audit as records
    from abbe.service.queries.reader import json_value
    from abbe.service.secrets import visible

    with open_store(database_url(db, machine)) as store:
        found = records(store, last)
    if as_json:
        print_json([json_value(record) for record in found])
        return
    # Escaped here, since `print_table` keeps line breaks: one in a target must not look like another record.
    rows = [tuple(map(visible, (str(r.id), r.utc[:19], r.who, r.action, r.target, r.outcome))) for r in found]
    print_table(("record", "when (UTC)", "who", "what", "on", "outcome"), rows)
    conclude("abbe audit verify", machine=machine, db=db, verdict=f"the newest {len(rows)} records")


@audit.command("verify")
def verify_audit(db: DbOption = None, machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Check that no record was changed, removed, swapped or cut off at the end; exit code 1 if one was."""
    from abbe.service.audit.book import AuditBook
    from abbe.service.secrets import visible

    url = database_url(db, machine)
    with open_store(url) as store:
        warn_of_readers(url)
        faults = AuditBook(store, url).verify()
        last = store.audit.events(1)
    head = f"{last[0].id} {last[0].digest}" if last else ""
    if as_json:
        print_json({"records": last[0].id if last else 0, "head": head, "faults": faults})
    else:
        for text in faults[:SHOWN]:
            typer.echo(visible(text))
        if len(faults) > SHOWN:
            typer.echo(f"{len(faults) - SHOWN} more; --json lists all")
        if not faults:
            typer.echo(f"{last[0].id if last else 0} records: none missing, none changed")
            typer.echo(f"head: {head}" if head else "the audit is empty")
        conclude("abbe audit show" if faults else "abbe backup backup", machine=machine, db=db)
    raise typer.Exit(1 if faults else 0)


Given = Mapping[str, Any]


def _always(_: Given) -> bool:
    return True


def _moves(given: Given) -> bool:
    """Return whether `abbe measure` moves the machine: a dry run, its picture or positions, and an NC program do not."""
    return not (given.get("dry_run") or given.get("nc") or given.get("path") or given.get("picture"))


READS = frozenset(
    {
        "plan",
        "simulate",
        "effects",
        "errors",
        "check-config",
        "device interferometer",
        "device list",
        "device show",
        "device test",
        "doctor",
        "init",
        "runs",
        "show",
        "export",
        "vectors",
        "papers",
        "schema",
        "sim",
        "version",
        "model list",
        "model show",
        "model diff",
        "report",
        "trend",
        "fleet",
        "alarm list",
        "comp formats",
        "comp show",
        "comp diff",
        "comp step",
        "user list",
        "user token list",
        "audit show",
        "audit verify",
    }
)
"""Commands that show something or write a requested file."""

RECORDS_ITSELF = frozenset({"serve", "backup", "restore"})
"""Commands that write their own record: ``serve`` when it begins, since it runs for months; ``restore`` into the restored database."""

CHANGES: dict[str, Callable[[Given], bool]] = {
    "demo": lambda given: bool(given.get("keep")),
    "measure": _moves,
    "listen": _always,
    "solve": _always,
    "solve-all": lambda given: bool(given.get("store_solutions")),
    "discover": _always,
    "correct": _always,
    "accept-table": _always,
    "alarm acknowledge": _always,
    "import": _always,
    "model revert": _always,
    "comp commission": _always,
    "comp drop": _always,
    "comp export": lambda given: given.get("sign") is not None,
    "comp import": _always,
    "comp propose": _always,
    "comp approve": _always,
    "comp reject": _always,
    "comp push": _always,
    "comp rollback": _always,
    "key new": _always,
    "user add": _always,
    "user role": _always,
    "user password": _always,
    "user disable": _always,
    "user enable": _always,
    "user token new": _always,
    "user token revoke": _always,
}
"""Commands that may change a database, a machine, or who is trusted; each function tells from the arguments whether this call does."""


def is_recorded(command: str, given: Given) -> bool:
    """Return whether a command called with these arguments is recorded."""
    if command in READS or command in RECORDS_ITSELF:
        return False
    return CHANGES.get(command, _always)(given)


INTERRUPTED = "interrupted"


def commands(app: typer.Typer, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all commands of a tree with their full names, such as ``model revert``."""
    for one in app.registered_commands:
        yield before + str(one.name), one
    for group in app.registered_groups:
        yield from commands(group.typer_instance, f"{before}{group.name} ") if group.typer_instance is not None else ()


def record_all(app: typer.Typer) -> None:
    """Wrap every command so that its calls are recorded in the audit."""
    for command, one in commands(app):
        one.callback = _recorded(command, one.callback)


def _recorded(command: str, work: Any) -> Any:
    @functools.wraps(work)
    def around(*args: Any, **given: Any) -> Any:
        if args or not is_recorded(command, given):
            return work(*args, **given)
        _check_recordable(command, given)
        try:
            result = work(**given)
        except typer.Exit as ended:  # an answer by exit code: a normal end
            _record(command, given, outcome_of(ended))
            raise
        except BaseException as error:
            try:
                _record(command, given, outcome_of(error), error)
            except Exception as second:  # noqa: BLE001 - the command's own error comes first
                error.add_note(f"not recorded: {second}")
            raise
        _record(command, given, "done")
        return result

    return around


def outcome_of(error: BaseException) -> str:
    """Return how a command ended: ``done``, ``no`` (exit code 1), ``exit N``, ``interrupted``, or the error's code or class."""
    code = getattr(error, "exit_code", None) if isinstance(error, typer.Exit) else getattr(error, "code", None)
    if isinstance(error, typer.Exit | SystemExit):
        return {0: "done", None: "done", 1: "no"}.get(code, f"exit {code}")
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return INTERRUPTED
    return str(code) if isinstance(code, str) else type(error).__name__


def _check_recordable(command: str, given: Mapping[str, Any]) -> None:
    """Refuse a command that could not be recorded, before it does anything.

    Raises
    ------
    AbbeError
        The machine file or the database cannot be used, or the audit cannot be written.
    """
    from abbe.service.audit.book import HEADS, KEY, AuditBook, files_base, files_ready
    from abbe.service.cli.common import database_url, open_store
    from abbe.service.errors import AuditBroken

    url = _database(given, database_url)
    missing = _missing(url)
    if missing is not None and not missing.parent.is_dir():
        return  # the command creates the folder, or refuses it
    try:
        if missing is not None:
            base = files_base(None, url)
            files_ready(Path(f"{base}{KEY}"), Path(f"{base}{HEADS}"))
            return
        with open_store(url) as store:
            AuditBook(store, url).ready()
    except AuditBroken as error:
        raise AuditBroken(f"abbe {command} was not started, because it could not be recorded: {error.detail}", error.remedy) from None


def _record(command: str, given: Mapping[str, Any], outcome: str, error: BaseException | None = None) -> None:
    from abbe.service.audit.book import AuditBook
    from abbe.service.cli.common import database_url, open_store
    from abbe.service.errors import AbbeError, AuditBroken

    url = _database(given, database_url)
    missing = _missing(url)
    if missing is not None:
        # A command that refused before its database existed changed nothing; any other outcome is reported.
        if not isinstance(getattr(error, "code", None), str) and sys.stderr is not None:
            sys.stderr.write(f"not recorded in an audit: there is no database {missing}\n")
        return
    try:
        with open_store(url) as store:
            AuditBook(store, url).write(event_of(command, given, outcome))
    except AbbeError as trouble:
        raise AuditBroken(f"abbe {command} ended ({outcome}), but it could not be recorded: {trouble.detail}", trouble.remedy) from None


def _database(given: Mapping[str, Any], url_of: Any) -> str:
    if given.get("keep") is not None:  # the demonstration's own database
        return f"sqlite:///{Path(given['keep']) / 'abbe.sqlite3'}"
    from abbe.service.cli.common import machine_file

    file = given.get("machine")
    if "machine" in given and "db" not in given:  # a command that cannot work without a machine
        file = machine_file(file)
    return str(url_of(given.get("db"), file))


def _missing(url: str) -> Path | None:
    """Return the SQLite file of a database that does not exist yet; None: the database exists, or is not a file."""
    from abbe.service.storage.engine import parse_url

    parsed = parse_url(url)
    if parsed.drivername != "sqlite" or parsed.database in {None, "", ":memory:"}:
        return None
    path = Path(str(parsed.database))
    return None if path.exists() else path


def event_of(command: str, given: Mapping[str, Any], outcome: str) -> AuditEvent:
    """Return the record of a command: who ran it here, on what, with which options."""
    from abbe.service.audit.book import this_account
    from abbe.service.domain.service_records import AuditEvent

    target = next((str(given[key]) for key in ("name", "campaign", "file", "out", "folder", "solution", "machine") if given.get(key)), "")
    options = {key: str(value) for key, value in given.items() if value not in (None, False, "", []) and key not in {"db", "as_json"}}
    return AuditEvent(who=this_account(), action=f"abbe {command}", target=target, outcome=outcome, doc=options)
