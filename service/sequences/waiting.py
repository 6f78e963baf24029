"""Waits for a person (pause) or for a condition to clear (suspension), and checks all preconditions again before resuming.

The preconditions: no restart of the controller, the same table, and no interlock.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable

from abbe.drivers.api import ControllerStatus, signal_is_there
from abbe.drivers.errors import DriverError
from abbe.service.devices.session import Session
from abbe.service.errors import BeamLost, DoorOpen, Interlock
from abbe.service.sequences.control import (
    CAN_CLEAR,
    Control,
    ExpectedTable,
    State,
    Suspending,
    Watching,
    air_trouble,
    beam_trouble,
    check_expected,
    check_interlocks,
    person_may_be_inside,
)
from abbe.service.sequences.journal import GOES_ON, WAITS, Journal


async def check_preconditions(session: Session, expected: ExpectedTable | None, watching: Watching, *, beam: bool) -> ControllerStatus:
    """Check all preconditions and return the controller's status. ``beam``: during a laser run, also check the beam.

    Raises
    ------
    PreconditionsChanged
        Another boot id or another table: the campaign cannot resume.
    Interlock
        A condition must clear first.
    """
    status = await session.controller.status()
    if expected is not None:
        comp = await session.controller.comp_status()
        check_expected(expected, comp.boot_id, comp.bank_crc[comp.active_bank])
    check_interlocks(status)
    if session.laser is not None and (beam or watching.air_c is not None):
        reading = await session.laser.peek()
        trouble = (beam_trouble(reading) if beam else None) or air_trouble(reading, watching.air_c)
        if trouble is not None:
            raise trouble
    return status


LOOK_S = 0.1
"""Polling interval of devices and requests during a pause, s."""


async def paused(
    session: Session, control: Control, watching: Watching, expected: ExpectedTable | None, journal: Journal, *, beam: bool = False
) -> bool:
    """Wait until the pause is withdrawn and all preconditions hold; an unmet precondition is reported, and the pause continues.

    Where no pause is allowed (`Control.no_pause_reason`) an unmet precondition ends the run: a closed door alone, without a person's
    confirmation, must not start motion.

    Returns
    -------
    bool
        Whether a person may have touched the set-up: the door was open, the mode was not remote, or the controller did not answer.

    Raises
    ------
    Stopped, Aborted
        A person requested it.
    PreconditionsChanged, BeamLost
        Waiting cannot clear it.
    Interlock
        A precondition is not met, and no pause is allowed.
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
            if isinstance(trouble, BeamLost) or control.no_pause_reason:
                raise
            why = f"cannot resume: {trouble.detail}"
            control.pause()
            continue
        break
    await journal.add(GOES_ON, touched=visits.touched)
    control.now(State.RUNNING)
    return visits.touched


class Visits:
    """Detects whether a person works in the machine while nothing moves."""

    def __init__(self, session: Session) -> None:
        self._controller = session.controller
        self.touched = False

    async def look(self) -> None:
        """Note if the door is open, the mode is not remote, or the controller does not answer."""
        try:
            self.touched = self.touched or person_may_be_inside(await self._controller.status())
        except DriverError:
            self.touched = True  # unknown counts as touched

    async def during(self, work: Awaitable[None]) -> None:
        """Wait for work, and check repeatedly until it is done."""
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
    """Return whether a condition only suspends: it can clear by itself, and the machine file allows it."""
    return trouble.condition in CAN_CLEAR & suspending.conditions


async def suspended(
    session: Session, control: Control, watching: Watching, expected: ExpectedTable | None, journal: Journal, trouble: Interlock
) -> bool:
    """Wait until all preconditions have held for the settle time; return whether a person may have touched the set-up.

    Raises
    ------
    Interlock
        The condition did not clear in time, or one came up that never clears by itself.
    Stopped, Aborted
        A person requested it.
    PreconditionsChanged
        The controller was restarted, or another table is active.
    """
    clock, how = asyncio.get_running_loop().time, watching.suspending
    until_s, well_s = clock() + how.longest_s, clock()
    control.now(State.SUSPENDED, trouble.detail)
    await journal.add(WAITS, why=trouble.detail, condition=trouble.condition)
    beam, visits = isinstance(trouble, BeamLost), Visits(session)
    visits.touched = isinstance(trouble, DoorOpen)
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
    await journal.add(GOES_ON, touched=visits.touched)
    control.now(State.RUNNING)
    return visits.touched


async def _signal(session: Session) -> None:
    reading = await session.need_laser().peek()
    if not signal_is_there(reading.status):
        raise BeamLost("the laser's beam is still interrupted", "free the beam")
