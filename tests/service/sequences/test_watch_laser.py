"""How long a laser may be silent: its beam for 2.5 s, while only the air is asked of it for as long as the set-up says."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest

from abbe.drivers.api import LaserReading
from abbe.drivers.errors import ReplyTimeout
from abbe.service.devices.session import Session
from abbe.service.errors import StatusUnknown
from abbe.service.sequences.control import Watching
from abbe.service.sequences.watch import Watch

STEP_S = 0.5
"""What one lost reply takes, by the loop's clock: it is made to jump, so that the tests wait for nothing."""


class Silent:
    """A laser that answers once, then loses ``most`` replies, then answers again."""

    name = "laser"

    def __init__(self, most: int = 1000) -> None:
        self.lost, self._most, self._skipped_s = 0, most, 0.0
        self.heard, self.heard_s, self.again, loop = 0, 0.0, asyncio.Event(), asyncio.get_running_loop()
        real = loop.time
        loop.time = lambda: real() + self._skipped_s  # type: ignore[method-assign]

    async def peek(self) -> LaserReading:
        if self.heard and self.lost < self._most:
            self.lost += 1
            assert self.lost < 500, "it is asked for ever"
            self._skipped_s += STEP_S
            raise ReplyTimeout("laser", "read", "no answer", "look at its cable")
        self.heard, self.heard_s = self.heard + 1, asyncio.get_running_loop().time()
        if self.lost:
            self.again.set()
        return LaserReading(0.0, self.heard, 0, 0, 1000, 1 << 2, 20.0, 101_325.0, 45.0, 2.7e-4)


@pytest.fixture(params=["beam", "air"])
def watch(request: pytest.FixtureRequest) -> Iterator[Watch]:
    nothing: Any = None
    made = Watch(Session(nothing, None, None, None), Watching((10.0, 30.0), period_s=0.001, air_unknown_s=30.0))
    made.beam = request.param == "beam"
    yield made
    made.end()


async def test_a_laser_that_is_silent_for_too_long_ends_the_test(watch: Watch) -> None:
    laser, longest_s = Silent(), 2.5 if watch.beam else 30.0
    with pytest.raises(StatusUnknown, match=f"the laser has not answered for {longest_s:g} s"):
        await watch.laser(laser)  # type: ignore[arg-type]
    assert longest_s < asyncio.get_running_loop().time() - laser.heard_s < longest_s + 5.0


async def test_a_laser_that_answers_again_in_time_does_not(watch: Watch) -> None:
    """One lost reply on a serial line is a second of silence."""
    laser = Silent(most=2)
    asking = asyncio.create_task(watch.laser(laser))  # type: ignore[arg-type]
    heard = asyncio.create_task(laser.again.wait())
    await asyncio.wait([asking, heard], return_when=asyncio.FIRST_COMPLETED)
    watch.end()
    await asking  # raises what it has against the laser
    assert heard.done()
    assert laser.lost == 2
