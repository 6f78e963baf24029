"""The bench of `commission_levels`: tries one thing on a controller and notes whether it was refused.

`while_moving` asks whether it refuses an activation while an axis moves: one slow move of a few millimetres, up if there is room, and back.
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
class Shown:
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
    clock : Clock
        For waiting.
    base : Base
        The table in force when the test began; all copies are of it.
    owner, stranger : int
        Two owners of the lease.
    """

    controller: Controller
    clock: Clock
    base: Base
    owner: int
    stranger: int
    shown: list[Shown] = field(default_factory=list)
    boots: set[int] = field(default_factory=set)

    def note(self, flag: str, what: str) -> None:
        """Something speaks for a flag."""
        self.shown.append(Shown(flag, True, what))

    def fail(self, flag: str, what: str) -> None:
        """Note a reason against a flag."""
        self.shown.append(Shown(flag, False, what))

    def judge(self, flag: str, ok: bool, good: str, bad: str) -> None:
        """Something speaks for or against a flag."""
        self.shown.append(Shown(flag, ok, good if ok else bad))

    def refused(self, flag: str, why: str, what: str) -> None:
        """Note whether what must not happen was refused (``why``, empty when it was accepted)."""
        self.judge(flag, bool(why), f"refuses {what}", f"accepts {what}")

    def counted(self, before: int, after: int, what: str) -> None:
        """Note whether the generation counted one change."""
        self.judge("generation", after == (before + 1) % 2**32, f"counts {what}", f"does not count {what} ({before} → {after})")

    def proved(self, flag: str) -> bool:
        """Whether something speaks for a flag and nothing against it."""
        of_it = [s.ok for s in self.shown if s.flag == flag]
        return bool(of_it) and all(of_it)

    async def status(self) -> CompStatus:
        """The banks now."""
        now = await self.controller.comp_status()
        self.boots.add(now.boot_id)
        return now

    async def accepts(self, call: Awaitable[None]) -> str:
        """Do something; why it was refused, empty when it was not."""
        try:
            await call
        except Refused as error:
            return error.detail
        except DeviceFault:
            return ""  # acknowledged, whatever became of it
        return ""

    async def write_again(self) -> None:
        """Write into the bank at rest, in one request, what it holds."""
        other = 1 - (await self.status()).active_bank
        await self.controller.write_bank(other, self.base.image[2 * ID_WORD : 2 * ID_WORD + 4], first=ID_WORD)

    async def hold(self) -> None:
        """Have the lease, also where a controller let a second owner take it."""
        if await self.accepts(self.controller.lease(self.owner, LEASE_MS)):
            await self.accepts(self.controller.release(self.stranger))
            await self.controller.lease(self.owner, LEASE_MS)

    async def sealed(self) -> CompStatus:
        """Have the lease, and the copy sealed in the bank at rest; the banks then."""
        await self.hold()
        now = await self.status()
        other = 1 - now.active_bank
        if now.bank_state[other] is not BankState.SEALED or now.bank_crc[other] != self.base.crc:
            if await self.controller.read_bank(other, len(self.base.image)) != self.base.image:
                await self.controller.write_bank(other, self.base.image)
            gen = (await self.status()).gen
            await self.controller.seal(other, self.owner)
            now = await self.status()
            self.counted(gen, now.gen, "a seal")
        return now

    async def activate(self, now: CompStatus, *, crc: int | None = None, gen: int | None = None, owner: int | None = None) -> str:
        """Try to bring the copy into force, right or wrong; why it was refused, empty when it was not."""
        call = self.controller.activate(
            1 - now.active_bank,
            expect_crc=self.base.crc if crc is None else crc,
            expect_gen=now.gen if gen is None else gen,
            owner=self.owner if owner is None else owner,
        )
        return await self.accepts(call)


async def while_moving(t: Trial, site: Site) -> None:
    """Try the right activation while an axis moves, there or back; in the end the axis stands where it was.

    An answer that comes when the axis has arrived shows nothing: then it is tried again on the way back, `TRIES` times in all.
    """
    status = await t.controller.status()
    trouble = tripped(status)
    if trouble is not None:
        t.fail(FLAG, f"it could not be tried, no axis may move: {trouble.detail}")
        return
    x, y, z = (round(v, 5) for v in status.position_mm)
    home, there, why_not = (x, y, z), away(site, (x, y, z)), ""
    try:
        for k in range(TRIES):
            why_not = await _on_the_way(t, home if k % 2 else there)
            if not why_not:
                break
        else:
            t.fail(FLAG, f"it could not be tried: {why_not}")
        await t.controller.move(home, feed_mm_min=10.0 * FEED_MM_MIN, timeout_s=MOVE_LIMIT_S)
    except (Refused, DeviceFault) as error:
        t.fail(FLAG, f"the axis did not move as it was told: {error.detail}")


async def _on_the_way(t: Trial, target: Point) -> str:
    """One slow move, and what happens to an activation meanwhile; why nothing was shown, empty when something was."""
    now = await t.sealed()
    move = asyncio.ensure_future(t.controller.move(target, feed_mm_min=FEED_MM_MIN, timeout_s=MOVE_LIMIT_S))
    try:
        if not await _moves(t, move):
            await move
            return "the axis was not seen moving"
        why = await t.activate(now)
        still = (await t.controller.status()).moving
        await move
        if not still:  # taken or refused: whether it still moved then is not known
            return "the axis had arrived before the answer"
        t.refused(FLAG, why, "an activation while an axis moves")
    finally:
        await run_to_end(_stop(t, move))
    return ""


def away(site: Site, home: Point) -> Point:
    """Where to move: along the upright axis in its positive sense, where the tool goes away from the table; down where it is at its top."""
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
    """Broken off in the middle: nothing moves on, and nothing waits for a release of the feed."""
    if move.done():
        if not move.cancelled():
            move.exception()  # the one who broke off says why
        return
    move.cancel()
    await asyncio.wait([move])
    await t.controller.abort()
