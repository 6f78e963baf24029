"""Record every command that changes something in the audit of its database, however the command ended.

Before a command begins, its record must be possible: what cannot be recorded is not done.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from abbe.service.cli.declared import is_recorded

if TYPE_CHECKING:
    from abbe.service.domain.audit_event import AuditEvent

INTERRUPTED = "interrupted"


def commands(app: typer.Typer, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all commands of a tree with their full names, such as ``model revert``."""
    for one in app.registered_commands:
        yield before + str(one.name), one
    for group in app.registered_groups:
        yield from commands(group.typer_instance, f"{before}{group.name} ") if group.typer_instance is not None else ()


def record_all(app: typer.Typer) -> None:
    """Wrap every command with the recorder."""
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
        except typer.Exit as ended:  # most commands that answer by an exit code end like this: it counts as a return
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
    """Return how a command ended: ``done``, ``no`` (exit code 1), an error's code, ``interrupted``."""
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
        The machine file or the database is refused anyway, or the audit cannot be written; the latter with its remedy.
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
        raise AuditBroken(f"abbe {command} was not begun, since it could not be recorded: {error.detail}", error.remedy) from None


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
    file = given.get("machine_file") or given.get("machine")
    return str(url_of(given.get("db"), file if isinstance(file, Path) else None))


def _missing(url: str) -> Path | None:
    """Return the SQLite file of a database that does not exist yet; None: it exists, or is no file."""
    from abbe.service.storage.engine import parse_url

    parsed = parse_url(url)
    if parsed.drivername != "sqlite" or parsed.database in {None, "", ":memory:"}:
        return None
    path = Path(str(parsed.database))
    return None if path.exists() else path


def event_of(command: str, given: Mapping[str, Any], outcome: str) -> AuditEvent:
    """Return the record of a command: who ran it here, on what, with which options."""
    from abbe.service.audit.book import this_account
    from abbe.service.domain.audit_event import AuditEvent

    target = next((str(given[key]) for key in ("name", "campaign", "file", "out", "folder", "solution", "machine") if given.get(key)), "")
    options = {key: str(value) for key, value in given.items() if value not in (None, False, "", []) and key not in {"db", "as_json"}}
    return AuditEvent(who=this_account(), action=f"abbe {command}", target=target, outcome=outcome, doc=options)
