"""Deferred rollback: an unverified table is still active because the machine is not safe. Wait until it is, then roll back at once."""

from __future__ import annotations

from collections.abc import Callable

from abbe.drivers.api import TableController
from abbe.service.clock import Clock
from abbe.service.compensation.recover import READY, finish_push
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.errors import StillActive
from abbe.service.push.execute import ControllerPort, no_actors
from abbe.service.push.journal import StoreBook
from abbe.service.push.operations import Done, Doubt, Operation, OperationKind, Outcome, Truth
from abbe.service.site import Site
from abbe.service.storage.store import Store

LIMIT_S = 600.0
"""How long a command waits by default."""
POLL_S, REMIND_S, RETRY_S = 0.1, 30.0, 2.0
"""Interval of looks at the controller; interval of reminders to a person; pause after the controller has refused a rollback."""

Notify = Callable[[str], None]


async def finish_when_safe(
    controller: TableController, store: Store, site: Site, *, limit_s: float, clock: Clock, notify: Notify
) -> str | None:
    """Wait until the machine is safe and the controller answers, then roll back to the old table at once.

    Nothing is reset and nothing moves: a person makes the machine ready. May be cancelled at any time; the next command tries again
    before anything else.

    Parameters
    ----------
    limit_s : float
        How long to wait, seconds of the clock.
    notify : callable
        Receives a message that an unverified table is active and what blocks the rollback: on every change and every `REMIND_S`.

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
    last_reason, remind_s = "", 0.0
    while True:
        why, pause_s = _blocked_by(await port.execute(Operation(OperationKind.LOOK), ())), POLL_S
        if not why:
            try:
                return await finish_push(controller, store, site, clock)
            except StillActive as error:
                why, pause_s = str(error), RETRY_S
        now_s = clock.monotonic_s()
        if why != last_reason or now_s >= remind_s:
            notify(f"AN UNVERIFIED TABLE IS ACTIVE. Waiting for the machine, {max(end_s - now_s, 0.0):.0f} s more: {why}")
            last_reason, remind_s = why, now_s + REMIND_S
        if now_s >= end_s:
            raise StillActive(f"the unverified table is STILL ACTIVE after {limit_s:.0f} s of waiting: {why}", READY)
        await clock.sleep(min(pause_s, end_s - now_s))


def _blocked_by(look: Outcome) -> str:
    """What blocks the rollback, by one look; empty if nothing does."""
    if isinstance(look, Done):
        return look.value.unsafe if isinstance(look.value, Truth) else "no answer"
    # The message of the link counts down: its text would differ, and notify, at every look.
    return "the controller does not answer" if isinstance(look, Doubt) else look.text
