"""What the service asks a long history is answered by an index: SQLite's own plan is asked, no clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from sqlalchemy import Connection, event

from abbe.service.domain.results import VerificationRecord
from abbe.service.queries.fleet import fleet
from abbe.service.storage.store import Store
from abbe.service.verification.trend_table import trends
from tests.experiments.bench.history_case import START, History, build

HISTORY = History(machines=3, days=4, checks_a_day=2, runs=120)
LISTS = {
    "SCAN stations",
    "SCAN stations USING INDEX sqlite_autoindex_stations_1",
    "SCAN stations USING COVERING INDEX sqlite_autoindex_stations_1",
    "SCAN machines USING COVERING INDEX sqlite_autoindex_machines_1",
    "SCAN push_entries",
}
"""Small by nature: a row a machine; a dozen a push, of which the first ones tell whose journal it is."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    url = f"sqlite:///{tmp_path_factory.mktemp('history') / 'abbe.sqlite3'}"
    build(url, HISTORY)
    with Store.open(url) as opened:
        yield opened


def plans(store: Store, work: Callable[[], object]) -> list[str]:
    """The plan of every query that a call makes."""
    asked: list[tuple[str, Any]] = []

    def before(_c: Connection, _cursor: object, statement: str, parameters: Any, _context: object, _many: bool) -> None:
        if statement.lstrip().upper().startswith(("SELECT", "UPDATE", "INSERT", "WITH")):
            asked.append((statement, parameters))

    event.listen(store.engine, "before_cursor_execute", before)
    try:
        work()
    finally:
        event.remove(store.engine, "before_cursor_execute", before)
    assert asked
    with store.engine.connect() as connection:
        return [str(row[3]) for statement, values in asked for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)]


NAME = "mill-2"
CALLS: dict[str, Callable[[Store], object]] = {
    "page: last checks": lambda s: s.verifications.of_machine(NAME, 60),
    "page: messages that wait": lambda s: s.outbox.count(),
    "timetable: last slot": lambda s: s.slots.last_due(f"{NAME}/quick"),
    "timetable: open slots": lambda s: s.slots.adopt(f"{NAME}/quick"),
    "timetable: slots": lambda s: s.slots.latest(f"{NAME}/quick"),
    "check: its campaign": lambda s: s.campaigns.find(s.verifications.of_machine(NAME, 1)[0].doc["campaign"]),
    "check: its runs": lambda s: s.runs.all(s.verifications.of_machine(NAME, 1)[0].doc["campaign"]),
    "check: samples of a run": lambda s: s.chunks.of_run(1),
    "check: keep": lambda s: s.verifications.add_with_messages(2, s.verifications.of_machine(NAME, 1)[0].doc, [("t", {})]),
    "campaign by number": lambda s: s.campaigns.find(7),
    "run by number": lambda s: s.runs.numbered(7),
    "chunks of a run": lambda s: s.chunks.crcs(7),
    "solutions": lambda s: s.solutions.all(7),
    "audit: end": lambda s: s.audit.events(1),
}


@pytest.mark.parametrize("name", CALLS)
def test_nothing_is_looked_for_row_by_row(store: Store, name: str) -> None:
    told = plans(store, lambda: CALLS[name](store))
    scans = [one for one in told if one.startswith("SCAN")]
    # The end of the audit is where its number is highest: the table is entered there, and left after one row.
    assert [one for one in scans if one != "SCAN audit"] == [], told


def test_the_whole_fleet_scans_only_what_has_a_row_a_machine(store: Store) -> None:
    told = plans(store, lambda: fleet(store, START))
    assert {one for one in told if one.startswith("SCAN")} <= LISTS


def test_this_test_would_see_a_missing_index(store: Store) -> None:
    assert "SCAN runs" in plans(store, lambda: store.runs.all(None))


def test_the_history_is_what_it_says(store: Store) -> None:
    assert len(store.campaigns.all()) == HISTORY.checks
    assert len(store.runs.all()) == HISTORY.runs
    found: list[VerificationRecord] = store.verifications.of_machine(NAME)
    assert {one.doc["machine"] for one in found} == {NAME}
    assert [one.figure for one in trends(found)] == ["body_diagonal_um", "helix_rms_um"]
