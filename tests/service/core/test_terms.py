"""On what terms a slot starts: catch-up, maintenance, preconditions, and what a service that is gone has left open."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from datetime import datetime, time, timedelta

import pytest

from abbe.drivers.api import Condition, ControllerStatus
from abbe.drivers.errors import LinkDown
from abbe.service.domain.schedule import Needs, Schedule, Window
from abbe.service.scheduler.loop import LoopTerms, Scheduler
from abbe.service.scheduler.ports import Readiness
from abbe.service.scheduler.ready import AlwaysReady, DeviceReadings, Ready
from abbe.service.scheduler.slots import covers, next_slot, previous_slot, rule_as_text, slots_between
from tests.pretended_status import READY, controller_status
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, settle, utc

HOURLY = Schedule("hourly", "0 * * * *", "UTC", "r")
ONCE = replace(HOURLY, catch_up="once")
HOUR_S = 3600.0


class Bench:
    def __init__(
        self, start: datetime, *schedules: Schedule, ledger: FakeLedger | None = None, maintenance: tuple[Window, ...] = ()
    ) -> None:
        self.clock, self.ledger, self.shelf = FakeClock(start), ledger or FakeLedger(), FakeShelf()
        self.lacks = ""
        self.ran: list[tuple[datetime, datetime]] = []
        self.scheduler = Scheduler(schedules, self.ledger, self.job, self.shelf, self.clock, LoopTerms(maintenance, self))

    async def lack(self, schedule: Schedule) -> str:
        return self.lacks

    async def watch(self) -> None:
        return

    def continue_from(self, earlier: Readiness) -> None:
        return

    async def job(self, schedule: Schedule, slot: datetime) -> str:
        self.ran.append((slot, self.clock.utc()))
        await self.clock.sleep(600.0)
        return "done: pass"

    @asynccontextmanager
    async def working(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self.scheduler.run())
        await settle()
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    def codes(self) -> list[str]:
        return [alarm["code"] for alarm in self.shelf.alarms]


async def test_after_three_days_off_one_run_stands_for_all() -> None:
    ledger = FakeLedger()
    ledger.of_earlier(ONCE, utc(2026, 6, 1, 6))
    bench = Bench(utc(2026, 6, 4, 6, 30), ONCE, ledger=ledger)
    async with bench.working():
        await bench.clock.pass_time(1200)
    assert bench.ran == [(utc(2026, 6, 4, 6), utc(2026, 6, 4, 6, 30))]
    assert len(ledger.of("missed: see 2026-06-04T06:00Z")) == 71
    assert len(ledger.of("done: pass")) == 2
    assert bench.codes() == ["SCH-005"]
    assert "71 slots from 2026-06-01 07:00 to 2026-06-04 05:00 UTC were missed" in bench.shelf.alarms[0]["what"]


@pytest.mark.parametrize("schedule", [HOURLY, ONCE])
async def test_nothing_starts_in_a_maintenance_window(schedule: Schedule) -> None:
    window = Window("cleaning", "UTC", "30 7 * * *", 2.0)
    bench = Bench(utc(2026, 6, 1, 6, 30), schedule, maintenance=(window,))
    async with bench.working():
        await bench.clock.pass_time(4 * HOUR_S)
    if schedule is HOURLY:
        assert [slot.hour for slot, _ in bench.ran] == [7, 10]
        assert bench.ledger.of("missed: maintenance") == [utc(2026, 6, 1, 8), utc(2026, 6, 1, 9)]
        assert "it lies in the maintenance window 'cleaning'" in bench.ledger.reasons["hourly", utc(2026, 6, 1, 8)]
    else:
        assert [slot.hour for slot, _ in bench.ran] == [7, 9, 10]
        assert bench.ran[1][1] == utc(2026, 6, 1, 9, 30), "caught up when the window ends"
        assert bench.ledger.of("missed: see 2026-06-01T09:00Z") == [utc(2026, 6, 1, 8)]


async def test_a_machine_that_gets_ready_within_the_grace_is_measured_then() -> None:
    bench = Bench(utc(2026, 6, 1, 6, 59), HOURLY)
    bench.lacks = "an NC program runs"
    async with bench.working():
        await bench.clock.pass_time(180)
        bench.lacks = ""
        await bench.clock.pass_time(60)
        assert len(bench.ran) == 1
        bench.lacks = "an NC program runs"
        await bench.clock.pass_time(HOUR_S + 400)
    assert bench.ledger.of("missed: not ready") == [utc(2026, 6, 1, 8)]
    assert bench.codes() == ["SCH-001"]
    assert "an NC program runs" in bench.shelf.alarms[0]["what"]


async def test_a_late_slot_that_cannot_be_caught_up_yet_says_so_once() -> None:
    bench = Bench(utc(2026, 6, 1, 6, 59), ONCE)
    bench.lacks = "an NC program runs"
    async with bench.working():
        await bench.clock.pass_time(0.9 * HOUR_S)
    assert bench.codes() == ["SCH-006"]
    assert bench.ledger.of("RELEASED") == [utc(2026, 6, 1, 7)]


async def test_what_a_lost_service_left_open_is_decided_by_the_next() -> None:
    bench = Bench(utc(2026, 6, 1, 7, 59), HOURLY, ONCE_TOO := replace(ONCE, name="once"))
    async with bench.working():
        await bench.clock.pass_time(120)  # the first runs, the second waits for it
        bench.ledger.lose_owner()
        bench.ledger.dead = True
    bench.ledger.dead = False
    later = Bench(utc(2026, 6, 1, 8, 20), HOURLY, ONCE_TOO, ledger=bench.ledger)
    async with later.working():
        await later.clock.pass_time(60)
        assert bench.ledger.of("interrupted") == [utc(2026, 6, 1, 8)]
        assert later.codes() == ["SCH-007"]
    assert later.ran == [(utc(2026, 6, 1, 8), utc(2026, 6, 1, 8, 20))]


def test_intervals_are_counted_from_a_fixed_instant() -> None:
    every = Schedule("e", "", "UTC", "r", every_h=36.0, first=utc(2026, 1, 2, 6))
    assert list(slots_between(every, utc(2026, 1, 1), utc(2026, 1, 6))) == [utc(2026, 1, 2, 6), utc(2026, 1, 3, 18), utc(2026, 1, 5, 6)]
    assert next_slot(every, utc(2026, 1, 2, 6)) == utc(2026, 1, 3, 18)
    assert previous_slot(every, utc(2026, 1, 2, 6)) == utc(2026, 1, 2, 6)
    assert previous_slot(every, utc(2026, 1, 2, 5)) == utc(2025, 12, 31, 18)
    assert rule_as_text(every) == "Every 36 hours, counted from 2026-01-02 06:00 UTC"


@pytest.mark.parametrize(
    ("at", "inside"),
    [
        (utc(2026, 3, 27, 20, 59), False),  # a Friday; Berlin is at UTC+1
        (utc(2026, 3, 27, 21), True),
        (utc(2026, 3, 28, 4, 59), True),
        (utc(2026, 3, 28, 5), False),
        (utc(2026, 3, 28, 22), False),  # Saturday is none of its days
        (utc(2026, 4, 3, 20), True),  # summer time: 22:00 is one hour earlier in UTC
        (utc(2026, 4, 3, 19, 59), False),
    ],
)
def test_a_weekly_window_over_midnight(at: datetime, inside: bool) -> None:
    window = Window("late shift", "Europe/Berlin", days=frozenset({"fri"}), start=time(22), end=time(6))
    assert covers(window, at) == inside


def status(conditions: Condition = READY, x: float = 0.0) -> ControllerStatus:
    return controller_status(conditions, position_mm=(x, 0.0, 0.0))


SHIFT = Window("shift", "UTC", days=frozenset({"mon"}), start=time(6), end=time(14))
MONDAY_8, MONDAY_20 = utc(2026, 6, 1, 8), utc(2026, 6, 1, 20)


@pytest.mark.parametrize(
    ("needs", "at", "seen", "lack"),
    [
        (Needs(), MONDAY_8, None, ""),
        (Needs(operator="present"), MONDAY_8, None, ""),
        (Needs(operator="present"), MONDAY_20, None, "no operator is there"),
        (Needs(operator="absent"), MONDAY_8, None, "an operator is there"),
        (Needs(operator="absent"), MONDAY_20, DeviceReadings(status()), ""),
        (Needs(operator="absent"), MONDAY_20, DeviceReadings(status(READY | Condition.DOOR_OPEN)), "a person is at the machine"),
        (Needs(idle=True), MONDAY_8, DeviceReadings(status()), ""),
        (Needs(idle=True), MONDAY_8, DeviceReadings(status(READY | Condition.NC_PROGRAM)), "not idle: an NC program runs"),
        (Needs(idle=True), MONDAY_8, DeviceReadings(status(READY | Condition.SPINDLE)), "not idle: the spindle turns"),
        (Needs(idle=True), MONDAY_8, DeviceReadings(status(READY | Condition.MOVING)), "not idle: an axis moves"),
        (Needs(idle=True), MONDAY_8, None, "the devices cannot be read"),
        (Needs(air=True), MONDAY_8, DeviceReadings(status(), 20.0), ""),
        (Needs(air=True), MONDAY_8, DeviceReadings(status(), 25.5), "the air is at 25.5 C, the limits are 18 to 24 C"),
        (Needs(air=True), MONDAY_8, DeviceReadings(status(), None), "the air temperature is not measured"),
    ],
)
async def test_preconditions(needs: Needs, at: datetime, seen: DeviceReadings | None, lack: str) -> None:
    async def look(with_air: bool) -> DeviceReadings:
        if seen is None:
            raise LinkDown("tcp://127.0.0.1:5021", "connect", "refused", "switch it on")
        return seen

    schedule = replace(HOURLY, needs=needs)
    found = await Ready(look, [schedule], (18.0, 24.0), (SHIFT,), FakeClock(at)).lack(schedule)
    assert lack in found
    assert bool(lack) == bool(found)


async def test_a_machine_is_warm_when_it_was_seen_at_work() -> None:
    """Thirty minutes of work, of which ten looks fail: twenty are known, and an hour later none of them counts."""
    clock = FakeClock(MONDAY_8)
    minute = 0

    async def look(with_air: bool) -> DeviceReadings:
        nonlocal minute
        minute += 1
        if 10 <= minute < 20:
            raise LinkDown("tcp://127.0.0.1:5021", "read", "gone", "")
        return DeviceReadings(
            status(READY | Condition.SPINDLE if minute % 2 else READY, x=float(minute % 4)) if minute <= 30 else status(x=30.0 % 4)
        )

    schedule = replace(HOURLY, needs=Needs(warm_min=15.0))
    ready = Ready(look, [schedule], (18.0, 24.0), (), clock)
    watching = asyncio.create_task(ready.watch())
    await clock.pass_time(10 * 60.0)
    assert "not warm: it was seen at work for" in await ready.lack(schedule)
    await clock.pass_time(25 * 60.0)
    assert 18.0 <= ready.active_min() <= 21.0
    assert await ready.lack(schedule) == ""
    await clock.pass_time(60 * 60.0)
    assert ready.active_min() == 0.0
    watching.cancel()
    with suppress(asyncio.CancelledError):
        await watching


async def test_nobody_is_looked_at_without_need() -> None:
    async def look(with_air: bool) -> DeviceReadings:
        raise AssertionError

    ready = Ready(look, [HOURLY], (18.0, 24.0), (), FakeClock(MONDAY_8))
    await ready.watch()
    assert await ready.lack(HOURLY) == ""


async def test_a_warm_machine_stays_warm_when_the_service_starts_anew() -> None:
    clock, warm = FakeClock(MONDAY_8), replace(HOURLY, needs=Needs(warm_min=3.0))

    async def look(with_air: bool) -> DeviceReadings:
        return DeviceReadings(status(READY | Condition.SPINDLE))

    ready = Ready(look, [warm], (18.0, 24.0), (), clock)
    watching = asyncio.create_task(ready.watch())
    await clock.pass_time(240)
    watching.cancel()
    following = Ready(look, [warm], (18.0, 24.0), (), clock)
    assert await following.lack(warm) != ""
    following.continue_from(AlwaysReady())
    assert await following.lack(warm) != ""
    following.continue_from(ready)
    assert await following.lack(warm) == ""


async def test_too_many_missed_slots_are_one_line_with_its_reason() -> None:
    ledger = FakeLedger()
    fast = Schedule("fast", "* * * * *", "UTC", "r")
    ledger.of_earlier(fast, utc(2026, 6, 1))
    bench = Bench(utc(2026, 6, 4), fast, ledger=ledger)
    async with bench.working():
        await settle()
    assert ledger.of("missed: whole span") == [utc(2026, 6, 1, 0, 1)]
    assert "every slot from 2026-06-01 00:01 to 2026-06-04 00:00 UTC" in ledger.reasons["fast", utc(2026, 6, 1, 0, 1)]
    assert timedelta(0) == bench.ran[0][1] - utc(2026, 6, 4)
