"""Waiting for a person (pause) or for a condition to clear (suspension), and looking at everything again before it goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable

from abbe.drivers.errors import DriverError
from abbe.drivers.flags import signal_is_there
from abbe.service.devices.session import Session
from abbe.service.errors import BeamLost, DoorOpen, Interlock
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.interlocks import CAN_CLEAR, Suspending, Watching, somebody_at_work
from abbe.service.sequences.journal import GOES_ON, WAITS, Journal
from abbe.service.sequences.preconditions import ExpectedTable, check_preconditions

LOOK_S = 0.1
"""How often a pause looks at devices and at what was asked."""


async def paused(
    session: Session, control: Control, watching: Watching, expected: ExpectedTable | None, journal: Journal, *, beam: bool = False
) -> bool:
    """Wait until a pause is taken back and everything is as it has to be; what is not is said, and the pause goes on.

    Where no pause is allowed (`Control.hurry`) it does not go on: a closed door alone, without a person's word, moves nothing.

    Returns
    -------
    bool
        Whether a person may have touched what is mounted: the door was open, the mode another, or the controller did not say.

    Raises
    ------
    Stopped, Aborted
        That was asked for instead.
    WorldChanged, BeamLost
        Not to be cleared by waiting.
    Interlock
        In a hurry: something is not as it has to be.
    """
    why = "paused as asked"
    await journal.add(WAITS, why=why)
    visits = Visits(session)
    while True:
        control.now(State.PAUSED, why)
        await visits.during(control.resumed())
        try:
            await check_preconditions(session, expected, watching, beam=beam)
        except Interlock as trouble:
            if isinstance(trouble, BeamLost) or control.hurry:
                raise
            why = f"cannot go on: {trouble.detail}"
            control.pause()
            continue
        break
    await journal.add(GOES_ON, touched=visits.seen)
    control.now(State.RUNNING)
    return visits.seen


class Visits:
    """Looks whether a person works in the machine, while nothing moves."""

    def __init__(self, session: Session) -> None:
        self._controller = session.controller
        self.seen = False

    async def look(self) -> None:
        """Look once."""
        try:
            self.seen = self.seen or somebody_at_work(await self._controller.status())
        except DriverError:
            self.seen = True  # unknown counts as touched

    async def during(self, work: Awaitable[None]) -> None:
        """Wait for something, and look again and again meanwhile."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                await self.look()
                await asyncio.wait({task}, timeout=LOOK_S)
            task.result()
            await self.look()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.wait({task})


def may_suspend(trouble: Interlock, suspending: Suspending) -> bool:
    """Whether a condition only suspends: it can clear by itself, and the machine file permits it."""
    return trouble.condition in CAN_CLEAR & suspending.conditions


async def suspended(
    session: Session, control: Control, watching: Watching, expected: ExpectedTable | None, journal: Journal, trouble: Interlock
) -> bool:
    """Wait until a condition has cleared and all has been well for the settle time.

    Returns
    -------
    bool
        Whether a person may have touched what is mounted meanwhile.

    Raises
    ------
    Interlock
        It did not clear in time, or a condition came up that never goes on by itself.
    Stopped, Aborted
        A person asked for that.
    WorldChanged
        The controller or its table is not what it was.
    """
    clock, how = asyncio.get_running_loop().time, watching.suspending
    until_s, well_s = clock() + how.longest_s, clock()
    control.now(State.SUSPENDED, trouble.detail)
    await journal.add(WAITS, why=trouble.detail, condition=trouble.condition)
    beam, visits = isinstance(trouble, BeamLost), Visits(session)
    visits.seen = isinstance(trouble, DoorOpen)
    while True:
        control.check()
        await visits.look()
        try:
            await check_preconditions(session, expected, watching, beam=False)
            if beam:
                await _signal(session)
        except Interlock as now:
            if not may_suspend(now, how):
                raise
            well_s = clock()
            control.now(State.SUSPENDED, now.detail)
        if clock() - well_s >= how.settle_s:
            break
        if clock() > until_s:
            raise type(trouble)(f"{trouble.detail}, and it did not clear within {how.longest_s:g} s", trouble.remedy)
        try:
            async with asyncio.timeout(LOOK_S):
                await control.asked()
        except TimeoutError:
            continue
    await journal.add(GOES_ON, touched=visits.seen)
    control.now(State.RUNNING)
    return visits.seen


async def _signal(session: Session) -> None:
    reading = await session.need_laser().peek()
    if not signal_is_there(reading.status):
        raise BeamLost("the laser's beam is still interrupted", "free the beam")
