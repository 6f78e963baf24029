"""What tests share because it is always the same and dear to make: the tree of commands, an empty SQLite database, what a maker gives."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import pytest
import typer.main
import typer.testing
from sqlalchemy import Connection, create_engine

T = TypeVar("T")


def once_per_run(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> tuple[Path, T]:
    """Folder and value of ``make``: the first worker of a run makes them, the others read them. What is written to is copied first."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, kept = shared / name, shared / f"{name}.pickle"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            made = pickle.dumps(make(folder))
            kept.write_bytes(made)
    found: T = pickle.loads(kept.read_bytes())
    return folder, found


@pytest.fixture(scope="module")
def solved_once() -> Iterator[None]:
    """For a file that asks for it: what equal readings of an equal machine tell is computed once, because it is a function of them."""
    from abbe.service.identification import removal, solve, solve_report

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve, "settled_points", _remembered(solve.settled_points))
        joint = _remembered(solve.solve_joint)
        for module in (solve, removal):
            patch.setattr(module, "solve_joint", joint)
        patch.setattr(solve_report, "assess", _assessed_once(solve_report))
        yield


def _assessed_once(module: Any) -> Callable[..., Any]:
    assess, known = module.assess, dict[tuple[Any, ...], Any]()

    def look_up(solved: Any, *, unknown_table: bool = False) -> Any:
        if unknown_table:
            return assess(solved, unknown_table=True)
        joint, values = solved.joint, (repr(solved.removed), repr(solved.tables), repr(solved.inputs))
        key = (repr(joint.machine), module.model_key(joint), joint.coefficients.tobytes(), *values, *sorted(solved.digests.items()))
        if key not in known:
            known[key] = assess(solved)
        return replace(known[key], solved=solved)

    return look_up


def _remembered(compute: Callable[..., T]) -> Callable[..., T]:
    known: dict[bytes, T] = {}

    def look_up(*given: Any, progress: Any = None, **named: Any) -> T:
        key = hashlib.sha256(pickle.dumps((given, sorted(named.items())))).digest()
        if key not in known:
            known[key] = compute(*given, **named, **({"progress": progress} if progress else {}))
        return known[key]

    return look_up


@pytest.fixture(scope="session", autouse=True)
def _commands_built_once() -> Iterator[None]:
    """Typer builds the tree of commands anew at each call of one; it is a function of what is registered.

    `abbe.service.cli.named_by` makes an application of its own for each call, with what the whole one has registered.
    """
    build = typer.main.get_command
    built: dict[tuple[int, ...], tuple[list[Any], Any]] = {}

    def get_command(app: typer.Typer) -> Any:
        parts = [app.info, app.registered_callback, *app.registered_commands, *app.registered_groups]
        key = tuple(map(id, parts))
        if key not in built:
            built[key] = (parts, build(app))  # the parts are held with it: their ids stay their own
        return built[key][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", get_command)
        patch.setattr(typer.testing, "_get_command", get_command)
        yield


@pytest.fixture(scope="session", autouse=True)
def _schema_built_once() -> Iterator[None]:
    """An empty SQLite database gets what all migrations, played once, have made; one with content, and PostgreSQL, are migrated."""
    with pytest.MonkeyPatch.context() as patch:
        upgraded = _copying()
        patch.setattr("alembic.command.upgrade", upgraded)
        yield


def _copying() -> Callable[[Any, str], None]:
    from alembic import command

    from abbe.service.storage.engine import head_revision

    migrate = command.upgrade

    @cache
    def statements(_head: str) -> tuple[str, ...]:
        from abbe.service.storage.engine import _config

        engine = create_engine("sqlite://")
        with engine.begin() as connection:
            migrate(_config(connection), "head")
            raw = connection.connection.driver_connection
            assert isinstance(raw, sqlite3.Connection)
            found = tuple(s for s in raw.iterdump() if s not in {"BEGIN TRANSACTION;", "COMMIT;"})
        engine.dispose()
        return found

    def upgrade(config: Any, revision: str) -> None:
        connection = config.attributes.get("connection")
        if revision != "head" or not isinstance(connection, Connection) or connection.dialect.name != "sqlite" or _has_content(connection):
            migrate(config, revision)
            return
        for statement in statements(head_revision()):
            own = f"VALUES(1,'{uuid4().hex}')" if statement.startswith('INSERT INTO "identity"') else ""  # each is a database of its own
            connection.exec_driver_sql(re.sub(r"VALUES\(1,'[0-9a-f]{32}'\)", own, statement) if own else statement)

    return upgrade


def _has_content(connection: Connection) -> bool:
    return bool(connection.exec_driver_sql("SELECT count(*) FROM sqlite_master").scalar())
