"""Migrations give exactly the tables the program uses, up and down, on both databases."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Engine, inspect

from abbe.service.errors import StoreError
from abbe.service.storage.engine import make_engine
from abbe.service.storage.migrate import current_revision, downgrade, head_revision, upgrade
from abbe.service.storage.records import ApprovalRecord
from abbe.service.storage.store import Store
from abbe.service.storage.tables import metadata


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


def test_old_sqlite_file_is_copied_before_an_upgrade_and_keeps_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "abbe.sqlite3"
    engine = make_engine(f"sqlite:///{path}")
    upgrade(engine, "0001")
    with engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO machines VALUES (1, 'VMC-1', '{}', 'h', 'then')")
    assert "machine_models" not in inspect(engine).get_table_names()
    engine.dispose()
    with Store.open(f"sqlite:///{path}") as store:
        assert [one.name for one in store.machines()] == ["VMC-1"]
        assert (store.discoveries(), store.models()) == ([], [])
    old = make_engine(f"sqlite:///{path}.before-0001")
    assert current_revision(old) == "0001"
    assert "machines" in inspect(old).get_table_names()
    old.dispose()


def test_discoveries_are_taken_back_and_the_rest_stays(engine: Engine) -> None:
    upgrade(engine)
    downgrade(engine, "0001")
    tables = set(inspect(engine).get_table_names())
    assert not tables & {"discoveries", "discovery_steps", "machine_models"}
    assert {"machines", "campaigns", "runs", "solutions"} <= tables
    upgrade(engine)
    assert current_revision(engine) == head_revision()


def test_the_journal_of_campaigns_is_taken_back_and_the_rest_stays(engine: Engine) -> None:
    upgrade(engine)
    downgrade(engine, "0002")
    tables = set(inspect(engine).get_table_names())
    assert "checkpoints" not in tables
    assert {"campaigns", "runs", "chunks", "discoveries"} <= tables
    upgrade(engine)
    assert current_revision(engine) == head_revision()


def test_a_database_of_the_version_before_the_journal_keeps_its_campaigns(tmp_path: Path) -> None:
    path = tmp_path / "abbe.sqlite3"
    engine = make_engine(f"sqlite:///{path}")
    upgrade(engine, "0002")
    with engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO machines VALUES (1, 'VMC-1', '{}', 'h', 'then')")
        connection.exec_driver_sql("INSERT INTO campaigns VALUES (1, 1, 'june', '{}', 'then')")
    engine.dispose()
    with Store.open(f"sqlite:///{path}") as store:
        assert [one.name for one in store.campaigns()] == ["june"]
        assert store.checkpoints(1) == []
        assert [store.add_checkpoint(1, "begun", {"n": n}) for n in range(3)] == [0, 1, 2]
        assert [one.doc for one in store.checkpoints(1)] == [{"n": 0}, {"n": 1}, {"n": 2}]


def test_proposals_are_taken_back_and_the_journal_of_pushes_stays(engine: Engine) -> None:
    upgrade(engine)
    downgrade(engine, "0005")
    tables = set(inspect(engine).get_table_names())
    assert not tables & {"proposals", "approvals"}
    assert {"push_entries", "solutions", "tables"} <= tables
    upgrade(engine)
    assert current_revision(engine) == head_revision()


def test_a_database_of_the_version_before_proposals_keeps_its_solutions_and_takes_proposals(tmp_path: Path) -> None:
    path = tmp_path / "abbe.sqlite3"
    engine = make_engine(f"sqlite:///{path}")
    upgrade(engine, "0005")
    with engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO machines VALUES (1, 'VMC-1', '{}', 'h', 'then')")
        connection.exec_driver_sql("INSERT INTO campaigns VALUES (1, 1, 'june', '{}', 'then')")
        connection.exec_driver_sql("INSERT INTO solutions VALUES (1, 1, 'joint', '[]', '{}', 'then')")
    engine.dispose()
    with Store.open(f"sqlite:///{path}") as store:
        assert store.solution(1).kind == "joint"
        assert store.proposals() == []
        number = store.add_proposal("VMC-1", 1, {"n": 1.5}, "d")
        store.add_approval(ApprovalRecord(0, number, "anna", "shop", "b", "2099-01-01T00:00:00Z", ""))
        assert [(p.machine, p.doc, p.digest) for p in store.proposals("VMC-1")] == [("VMC-1", {"n": 1.5}, "d")]
        assert [(a.name, a.login, a.expiry) for a in store.approvals(number)] == [("anna", "shop", "2099-01-01T00:00:00Z")]
        with pytest.raises(StoreError, match="no proposal 2"):
            store.proposal(2)
