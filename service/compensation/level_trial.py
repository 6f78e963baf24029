"""One trial of `commission_levels`: attempt an operation on a controller and record whether it was refused.

`while_moving` checks that an activation is refused while an axis moves: one slow move of a few millimetres, up if there is room, and back.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from dataclasses import dataclass, field

from abbe.drivers.api import BankState, CompStatus, Controller, ControllerStatus, Point
from abbe.drivers.errors import DeviceFault, Refused
from abbe.drivers.links.shielded import run_to_end
from abbe.models.machine import AXES
from abbe.service.clock import Clock
from abbe.service.sequences.interlocks import tripped
from abbe.service.site import Site
from abbe.service.tables.base_table import Base

LEASE_MS = 60_000
ID_WORD = 4
MOVE_MM, FEED_MM_MIN = 3.0, 60.0
TRIES = 6
MOVE_LIMIT_S, MOVES_WITHIN_S, POLL_S = 60.0, 5.0, 0.01
FLAG = "interlocks"


@dataclass(frozen=True, slots=True)
class Observation:
    """One observation, for or against a flag of `Capabilities`."""

    flag: str
    ok: bool
    what: str


@dataclass
class Trial:
    """A controller under test.

    Parameters
    ----------
    controller : Controller
        Identified.
    base : Base
        The table in force when the test began; every copy is one of it.
    owner, stranger : int
        Owner ids of the lease: this test, and a second owner that must be shut out.
    """

    controller: Controller
    clock: Clock
    base: Base
    owner: int
    stranger: int
    shown: list[Observation] = field(default_factory=list)
    boots: set[int] = field(default_factory=set)

    def note(self, flag: str, what: str) -> None:
        """Record an observation for a flag."""
        self.shown.append(Observation(flag, True, what))

    def fail(self, flag: str, what: str) -> None:
        """Record an observation against a flag."""
        self.shown.append(Observation(flag, False, what))

    def judge(self, flag: str, ok: bool, good: str, bad: str) -> None:
        """Record an observation for (``ok``) or against a flag."""
        self.shown.append(Observation(flag, ok, good if ok else bad))

    def expect_refusal(self, flag: str, why: str, what: str) -> None:
        """Record whether a forbidden operation was refused; ``why``: the refusal, empty if it was accepted."""
        self.judge(flag, bool(why), f"refuses {what}", f"accepts {what}")

    def check_counted(self, before: int, after: int, what: str) -> None:
        """Record whether the generation counted exactly one change."""
        self.judge("generation", after == (before + 1) % 2**32, f"counts {what}", f"does not count {what} ({before} → {after})")

    def is_proved(self, flag: str) -> bool:
        """Whether there is an observation for a flag and none against it."""
        of_it = [s.ok for s in self.shown if s.flag == flag]
        return bool(of_it) and all(of_it)

    async def status(self) -> CompStatus:
        """The present state of the banks; also collects the boot id."""
        now = await self.controller.comp_status()
        self.boots.add(now.boot_id)
        return now

    async def refusal_of(self, call: Awaitable[None]) -> str:
        """Attempt an operation; return the refusal, empty if it was accepted."""
        try:
            await call
        except Refused as error:
            return error.detail
        except DeviceFault:
            return ""  # acknowledged, whatever followed
        return ""

    async def rewrite(self) -> None:
        """Write one register pair of the inactive bank again with its own content."""
        other = 1 - (await self.status()).active_bank
        await self.controller.write_bank(other, self.base.image[2 * ID_WORD : 2 * ID_WORD + 4], first=ID_WORD)

    async def take_lease(self) -> None:
        """Take the lease, also from a second owner that the controller wrongly accepted."""
        if await self.refusal_of(self.controller.lease(self.owner, LEASE_MS)):
            await self.refusal_of(self.controller.release(self.stranger))
            await self.controller.lease(self.owner, LEASE_MS)

    async def seal_copy(self) -> CompStatus:
        """Take the lease and seal the copy in the inactive bank; return the state of the banks."""
        await self.take_lease()
        now = await self.status()
        other = 1 - now.active_bank
        if now.bank_state[other] is not BankState.SEALED or now.bank_crc[other] != self.base.crc:
            if await self.controller.read_bank(other, len(self.base.image)) != self.base.image:
                await self.controller.write_bank(other, self.base.image)
            gen = (await self.status()).gen
            await self.controller.seal(other, self.owner)
            now = await self.status()
            self.check_counted(gen, now.gen, "a seal")
        return now

    async def activate(self, now: CompStatus, *, crc: int | None = None, gen: int | None = None, owner: int | None = None) -> str:
        """Attempt to activate the copy, with right or wrong arguments; return the refusal, empty if it was accepted."""
        call = self.controller.activate(
            1 - now.active_bank,
            expect_crc=self.base.crc if crc is None else crc,
            expect_gen=now.gen if gen is None else gen,
            owner=self.owner if owner is None else owner,
        )
        return await self.refusal_of(call)


async def while_moving(t: Trial, site: Site) -> None:
    """Attempt a correct activation while an axis moves; afterwards the axis is back where it was.

    An answer after the axis has arrived shows nothing: the attempt is repeated on the way back, at most `TRIES` times in all.
    """
    status = await t.controller.status()
    trouble = tripped(status)
    if trouble is not None:
        t.fail(FLAG, f"not tried, no axis may move: {trouble.detail}")
        return
    x, y, z = (round(v, 5) for v in status.position_mm)
    home, there, why_not = (x, y, z), away(site, (x, y, z)), ""
    try:
        for k in range(TRIES):
            why_not = await _on_the_way(t, home if k % 2 else there)
            if not why_not:
                break
        else:
            t.fail(FLAG, f"not tried: {why_not}")
        await t.controller.move(home, feed_mm_min=10.0 * FEED_MM_MIN, timeout_s=MOVE_LIMIT_S)
    except (Refused, DeviceFault) as error:
        t.fail(FLAG, f"the axis did not move as commanded: {error.detail}")


async def _on_the_way(t: Trial, target: Point) -> str:
    """Move slowly and attempt an activation meanwhile; return why this showed nothing, empty if it did."""
    now = await t.seal_copy()
    move = asyncio.ensure_future(t.controller.move(target, feed_mm_min=FEED_MM_MIN, timeout_s=MOVE_LIMIT_S))
    try:
        if not await _moves(t, move):
            await move
            return "the axis was not seen moving"
        why = await t.activate(now)
        still = (await t.controller.status()).moving
        await move
        if not still:  # accepted or refused: it is unknown whether the axis still moved then
            return "the axis had arrived before the answer"
        t.expect_refusal(FLAG, why, "an activation while an axis moves")
    finally:
        await run_to_end(_stop(t, move))
    return ""


def away(site: Site, home: Point) -> Point:
    """Target of the move: up along the vertical axis, away from the table; down if the axis is at its top."""
    axis = AXES.index(str(site.doc.get("vertical_axis", "Z")))
    target = list(home)
    room = float(site.machine.stroke_mm[axis, 1]) - home[axis]
    target[axis] = round(home[axis] + (MOVE_MM if room >= MOVE_MM else -MOVE_MM), 5)
    return target[0], target[1], target[2]


async def _moves(t: Trial, move: asyncio.Future[ControllerStatus]) -> bool:
    end_s = t.clock.monotonic_s() + MOVES_WITHIN_S
    while not move.done() and t.clock.monotonic_s() < end_s:
        if (await t.controller.status()).moving:
            return True
        await t.clock.sleep(POLL_S)
    return False


async def _stop(t: Trial, move: asyncio.Future[ControllerStatus]) -> None:
    """Abort an interrupted move: no axis moves on, and no feed hold stays on."""
    if move.done():
        if not move.cancelled():
            move.exception()  # the interrupting error is the one to raise
        return
    move.cancel()
    await asyncio.wait([move])
    await t.controller.abort()
