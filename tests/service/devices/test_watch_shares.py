"""The watcher looks at what others were told of the controller, and asks only when that is old or was heard under other terms."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from typing import Any

import pytest

from abbe.drivers.api import Condition, ControllerStatus
from abbe.service.devices.session import Session, noted
from abbe.service.errors import DoorOpen
from abbe.service.sequences.control import AT_WORK, Watching
from abbe.service.sequences.watch import NOTHING, Watch
from tests.pretended_status import READY, controller_status

PERIOD_S = 60.0


class Asked:
    """A controller that counts who asks."""

    def __init__(self) -> None:
        self.times, self.conditions, self.age_s = 0, READY, 0.0

    async def status(self) -> ControllerStatus:
        self.times += 1
        now = controller_status(self.conditions, ctrl_us=self.times)
        return replace(now, host_s=time.monotonic() - self.age_s)


def place() -> tuple[Asked, Any, Watch]:
    asked = Asked()
    controller: Any = noted(asked)  # type: ignore[arg-type]
    return asked, controller, Watch(Session(controller, None, None, None), Watching(period_s=PERIOD_S))


async def one_look(watch: Watch) -> None:
    looking = asyncio.create_task(watch.controller())
    for _ in range(10):
        await asyncio.sleep(0)
    watch.end()
    await looking


async def test_what_somebody_was_just_told_is_not_asked_again() -> None:
    asked, controller, watch = place()
    await controller.status()
    await one_look(watch)
    assert asked.times == 1


async def test_what_somebody_was_just_told_ends_the_test_all_the_same() -> None:
    asked, controller, watch = place()
    asked.conditions |= Condition.DOOR_OPEN
    await controller.status()
    with pytest.raises(DoorOpen):
        await watch.controller()
    assert asked.times == 1


async def test_what_is_a_period_old_is_asked_again() -> None:
    asked, controller, watch = place()
    asked.age_s = PERIOD_S
    await controller.status()
    asked.age_s, asked.conditions = 0.0, READY | Condition.DOOR_OPEN
    with pytest.raises(DoorOpen):
        await watch.controller()
    assert asked.times == 2


async def test_a_door_that_was_open_while_it_might_be_is_asked_about_again() -> None:
    asked, controller, watch = place()
    watch.tolerated = AT_WORK
    asked.conditions |= Condition.DOOR_OPEN
    await controller.status()
    watch.tolerated, asked.conditions = NOTHING, READY
    await one_look(watch)
    assert asked.times == 2


async def test_nobody_else_asks_and_nothing_is_noted() -> None:
    asked = Asked()
    watch = Watch(Session(asked, None, None, None), Watching(period_s=PERIOD_S))  # type: ignore[arg-type]
    await one_look(watch)
    assert asked.times == 1
