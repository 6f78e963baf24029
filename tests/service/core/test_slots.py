"""Slots are UTC instants, each once, whatever the clocks of the zone do."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import islice, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.slots import next_slot, previous_slot, rule_as_text, slots_after, slots_between

ZONES = ["Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "UTC"]
CRONS = ["0 6 * * 1", "30 2 * * *", "0,30 2 * * *", "*/30 * * * *", "15 1-3 * * *", "0 0 1 * *", "45 1 * * *"]


def plan(cron: str, zone: str = "Europe/Berlin") -> Schedule:
    return Schedule("weekly", cron, zone, "verify")


def utc(*parts: int) -> datetime:
    return datetime(*parts, tzinfo=UTC)  # type: ignore[arg-type,misc]


def test_dow_1_is_monday() -> None:
    slot = next_slot(plan("0 6 * * 1"), utc(2026, 11, 20))
    assert slot == utc(2026, 11, 23, 5)
    assert slot.strftime("%A") == "Monday"


def test_spring_gap_fires_once_right_after_it() -> None:
    # Berlin, 2026-03-29: 02:00 becomes 03:00. 02:30 does not exist.
    slots = list(slots_between(plan("30 2 * * *"), utc(2026, 3, 27, 12), utc(2026, 3, 30, 12)))
    assert slots == [utc(2026, 3, 28, 1, 30), utc(2026, 3, 29, 1, 0), utc(2026, 3, 30, 0, 30)]


def test_two_times_inside_the_gap_are_one_slot() -> None:
    slots = list(slots_between(plan("0,30 2 * * *"), utc(2026, 3, 28, 12), utc(2026, 3, 29, 12)))
    assert slots == [utc(2026, 3, 29, 1, 0)]


def test_autumn_fold_fires_once_at_its_first_occurrence() -> None:
    # Berlin, 2026-10-25: 03:00 becomes 02:00. 02:30 exists twice, at 00:30 and at 01:30 UTC.
    slots = list(slots_between(plan("30 2 * * *"), utc(2026, 10, 24, 12), utc(2026, 10, 26, 12)))
    assert slots == [utc(2026, 10, 25, 0, 30), utc(2026, 10, 26, 1, 30)]


def test_asked_between_the_two_half_past_twos_the_next_is_tomorrow() -> None:
    assert next_slot(plan("30 2 * * *"), utc(2026, 10, 25, 1, 15)) == utc(2026, 10, 26, 1, 30)


def test_every_half_hour_runs_through_both_autumn_hours() -> None:
    slots = list(slots_between(plan("*/30 * * * *"), utc(2026, 10, 25, 0), utc(2026, 10, 25, 2)))
    assert slots == [utc(2026, 10, 25, 0, 30), utc(2026, 10, 25, 1), utc(2026, 10, 25, 1, 30), utc(2026, 10, 25, 2)]


def test_seconds_field() -> None:
    assert list(islice(slots_after(plan("*/20 * * * * *", "UTC"), utc(2026, 1, 1)), 2)) == [
        utc(2026, 1, 1, 0, 0, 20),
        utc(2026, 1, 1, 0, 0, 40),
    ]


@pytest.mark.parametrize("zone", ZONES)
@pytest.mark.parametrize("cron", CRONS)
def test_a_year_is_the_same_from_every_starting_point(cron: str, zone: str) -> None:
    """Every slot once, in order; and what is next does not depend on when one asks."""
    schedule = plan(cron, zone)
    slots = list(slots_between(schedule, utc(2026, 1, 1), utc(2027, 1, 1)))
    assert slots == sorted(set(slots))
    for slot, following in list(pairwise(slots))[:: max(len(slots) // 300, 1)]:
        assert next_slot(schedule, slot - timedelta(seconds=1)) == slot
        assert next_slot(schedule, slot) == following


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(CRONS),
    st.sampled_from(ZONES),
    st.datetimes(datetime(2026, 1, 1), datetime(2027, 1, 1), timezones=st.just(UTC)),  # noqa: DTZ001
)
def test_next_and_previous_fit_together(cron: str, zone: str, moment: datetime) -> None:
    schedule = plan(cron, zone)
    after, before = next_slot(schedule, moment), previous_slot(schedule, moment)
    assert after is not None
    assert before is not None
    assert before <= moment < after
    assert next_slot(schedule, before) == after
    assert previous_slot(schedule, after) == after


def test_the_slot_itself_counts_as_previous() -> None:
    assert previous_slot(plan("0 6 1 1 *"), utc(2026, 1, 1, 5)) == utc(2026, 1, 1, 5)


@pytest.mark.parametrize(
    ("cron", "zone", "word"), [("0 6 * *", "UTC", "0 6 * *"), ("0 25 * * *", "UTC", "hour"), ("0 6 * * 1", "Mars/Olympus", "Mars")]
)
def test_a_bad_line_is_named(cron: str, zone: str, word: str) -> None:
    with pytest.raises(ValidationError) as wrong:
        TypeAdapter(Schedule).validate_python({"name": "weekly", "cron": cron, "timezone": zone})
    assert word in str(wrong.value)


def test_words() -> None:
    assert "Monday" in rule_as_text(plan("0 6 * * 1"))
