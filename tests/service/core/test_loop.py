"""Each slot exactly once, none lost in silence, one job at a time. Weeks pass in milliseconds: the clock is ours."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import datetime, timedelta

import pytest

from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.loop import MAX_BACKLOG, Scheduler
from abbe.service.scheduler.slots import slots_between
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, settle, utc

Job = Callable[[Schedule, datetime], Awaitable[str]]
WEEKLY = Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "verify")
NIGHTLY = Schedule("nightly", "30 2 * * *", "Europe/Berlin", "verify")
DAY_S = 86400.0


class Bench:
    """A scheduler with everything around it faked."""

    def __init__(self, start: datetime, *schedules: Schedule, job_s: float = 1200.0, ledger: FakeLedger | None = None) -> None:
        self.clock = FakeClock(start)
        self.ledger = ledger or FakeLedger()
        self.shelf = FakeShelf()
        self.job_s = job_s
        self.ran: list[tuple[str, datetime]] = []
        self.scheduler = Scheduler(schedules, self.ledger, self.job, self.shelf, self.clock)

    async def job(self, schedule: Schedule, slot: datetime) -> str:
        self.ran.append((schedule.name, slot))
        await self.clock.sleep(self.job_s)
        return "done: pass"

    @asynccontextmanager
    async def working(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self.scheduler.run())
        await settle()
        try:
            yield
        finally:
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    def codes(self) -> list[str]:
        return [alarm["code"] for alarm in self.shelf.alarms]


async def test_two_weeks_through_the_autumn_change() -> None:
    start = utc(2026, 10, 17, 12)
    bench = Bench(start, WEEKLY, NIGHTLY)
    async with bench.working():
        await bench.clock.pass_time(14 * DAY_S)
    expected = {(s.name, slot) for s in (WEEKLY, NIGHTLY) for slot in slots_between(s, start, start + timedelta(days=14))}
    assert len(expected) == 16
    assert set(bench.ran) == expected
    assert len(bench.ran) == 16
    assert bench.ledger.of("done: pass") == sorted(slot for _, slot in expected)
    assert bench.shelf.alarms == []
    assert all(later == slot for (_, slot), later in zip(bench.ran, bench.ledger.of("done"), strict=True))


async def test_a_slot_that_falls_due_during_a_job_is_skipped_with_a_reason() -> None:
    quick = Schedule("quick", "*/10 * * * *", "UTC", "verify")
    bench = Bench(utc(2026, 6, 1), quick, job_s=900)
    async with bench.working():
        await bench.clock.pass_time(3600)
    assert bench.ledger.of("skipped") == [utc(2026, 6, 1, 0, 20), utc(2026, 6, 1, 0, 40), utc(2026, 6, 1, 1, 0)]
    assert bench.codes() == ["SCH-002"] * 3 + ["SCH-007"]  # the last: the job that ran when this ended
    assert "'quick' was still running" in bench.shelf.alarms[0]["what"]


async def test_two_schedules_at_one_instant_never_run_together() -> None:
    twin = Schedule("twin", "0 6 * * 1", "Europe/Berlin", "verify")
    bench = Bench(utc(2026, 6, 1), WEEKLY, twin)
    async with bench.working():
        await bench.clock.pass_time(DAY_S)
    assert [name for name, _ in bench.ran] == ["weekly"]
    assert bench.codes() == ["SCH-002"]


@pytest.mark.parametrize(
    ("off", "ran", "missed"), [(timedelta(minutes=1), 1, 0), (timedelta(hours=8), 0, 1), (timedelta(days=2, hours=20), 0, 3)]
)
async def test_after_the_service_was_off(off: timedelta, ran: int, missed: int) -> None:
    """A minute late still runs; hours late is written down as missed, each slot of it, and announced."""
    ledger = FakeLedger()
    first = utc(2026, 6, 2, 0, 30)
    ledger.of_earlier(NIGHTLY, first)
    bench = Bench(first + timedelta(days=1) + off, NIGHTLY, ledger=ledger)
    async with bench.working():
        await settle()
        assert len(bench.ran) == ran
        assert len(ledger.of("missed")) == missed
        assert bench.codes() == ["SCH-001"] * missed


CHANGED = (
    Schedule("nightly", "28 0 * * *", "UTC", "verify"),
    Schedule("nightly", "0 * * * *", "UTC", "verify"),
    Schedule("nightly", "0 * * * *", "UTC", "verify", catch_up="once"),
    replace(NIGHTLY, timezone="Europe/London"),
)


@pytest.mark.parametrize("changed", CHANGED)
@pytest.mark.parametrize("again", [False, True])
async def test_a_changed_time_rule_has_no_slots_before_its_change(changed: Schedule, again: bool) -> None:
    """Nothing starts because a time of today was set that is over, and no slot is called missed that never was one."""
    ledger, now = FakeLedger(), utc(2026, 6, 5, 0, 30, 30)
    ledger.of_earlier(NIGHTLY, utc(2026, 6, 2, 0, 30))
    for _ in range(1 + again):  # the service starts anew with each further change of the file
        bench = Bench(now, changed, ledger=ledger)
        async with bench.working():
            await bench.clock.pass_time(60)
            assert (bench.ran, ledger.of("missed"), bench.codes()) == ([], [], [])
        now += timedelta(minutes=2)


async def test_a_schedule_that_was_away_for_a_while_missed_nothing() -> None:
    ledger = FakeLedger()
    ledger.of_earlier(NIGHTLY, utc(2026, 6, 2, 0, 30))
    async with Bench(utc(2026, 6, 2, 8), ledger=ledger).working():
        await settle()
    bench = Bench(utc(2026, 6, 5, 8), NIGHTLY, ledger=ledger)
    async with bench.working():
        await settle()
        assert (bench.ran, ledger.of("missed"), bench.codes()) == ([], [], [])


async def test_a_new_schedule_starts_with_its_next_slot() -> None:
    bench = Bench(utc(2026, 6, 2, 0, 31), NIGHTLY)
    async with bench.working():
        assert bench.ledger.states == {}


async def test_two_services_share_the_slots() -> None:
    ledger = FakeLedger()
    one = Bench(utc(2026, 6, 1), Schedule("fast", "* * * * *", "UTC", "verify"), job_s=10, ledger=ledger)
    two = Bench(utc(2026, 6, 1), Schedule("fast", "* * * * *", "UTC", "verify"), job_s=10, ledger=ledger)
    async with one.working(), two.working():
        for _ in range(200):
            await one.clock.pass_time(30)
            await two.clock.pass_time(30)
    slots = [slot for _, slot in one.ran + two.ran]
    assert len(slots) == len(set(slots)) == 100


async def test_clock_set_back_two_hours_runs_nothing_twice() -> None:
    hourly = Schedule("hourly", "0 * * * *", "UTC", "verify")
    bench = Bench(utc(2026, 6, 1, 7, 30), hourly, job_s=60)
    async with bench.working():
        await bench.clock.pass_time(2 * 3600)
        bench.clock.utc_now -= timedelta(hours=2)
        await bench.clock.pass_time(4 * 3600)
    assert [slot.hour for _, slot in bench.ran] == [8, 9, 10, 11]
    assert bench.codes() == ["SCH-003"]
    assert "-7200 s" in bench.shelf.alarms[0]["what"]


async def test_clock_set_ahead_and_back_again_does_not_silence_the_timetable() -> None:
    bench = Bench(utc(2026, 6, 1, 7, 30), Schedule("hourly", "0 * * * *", "UTC", "verify"), job_s=60)
    async with bench.working():
        bench.clock.utc_now += timedelta(days=10)
        await bench.clock.pass_time(60)
        missed = len(bench.ledger.of("missed"))
        bench.clock.utc_now -= timedelta(days=10)
        await bench.clock.pass_time(60)
        await bench.clock.pass_time(3600)
    assert missed == 240
    # The hour of 08:00 on June 1st was missed when the clock said June 11th; it is not run again. 11 days later all is as usual.
    assert bench.ran == []
    assert bench.codes().count("SCH-003") == 2


async def test_an_absurd_jump_is_one_alarm() -> None:
    bench = Bench(utc(2026, 6, 1), Schedule("fast", "* * * * *", "UTC", "verify"))
    async with bench.working():
        bench.clock.utc_now += timedelta(days=3650)
        await bench.clock.pass_time(30)
        assert bench.codes() == ["SCH-003", "SCH-004"]
    assert len(bench.ledger.states) <= MAX_BACKLOG


async def test_stopping_interrupts_the_job_and_says_so() -> None:
    bench = Bench(utc(2026, 6, 1, 3, 59, 30), WEEKLY)
    async with bench.working():
        await bench.clock.pass_time(60)
        assert bench.ledger.of("RUNNING") == [utc(2026, 6, 1, 4)]
        assert bench.codes() == []
    assert bench.ledger.of("interrupted") == [utc(2026, 6, 1, 4)]
    assert bench.codes() == ["SCH-007"]
    assert bench.shelf.alarms[0]["what"] == "weekly: slot 2026-06-01 04:00 UTC was interrupted: the service was stopped while it ran"


async def test_next_due_is_sorted() -> None:
    bench = Bench(utc(2026, 6, 1, 12), WEEKLY, NIGHTLY)
    assert [schedule.name for schedule, _ in bench.scheduler.next_due()] == ["nightly", "weekly"]
