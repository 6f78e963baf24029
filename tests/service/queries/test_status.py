"""The status, checks with their trends, and the timetable: what every surface shows of now."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from abbe.service.core.board import Board
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.queries.checks import check, checks, trends
from abbe.service.queries.reader import Reader, json_value
from abbe.service.queries.status import Status, StatusReader
from abbe.service.queries.timetable import schedule_state, span
from tests.service.web.api_bench import CHECKS, Plant

DAILY = Schedule("daily", "0 6 * * *", "Europe/Berlin", "quick-check")


async def status_of(reader: Reader, board: Board) -> Status:
    soon = datetime(2026, 11, 23, 5, tzinfo=UTC)
    return await StatusReader(reader, "0", board, lambda: [(DAILY, soon)], "").status()


async def test_the_running_check_is_shown_as_the_core_has_it(reader: Reader, plant: Plant) -> None:
    """A field of progress needs no word here: the record of the core is the record of page and JSON."""
    board = Board({"cnc": "modbus://127.0.0.1:5020"}, plant.clock)
    board.job = RunningCheck(schedule="daily", recipe="quick-check", since_utc=plant.clock.utc(), stage="Helix A", done=30.0, total=60.0)
    found = await status_of(reader, board)
    assert found.job is board.job
    assert json_value(found)["job"] == json_value(board.job)
    assert (found.next_due[0].schedule, found.next_due[0].due_text) == ("daily", "Monday 23 November 06:00, in 20 h")


async def test_the_revision_changes_with_more_than_progress(reader: Reader, plant: Plant) -> None:
    board = Board({}, plant.clock)
    board.job = RunningCheck(schedule="daily", recipe="quick-check", since_utc=plant.clock.utc())
    before = (await status_of(reader, board)).revision
    board.job = replace(board.job, done=1.0)
    assert (await status_of(reader, board)).revision == before
    board.job = replace(board.job, prompt=1, ask="A")
    assert (await status_of(reader, board)).revision != before


def test_checks_newest_first_and_their_trend(reader: Reader) -> None:
    found, after = checks(reader, None, None, None, 5)
    assert [one.id for one in found] == list(range(CHECKS, CHECKS - 5, -1))
    assert after == found[-1].id
    assert check(reader, 1).values == {"body_diagonal_um": 10.0, "helix_rms_um": None}
    (trend,) = trends(reader, reader.machine).figures
    assert (trend.figure, trend.checks, trend.latest, trend.state, trend.direction) == ("body_diagonal_um", CHECKS, 13.3, "drifting", 1)
    assert (trend.days_until_limit is None) == bool(trend.reason)
    (later,) = trends(reader, reader.machine, datetime(2026, 11, 5, tzinfo=UTC)).figures
    assert later.checks == CHECKS - 4
    assert not trends(reader, "other mill").figures
    assert not trends(reader, "a\0b").figures


def test_a_schedule_has_its_own_fields_its_next_slot_and_its_past(reader: Reader) -> None:
    found = schedule_state(reader, DAILY)
    assert json_value(found).items() >= json_value(DAILY).items()
    assert found.next_due_utc == datetime(2026, 11, 23, 5, tzinfo=UTC)  # 06:00 in Berlin
    assert (len(found.latest), found.latest[0].state) == (10, "done: pass")


@pytest.mark.parametrize(("seconds", "text"), [(5, "5 s"), (600, "10 min"), (7200, "2 h"), (200_000, "2 days")])
def test_a_length_of_time_has_the_largest_sensible_unit(seconds: float, text: str) -> None:
    assert span(seconds) == text
