"""Databases that the code of earlier versions wrote (``stored/``) go up to this version and back, and nothing of them is lost."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from abbe.service.storage.engine import make_engine
from abbe.service.storage.migrate import current_revision, downgrade, head_revision, upgrade
from abbe.service.storage.store import Store
from tests.migration.keep_database import BYTES, DOC, MACHINE
from tests.migration.keep_database import main as make_today
from tests.migration.test_stored import kept, rows_of

STORED = Path(__file__).parent / "stored"
KEPT = sorted({path.name.partition(".")[0] for path in STORED.glob("*.sql")})
CASES = [(kind, revision) for kind in ("sqlite", "postgresql") for revision in KEPT]


@pytest.fixture
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The stored database, as it was."""
    kind, revision = request.getfixturevalue("kind"), request.getfixturevalue("revision")
    script = (STORED / f"{revision}.{kind}.sql").read_text()
    if kind == "sqlite":
        with closing(sqlite3.connect(tmp_path / "abbe.sqlite3")) as connection:
            connection.executescript(script)
        return f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    psycopg = pytest.importorskip("psycopg")
    made: Callable[[], str] = request.getfixturevalue("postgres")
    address = made()
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute(script)
    return address


@pytest.mark.parametrize(("kind", "revision"), CASES)
def test_what_an_earlier_version_wrote_goes_up_and_back_with_every_row(url: str, kind: str, revision: str) -> None:
    engine = make_engine(url)
    try:
        assert current_revision(engine) == revision
        stored = rows_of(engine)
        assert all(stored.values())
        with Store.open(url) as store:  # as any command does, after an update
            reads(store)
        assert current_revision(engine) == head_revision()
        kept(stored, rows_of(engine))
        downgrade(engine, revision)
        assert rows_of(engine) == stored
        upgrade(engine)
        kept(stored, rows_of(engine))
    finally:
        engine.dispose()


def reads(store: Store) -> None:
    """The program sees what was written then, to the last digit."""
    assert [(one.name, one.doc) for one in store.machines()] == [(MACHINE, DOC)]
    assert [(one.label, one.status, one.start_doc) for one in store.runs("june")] == [("r1", "complete", DOC), ("r2", "running", DOC)]
    assert [(one.payload, one.first_host_s, one.first_device_us) for one in store.chunks(1)] == [
        (BYTES, 0.1, 2**40),
        (BYTES * 2, 0.1, 2**40 + 1),
    ]
    assert store.solution(1).doc == DOC
    assert (store.table(1).image, store.table(1).crc) == (BYTES, 2**32 - 1)
    assert [(one.state, one.doc) for one in store.pushes()] == [("KEEP", DOC)]
    assert [one.verdict for one in store.verifications()] == ["cannot tell"]
    assert [one.topic for one in store.outbox_pending()] == ["plant/abbe/alarm"]
    assert [one.state for one in store.slots_of("weekly")] == ["claimed", "done"]


def test_the_newest_schema_is_kept_too() -> None:
    """Whoever adds a revision keeps a database of it (stored/README.md)."""
    assert KEPT[-1] == head_revision()


def test_what_today_writes_is_what_is_kept_of_it(tmp_path: Path) -> None:
    """So that the kept ones stay comparable: today's program writes the same tables with as many rows."""
    make_today(f"sqlite:///{tmp_path / 'today.sqlite3'}")
    with (
        closing(sqlite3.connect(tmp_path / "today.sqlite3")) as today,
        closing(sqlite3.connect(tmp_path / "then.sqlite3")) as then,
    ):
        then.executescript((STORED / f"{head_revision()}.sqlite.sql").read_text())
        counts = [_counts(one) for one in (today, then)]
    assert counts[0] == counts[1]
    assert all(counts[0].values())


def _counts(connection: sqlite3.Connection) -> dict[str, int]:
    names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
    return {name: connection.execute(f"SELECT COUNT(*) FROM {name}").fetchone()[0] for name in names}
