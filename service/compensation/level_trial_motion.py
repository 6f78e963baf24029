"""Whether a controller refuses an activation while an axis moves: one slow move of a few millimetres, up if there is room, and back."""

from __future__ import annotations

import asyncio

from abbe.drivers.api import ControllerStatus, Point
from abbe.drivers.errors import DeviceFault, Refused
from abbe.drivers.links.shielded import run_to_end
from abbe.models.machine import AXES
from abbe.service.compensation.level_trial import Trial
from abbe.service.sequences.interlocks import tripped
from abbe.service.site import Site

MOVE_MM, FEED_MM_MIN = 3.0, 60.0
TRIES = 6
MOVE_LIMIT_S, MOVES_WITHIN_S, POLL_S = 60.0, 5.0, 0.01
FLAG = "interlocks"


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
        if not still:  # taken or refused: nobody knows whether it still moved then
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
            move.exception()  # whoever broke off says why
        return
    move.cancel()
    await asyncio.wait([move])
    await t.controller.abort()
