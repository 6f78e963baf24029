"""Every command that changes something leaves one record in the audit of the database it worked on, however it ended."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from service.cli.declared import is_recorded

if TYPE_CHECKING:
    from service.audit.chain import Event

INTERRUPTED = "interrupted"


def commands(app: typer.Typer, before: str = "") -> Iterator[tuple[str, Any]]:
    """All commands of a tree, by their words: ``model revert``."""
    for one in app.registered_commands:
        yield before + str(one.name), one
    for group in app.registered_groups:
        yield from commands(group.typer_instance, f"{before}{group.name} ") if group.typer_instance is not None else ()


def record_all(app: typer.Typer) -> None:
    """Put the recorder around every command."""
    for words, one in commands(app):
        one.callback = _recorded(words, one.callback)


def _recorded(words: str, work: Any) -> Any:
    @functools.wraps(work)
    def around(*args: Any, **given: Any) -> Any:
        if args or not is_recorded(words, given):
            return work(*args, **given)
        try:
            result = work(**given)
        except typer.Exit as ended:  # how most commands end that answer by an exit code: as good as a return
            _record(words, given, outcome_of(ended))
            raise
        except BaseException as error:
            try:
                _record(words, given, outcome_of(error))
            except Exception as second:  # noqa: BLE001 - what the command itself has to say comes first
                error.add_note(f"not recorded: {second}")
            raise
        _record(words, given, "done")
        return result

    return around


def outcome_of(error: BaseException) -> str:
    """How a command ended: ``done``, ``no`` (exit code 1), a code of an error, ``interrupted``."""
    code = getattr(error, "exit_code", None) if isinstance(error, typer.Exit) else getattr(error, "code", None)
    if isinstance(error, typer.Exit | SystemExit):
        return {0: "done", None: "done", 1: "no"}.get(code, f"exit {code}")
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return INTERRUPTED
    return str(code) if isinstance(code, str) else type(error).__name__


def _record(words: str, given: Mapping[str, Any], outcome: str) -> None:
    from service.audit.book import AuditBook
    from service.cli.common import database_url, open_store
    from service.errors import AbbeError, AuditBroken

    try:
        url = _database(given, database_url)
        store = open_store(url)
    except AbbeError:
        return  # no machine file or no database that could be told: then nothing was changed in one
    with store:
        try:
            AuditBook(store, url).write(event_of(words, given, outcome))
        except AbbeError as error:
            raise AuditBroken(f"abbe {words} ended ({outcome}), but it could not be recorded: {error.detail}", error.remedy) from None


def _database(given: Mapping[str, Any], url_of: Any) -> str:
    if given.get("keep") is not None:  # the demo's own world
        return f"sqlite:///{Path(given['keep']) / 'abbe.sqlite3'}"
    file = given.get("machine_file") or given.get("machine")
    return str(url_of(given.get("db"), file if isinstance(file, Path) else None))


def event_of(words: str, given: Mapping[str, Any], outcome: str) -> Event:
    """What is recorded of a command: who ran it here, on what, with which options."""
    from service.audit.book import this_account
    from service.audit.chain import Event

    target = next((str(given[key]) for key in ("name", "campaign", "file", "out", "folder", "solution", "machine") if given.get(key)), "")
    told = {key: str(value) for key, value in given.items() if value not in (None, False, "", []) and key not in {"db", "as_json"}}
    return Event(this_account(), f"abbe {words}", target, outcome, told)
