"""A database with a row in each of its tables goes up to the next version and back with all of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import BigInteger, Engine, Float, Integer, LargeBinary, MetaData, Table, insert, select
from sqlalchemy.types import JSON

from abbe.service.storage.engine import current_revision, downgrade, make_engine, upgrade
from abbe.service.storage.store import Store
from tests.migration import next_revision

Rows = dict[str, list[dict[str, Any]]]
VALUES = {"status": "complete"}


@pytest.fixture
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    kind: str = request.getfixturevalue("kind")
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}" if kind == "sqlite" else request.getfixturevalue("postgres")()
    made = make_engine(url)
    yield made
    made.dispose()


def tables_of(engine: Engine) -> list[Table]:
    found = MetaData()
    found.reflect(engine)
    return [table for table in found.sorted_tables if table.name != "alembic_version"]


def filled(engine: Engine) -> None:
    """One row in each table that has none; numbers, texts and documents that a careless migration would change."""
    for table in tables_of(engine):
        with engine.begin() as connection:
            if connection.execute(select(table)).first() is None:
                connection.execute(insert(table).values({column.name: _value(column) for column in table.columns}))


def _value(column: Any) -> Any:
    kind = column.type
    if column.primary_key or column.foreign_keys:
        return 1
    if isinstance(kind, JSON):
        return {"µm": 0.1, "list": [None, 1e-7], "text": "ü'\"\n"}
    if isinstance(kind, LargeBinary):
        return bytes(range(256))
    if isinstance(kind, Float):
        return 0.1
    if isinstance(kind, BigInteger):
        return 2**40 + 1
    if isinstance(kind, Integer):
        return 7
    return VALUES.get(column.name, f"{column.name}"[: kind.length or 40])


def rows_of(engine: Engine) -> Rows:
    with engine.connect() as connection:
        return {table.name: [dict(row._mapping) for row in connection.execute(select(table))] for table in tables_of(engine)}


def kept(before: Rows, after: Rows) -> None:
    """Every row is there, with at least the columns that it had."""
    for name, rows in before.items():
        assert [{key: one[key] for key in was} for was, one in zip(rows, after[name], strict=True)] == rows, name


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_nothing_is_lost_on_the_way_up_and_back(engine: Engine, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    upgrade(engine)
    filled(engine)
    stored = rows_of(engine)
    assert all(stored.values())
    newest = next_revision.install(tmp_path, monkeypatch)
    with Store.open(engine.url.render_as_string(hide_password=False)) as store:  # as any command does, after an update
        assert [one.name for one in store.machines.all()] == [one["name"] for one in stored["machines"]]
        assert store.runs.numbered(1) is not None
        assert "name" in store.machines.names()
    assert current_revision(engine) == next_revision.NEXT
    kept(stored, rows_of(engine))
    downgrade(engine, newest)
    assert current_revision(engine) == newest
    assert rows_of(engine) == stored
    upgrade(engine)
    kept(stored, rows_of(engine))
