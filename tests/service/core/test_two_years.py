"""Two years, twenty schedules, three zones: each slot that an independent oracle finds is in the ledger once, and none ends in silence.

All of them with ``ABBE_TEST_LONG=1``; every day two zones share the schedules.

In these years the clocks of the zones change eight times, somebody sets the computer's clock back by two hours, and the power is off for a
minute, for eight hours (the night of an autumn change) and for three days (over a spring change), each time in the middle of whatever runs.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, time, timedelta
from zlib import crc32

import pytest
import structlog

from abbe.service.domain.schedule import FIRST_UTC, Needs, Schedule, Window
from abbe.service.scheduler.loop import LoopTerms, Scheduler
from abbe.service.scheduler.ports import Readiness
from abbe.service.scheduler.slots import covering, slots_between
from tests.service.core.cron_oracle import Minutes
from tests.service.core.fakes import FakeClock, FakeLedger, FakeShelf, settle, utc

LONG = bool(os.environ.get("ABBE_TEST_LONG"))
ZONES = ["Europe/Berlin", "Australia/Lord_Howe"] + (["America/New_York"] if LONG else [])
START, END = utc(2026, 1, 1, 0, 7), utc(2028, 1, 1, 0, 7)
BACK = (utc(2026, 8, 12, 10, 17), timedelta(hours=2))
OFF = [
    (utc(2026, 5, 5, 6, 0, 30), timedelta(minutes=1)),
    (utc(2026, 10, 24, 20, 3), timedelta(hours=8)),
    (utc(2027, 3, 26, 11, 2), timedelta(days=3)),
]
CRONS = [
    ("0 6 * * 1", "skip", 300),
    ("30 2 * * *", "skip", 300),
    ("30 2 * * *", "once", 300),
    ("0,30 2 * * *", "skip", 3600),
    ("15 1-3 * * *", "once", 600),
    ("45 1 * * *", "skip", 60),
    ("0 0 1 * *", "once", 300),
    ("5 2 * * 7", "skip", 7200),
    ("0 2 1-7 * *", "skip", 300),
    ("10 14 * * 1-5", "skip", 300),
    ("10 14 * * 1-5", "once", 300),
    ("0 22 15 * 3", "skip", 900),
    ("40 23 * * *", "once", 60),
    ("20 */6 * * *", "skip", 300),
    ("50 */4 * * *", "once", 1800),
    ("*/20 2 * * *", "skip", 300),
    ("0 12 * 6-8 *", "skip", 300),
    ("55 5 * 1,3,10,11 *", "once", 300),
]
MAINTENANCE = (("0 14 * * 3", 3.0), ("0 2 1 * *", 1.5))


def timetable(zone: str) -> list[Schedule]:
    by_cron = [Schedule(f"s{k:02}", cron, zone, "r", grace, catch_up=how) for k, (cron, how, grace) in enumerate(CRONS)]  # type: ignore[arg-type]
    if not LONG:
        by_cron = by_cron[ZONES.index(zone) :: len(ZONES)]
    hourly = [Schedule("i12", "", zone, "r", 300, every_h=12.0), Schedule("i7", "", zone, "r", 900, every_h=7.5, catch_up="once")]
    if LONG:
        by_cron[13] = replace(by_cron[13], cron="*/15 * * * *")
        by_cron[14] = replace(by_cron[14], cron="7 * * * *")
    fussy = {"s09", "s10", "s13", "i7"}
    return [replace(one, needs=Needs(idle=True)) if one.name in fussy else one for one in by_cron + hourly]


def nominal(schedules: list[Schedule], zone: str, end: datetime) -> dict[str, list[datetime]]:
    minutes = Minutes(zone, START, end)
    found = {
        one.name: minutes.of_interval(round(one.every_h * 60), FIRST_UTC) if one.every_h else minutes.of_cron(one.cron) for one in schedules
    }
    return {name: [slot for slot in slots if START < slot <= end] for name, slots in found.items()}


def at_work(now: datetime) -> bool:
    """The machine's own work, which no check may disturb: Monday to Friday, 40 minutes of most hours, some afternoons without an end."""
    long = now.day % 5 == 0 and now.hour >= 9
    return now.weekday() < 5 and (long or (5 <= now.minute < 45 and now.day % 3 > 0))


class World:
    """A ledger that outlives the services, and a machine that says whether it is idle."""

    def __init__(self, zone: str) -> None:
        self.schedules = timetable(zone)
        self.maintenance = tuple(Window(f"m{k}", zone, cron, hours) for k, (cron, hours) in enumerate(MAINTENANCE))
        self.maintenance += (Window("night", zone, days=frozenset({"sat"}), start=time(23, 0), end=time(3, 0)),)
        self.clock = FakeClock(START)
        self.ledger, self.shelf = FakeLedger(), FakeShelf()
        self.started: list[tuple[str, datetime, datetime]] = []
        self.busy = 0

    async def lack(self, schedule: Schedule) -> str:
        return "the machine is not idle: an NC program runs" if schedule.needs.idle and at_work(self.clock.utc()) else ""

    async def watch(self) -> None:
        return

    def continue_from(self, earlier: Readiness) -> None:
        return

    async def job(self, schedule: Schedule, slot: datetime) -> str:
        now = self.clock.utc()
        assert self.busy == 0
        assert covering(self.maintenance, now) is None
        assert not await self.lack(schedule)
        self.started.append((schedule.name, slot, now))
        self.busy += 1
        try:
            await self.clock.sleep(60.0 + 1500.0 * (crc32(f"{schedule.name} {slot:%j}".encode()) % 7 == 0))
        finally:
            self.busy -= 1
        return "done: pass"

    async def live(self, until: datetime, *, killed: bool) -> None:
        """One service from its start to its end. ``killed``: by the power, so that it writes nothing any more."""
        terms = LoopTerms(self.maintenance, self, poll_s=4 * 3600.0, recheck_s=600.0)
        scheduler = Scheduler(self.schedules, self.ledger, self.job, self.shelf, self.clock, terms)
        task = asyncio.create_task(scheduler.run())
        await settle()
        await self.clock.pass_time((until - self.clock.utc()).total_seconds())
        if killed:
            self.ledger.lose_owner()
            self.ledger.dead = True
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        self.ledger.dead = False


@pytest.fixture
def quiet() -> Iterator[None]:
    """Tens of thousands of log lines cost more than the timetable."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    yield
    structlog.reset_defaults()


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("zone", ZONES)
async def test_two_years(zone: str) -> None:
    world = World(zone)
    snapshots = sorted([(at, "off", length) for at, length in OFF] + [(BACK[0], "back", BACK[1])])
    for at, what, length in snapshots:
        if what == "off":
            await world.live(at, killed=True)
            world.clock.utc_now += length
        else:
            # The service goes on while somebody sets the clock.
            terms_end = at + timedelta(hours=5)
            await _set_back(world, at, length, terms_end)
    await world.live(END, killed=False)
    judge(world, nominal(world.schedules, zone, END))


async def _set_back(world: World, at: datetime, length: timedelta, until: datetime) -> None:
    async def somebody() -> None:
        await world.clock.sleep((at - world.clock.utc()).total_seconds())
        world.clock.utc_now -= length

    setting = asyncio.create_task(somebody())
    await world.live(until + length, killed=False)
    await setting


def judge(world: World, expected: dict[str, list[datetime]]) -> None:
    slots = {(name, slot) for name, found in expected.items() for slot in found}
    states, reasons = world.ledger.states, world.ledger.reasons
    assert len(slots) > (12_000 if LONG else 6_000)
    assert set(states) == slots, "exactly the slots of the oracle, each once"
    runs = Counter((name, slot) for name, slot, _ in world.started)
    assert max(runs.values()) == 1, "nothing ran twice"
    done = {key for key, state in states.items() if state == "done: pass"}
    broken_off = {key for key, state in states.items() if state == "interrupted"}
    assert done | broken_off == set(runs)
    open_at_the_end = {key for key, state in states.items() if state == "RELEASED"}
    assert all(slot > END - timedelta(days=1) for _, slot in open_at_the_end)
    rest = set(states) - done - broken_off - open_at_the_end
    assert all(states[key].startswith(("missed: ", "skipped: ")) and reasons[key] for key in rest), "each of them with its reason"
    told = " ".join(alarm["what"] for alarm in world.shelf.alarms)
    for name, slot in rest | broken_off:
        one = f"{name}: slot {slot:%F %R} UTC"
        assert one in told or _in_a_span(world, name, slot), f"{one} ended in silence"
    for name, slot in rest:
        if (see := re.fullmatch(r"missed: see (\S+)", states[name, slot])) is not None:
            assert (name, datetime.fromisoformat(see[1])) in slots, "the slot whose run stands for it is one"
    as_configured(world, expected)


def _in_a_span(world: World, name: str, slot: datetime) -> bool:
    """Whether an alarm said it of several slots together."""
    for alarm in world.shelf.alarms:
        found = re.match(rf"{name}: \d+ slots from (\S+ \S+) to (\S+ \S+) UTC were missed", alarm["what"])
        if found and found[1] <= f"{slot:%F %R}" <= found[2]:
            return True
    return False


def as_configured(world: World, expected: dict[str, list[datetime]]) -> None:
    """After three days without power: nothing of a schedule that skips; of one that catches up one run, soon, for all that were missed."""
    off, length = OFF[-1]
    on = off + length
    for schedule in world.schedules:
        missed = [slot for slot in expected[schedule.name] if off < slot <= on - timedelta(seconds=schedule.grace_s)]
        made_up = [at for name, slot, at in world.started if name == schedule.name and slot in missed]
        late = max((at - slot for name, slot, at in world.started if name == schedule.name), default=timedelta(0))
        if schedule.catch_up == "skip":
            assert made_up == []
            assert late <= timedelta(seconds=schedule.grace_s)
        elif missed:
            assert len(made_up) <= 1
            soon = [at for name, slot, at in world.started if name == schedule.name and on <= at <= on + timedelta(days=1)]
            assert soon, f"{schedule.name}: {len(missed)} missed, and nothing made up for them"


@pytest.mark.skipif(not LONG, reason="the two years above hold the ledger against the oracle already")
@pytest.mark.parametrize("zone", ZONES)
def test_the_oracle_and_the_product_find_the_same_slots(zone: str) -> None:
    schedules = timetable(zone)
    for name, slots in nominal(schedules, zone, END).items():
        schedule = next(one for one in schedules if one.name == name)
        assert list(slots_between(schedule, START, END)) == slots, schedule
