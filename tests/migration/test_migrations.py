"""Migrations give exactly the tables the program uses, up and down, on both databases."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Engine, inspect

from abbe.service.clock import SystemClock
from abbe.service.errors import StoreError
from abbe.service.storage.engine import current_revision, downgrade, head_revision, make_engine, upgrade
from abbe.service.storage.migrations.versions import r0100_first as first
from abbe.service.storage.store import Store
from abbe.service.storage.tables import metadata
from abbe.service.users.people import Passwords, UserAccounts
from tests.migration import next_revision

PHRASE, CHEAP = "correct horse battery staple", Passwords(memory_kib=64, passes=1)


@pytest.fixture(params=["sqlite", "postgresql"])
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    if request.param == "sqlite":
        engine = make_engine(f"sqlite:///{tmp_path / 'abbe.sqlite3'}")
        yield engine
        engine.dispose()
        return
    engine = make_engine(request.getfixturevalue("postgres")())
    yield engine
    engine.dispose()


def test_up_gives_the_tables_of_the_program(engine: Engine) -> None:
    upgrade(engine)
    assert current_revision(engine) == head_revision()
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection, opts={"compare_type": True}), metadata) == []


def test_the_first_schema_states_its_tables_itself_once_there_is_a_second() -> None:
    """Before the first release it is the program's tables as they are: a new column is then written once."""
    versions = sorted(Path(first.__file__).parent.glob("r*.py"))
    assert len(versions) == 1 or "metadata" not in versions[0].read_text()


def test_down_and_up_again(engine: Engine) -> None:
    upgrade(engine)
    downgrade(engine)
    assert set(inspect(engine).get_table_names()) == {"alembic_version"}
    assert current_revision(engine) is None
    upgrade(engine)
    assert set(inspect(engine).get_table_names()) == set(metadata.tables) | {"alembic_version"}


def test_upgrade_of_an_up_to_date_database_changes_nothing(engine: Engine) -> None:
    upgrade(engine)
    upgrade(engine)
    assert current_revision(engine) == head_revision()


def test_database_of_a_newer_version_is_refused(engine: Engine) -> None:
    upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(StoreError, match="schema 9999, which this version of Abbe does not know"):
        upgrade(engine)


def test_a_database_from_before_the_first_release_is_refused(engine: Engine) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)")
        connection.exec_driver_sql("INSERT INTO alembic_version VALUES ('0012')")
    with pytest.raises(StoreError, match="schema 0012, which this version of Abbe does not know"):
        upgrade(engine)


def test_an_older_sqlite_file_is_copied_before_an_upgrade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "abbe.sqlite3"
    with Store.open(f"sqlite:///{path}") as store:
        store.machines.add("VMC-1", {})
    newest = next_revision.install(tmp_path, monkeypatch)
    with Store.open(f"sqlite:///{path}") as store:
        assert [one.name for one in store.machines.all()] == ["VMC-1"]
        assert "gauges" in inspect(store.engine).get_table_names()
    old = make_engine(f"sqlite:///{path}.before-{newest}")
    assert current_revision(old) == newest
    assert "gauges" not in inspect(old).get_table_names()
    old.dispose()


@pytest.mark.parametrize("has_pin", [False, True])
def test_a_database_of_the_first_schema_gets_what_it_lacks(engine: Engine, has_pin: bool) -> None:
    """For a day the first schema was made with or without the column of the PIN; both came from the program of that day."""
    upgrade(engine, "0100")
    with engine.begin() as connection:
        if has_pin:
            connection.exec_driver_sql("ALTER TABLE users ADD COLUMN pin VARCHAR(200)")
        columns, values = "name, role, password, created_utc", f"'ana', 'admin', '{CHEAP.hash(PHRASE)}', '2026-11-26T09:00:00.000000Z'"
        connection.exec_driver_sql(f"INSERT INTO users ({columns}) VALUES ({values})")
    with Store.open(engine.url.render_as_string(hide_password=False)) as store:
        people = UserAccounts(store, SystemClock(), CHEAP)
        assert people.check("ana", PHRASE) is not None
        people.add("olga", "operator", PHRASE)
        people.set_pin("olga", "582914")
        assert people.check_pin("olga", "582914")[0] is not None
    test_up_gives_the_tables_of_the_program(engine)
