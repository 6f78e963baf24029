"""An unverified table is still active because the way back is not open: wait until it is, and go it at that edge."""

from __future__ import annotations

from collections.abc import Callable

from abbe.drivers.api import TableController
from abbe.service.clock import Clock
from abbe.service.compensation.recover import READY, finish_push
from abbe.service.errors import StillActive
from abbe.service.push.adapter import ControllerPort, no_actors
from abbe.service.push.book import StoreBook
from abbe.service.push.operations import Done, Doubt, Operation, OperationKind, Outcome, Truth
from abbe.service.push.states import TERMINAL, PushState
from abbe.service.site import Site
from abbe.service.storage.store import Store

LIMIT_S = 600.0
"""How long a command waits by default."""
POLL_S, REMIND_S, AGAIN_S = 0.1, 30.0, 2.0
"""How often the controller is asked; how often a person is reminded; pause after a try that the controller did not let through."""

Say = Callable[[str], None]


async def finish_when_safe(controller: TableController, store: Store, site: Site, *, limit_s: float, clock: Clock, say: Say) -> str | None:
    """Wait until the machine is safe and the controller answers, then take the old table back at once.

    Nothing is reset and nothing moves: a person makes the machine ready. May be cancelled at any time; the next start of any command
    tries again first, as always.

    Parameters
    ----------
    limit_s : float
        How long to wait, seconds of the clock.
    clock : Clock
        Monotonic time.
    say : callable
        Hears, whenever it changes and every `REMIND_S`, that an unverified table is active, and what is waited for.

    Returns
    -------
    str or None
        What was done; None if nothing was left to do.

    Raises
    ------
    StillActive
        The machine did not become safe within ``limit_s``.
    TableMismatch
        The controller holds a table that the journal does not know: a person must look.
    """
    book = await StoreBook.last(store, site.name, clock, site.control)
    if book is None or (await book.entries())[-1].state in TERMINAL - {PushState.OPERATOR}:
        return None
    port = ControllerPort(controller, no_actors(), clock)
    end_s = clock.monotonic_s() + limit_s
    said, remind_s = "", 0.0
    while True:
        why, pause_s = _closed(await port.execute(Operation(OperationKind.LOOK), ())), POLL_S
        if not why:
            try:
                return await finish_push(controller, store, site, clock)
            except StillActive as error:
                why, pause_s = str(error), AGAIN_S
        now_s = clock.monotonic_s()
        if why != said or now_s >= remind_s:
            say(f"AN UNVERIFIED TABLE IS ACTIVE. Waiting for the machine, {max(end_s - now_s, 0.0):.0f} s more: {why}")
            said, remind_s = why, now_s + REMIND_S
        if now_s >= end_s:
            raise StillActive(f"the unverified table is STILL ACTIVE after {limit_s:.0f} s of waiting: {why}", READY)
        await clock.sleep(min(pause_s, end_s - now_s))


def _closed(look: Outcome) -> str:
    """Why the way back is not open, by one look; empty if it is."""
    if isinstance(look, Done):
        return look.value.unsafe if isinstance(look.value, Truth) else "no answer"
    return "the controller does not answer" if isinstance(look, Doubt) else look.text  # the link's own words count down: one line a look
