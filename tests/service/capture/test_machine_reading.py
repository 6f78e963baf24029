"""What is told of the machine comes from answers that were asked for anyway: position, feed along the chord, door, air, and the laser."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any, cast

import pytest

from abbe.drivers.api import Condition, Controller, ControllerStatus, DisplacementMeter, LaserFlag, LaserReading
from abbe.service.capture.machine_reading import LatestReading
from abbe.service.channel.messages import LiveMachine, encode, from_core
from abbe.service.clock import SystemClock
from abbe.service.devices.session import Session, noted, noted_meter

STATUS = ControllerStatus(100.0, 1_000_000, Condition.MOVING | Condition.REMOTE, (10.0, 20.0, -5.0), 0, 0, 0, 80, 0)
LASER = LaserReading(100.0, 1, 0, 123_456_789, 900, 0, 20.4, 101_300.0, 45.0, 2.7e-4)


class Device:
    """Answers what it is told to, and counts how often it was asked."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.asked = answer, 0

    async def status(self) -> Any:
        self.asked += 1
        return self.answer

    peek = status


def told(now_s: float = 100.0) -> tuple[Device, Device, Session, LatestReading]:
    cnc, laser = Device(STATUS), Device(LASER)
    session = Session(noted(cast(Controller, cnc)), None, noted_meter(cast(DisplacementMeter, laser)), None)
    return cnc, laser, session, LatestReading(session, SystemClock(), lambda: now_s)


def test_nothing_is_told_before_the_first_answer_and_nobody_is_asked() -> None:
    cnc, laser, _, reading = told()
    assert reading() is None
    assert (cnc.asked, laser.asked) == (0, 0)


def test_the_feed_is_the_way_between_two_positions_and_none_at_standstill() -> None:
    cnc, _, session, reading = told()
    asyncio.run(session.controller.status())
    first = reading()
    assert first is not None
    assert (first.position_mm, first.feed_mm_min, first.override_percent, first.door_open) == ((10.0, 20.0, -5.0), None, 80, False)
    cnc.answer = replace(STATUS, ctrl_us=1_500_000, position_mm=(13.0, 24.0, -5.0))  # 5 mm in half a second
    asyncio.run(session.controller.status())
    assert reading().feed_mm_min == pytest.approx(600.0)  # type: ignore[union-attr]
    cnc.answer = replace(STATUS, ctrl_us=2_500_000, conditions=Condition.DOOR_OPEN)
    asyncio.run(session.controller.status())
    last = reading()
    assert last is not None
    assert (last.feed_mm_min, last.door_open) == (0.0, True)


def test_the_laser_is_told_while_its_answer_is_new() -> None:
    cnc, laser, session, reading = told()
    asyncio.run(session.controller.status())
    asyncio.run(session.need_laser().peek())
    now = reading()
    assert now is not None
    assert (now.air_c, now.laser_mm, laser.asked) == (20.4, pytest.approx(12.3456789), 1)
    assert now.beam_good
    laser.answer = replace(LASER, status=int(LaserFlag.BEAM_LOST))
    asyncio.run(session.need_laser().peek())
    lost = reading()
    assert lost is not None
    assert not lost.beam_good
    cnc.answer = replace(STATUS, host_s=106.0)
    asyncio.run(session.controller.status())
    late = LatestReading(session, SystemClock(), lambda: 106.0)()
    assert late is not None
    assert (late.air_c, late.laser_at_ms, late.laser_mm, late.beam_good) == (None, None, None, False)


def test_an_answer_of_the_controller_that_is_old_is_not_told() -> None:
    _, _, session, _ = told()
    asyncio.run(session.controller.status())
    assert LatestReading(session, SystemClock(), lambda: 105.0)() is not None
    assert LatestReading(session, SystemClock(), lambda: 105.1)() is None
    assert LatestReading(session, SystemClock(), lambda: 3700.0)() is None


def test_every_answer_keeps_its_own_time() -> None:
    cnc, _, session, _ = told()
    now_s = [100.0]
    reading = LatestReading(session, SystemClock(), lambda: now_s[0])
    asyncio.run(session.controller.status())
    asyncio.run(session.need_laser().peek())
    first = reading()
    now_s[0] = 102.0
    cnc.answer = replace(STATUS, host_s=101.0)
    asyncio.run(session.controller.status())
    second = reading()
    assert first is not None
    assert second is not None
    assert second.laser_at_ms == first.laser_at_ms
    assert second.at_ms != first.at_ms


@pytest.mark.parametrize(
    ("told_percent", "known"),
    [
        (0, 0),
        (80, 80),
        (79.6, 80),
        (1000, 1000),
        (-1, None),
        (1001, None),
        (float("nan"), None),
        (float("inf"), None),
        (float("-inf"), None),
    ],
)
def test_an_override_that_cannot_be_is_not_known(told_percent: Any, known: int | None) -> None:
    """A driver of somebody else may tell anything; the channel to the page takes what comes out of here."""
    cnc, _, session, reading = told()
    cnc.answer = replace(STATUS, override_percent=told_percent)
    asyncio.run(session.controller.status())
    now = reading()
    assert now is not None
    assert now.override_percent == known
    assert from_core(encode(LiveMachine("machine", now))) == LiveMachine("machine", now)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_position_that_is_not_finite_is_not_told(bad: float) -> None:
    cnc, _, session, reading = told()
    cnc.answer = replace(STATUS, position_mm=(1.0, bad, 3.0))
    asyncio.run(session.controller.status())
    assert reading() is None


def test_positions_so_far_apart_that_the_feed_is_not_finite_have_none() -> None:
    cnc, _, session, reading = told()
    for ctrl_us, x_mm in ((1_000_000, -1.5e308), (1_500_000, 1.5e308)):
        cnc.answer = replace(STATUS, ctrl_us=ctrl_us, position_mm=(x_mm, 0.0, 0.0))
        asyncio.run(session.controller.status())
        last = reading()
    assert last is not None
    assert last.feed_mm_min is None
