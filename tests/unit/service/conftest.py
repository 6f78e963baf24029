"""What the service's tests share: the shared material, a store on each database, a frozen clock."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from service.storage.store import Store

SERVER = "postgresql://postgres@127.0.0.1:5432/"
NOW = datetime(2026, 11, 21, 3, 34, tzinfo=UTC)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of specifications and foreign data beside the repository."""
    path = Path(__file__).resolve().parents[4] / "shared"
    if not path.is_dir():
        pytest.skip("the folder ../shared with specifications and foreign data is not here")
    return path


@pytest.fixture(scope="session")
def postgres() -> Iterator[Callable[[], str]]:
    """Make throw-away PostgreSQL databases, or skip."""
    psycopg = pytest.importorskip("psycopg")
    try:
        server = psycopg.connect(SERVER, autocommit=True, connect_timeout=3)
    except psycopg.OperationalError:
        pytest.skip(f"no PostgreSQL at {SERVER}")
    made: list[str] = []

    def make() -> str:
        name = f"abbe_test_{uuid.uuid4().hex}"
        server.execute(f"CREATE DATABASE {name}")
        made.append(name)
        return SERVER + name

    yield make
    for name in made:
        server.execute(f"DROP DATABASE {name} WITH (FORCE)")
    server.close()


@pytest.fixture(params=["sqlite", "memory", "postgresql"])
def db_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database of each kind."""
    if request.param == "postgresql":
        make: Callable[[], str] = request.getfixturevalue("postgres")
        return make()
    return "sqlite://" if request.param == "memory" else f"sqlite:///{tmp_path / 'abbe.sqlite3'}"


@pytest.fixture
def store(db_url: str) -> Iterator[Store]:
    """An open store whose clock stands still."""
    with Store.open(db_url, utcnow=lambda: NOW) as opened:
        yield opened


@pytest.fixture
def file_store(tmp_path: Path) -> Iterator[Store]:
    """An open store in a SQLite file."""
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}", utcnow=lambda: NOW) as opened:
        yield opened


@pytest.fixture
def campaign_id(store: Store) -> int:
    """A campaign of a machine."""
    return store.add_campaign(store.add_machine("VMC-1", {"name": "VMC-1"}), "c1", {})
