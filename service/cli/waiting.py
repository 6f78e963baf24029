"""A job ends with an unverified table still active, and a person is at the console: wait with them until the machine is safe."""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from abbe.service.devices.session import Session
    from abbe.service.site import Site
    from abbe.service.storage.store import Store


@asynccontextmanager
async def taken_back_when_safe(session: Session, store: Store, site: Site, wait_s: float) -> AsyncIterator[None]:
    """Where a job ends in `StillActive`, wait at the console and take the old table back as soon as that is safe (exit code 1).

    Without a console, or with ``wait_s`` 0, the error goes on as it is: the next start of any command takes the table back first. Ctrl-C
    ends the waiting, with the same consequence.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.deferred_rollback import finish_when_safe
    from abbe.service.errors import StillActive

    try:
        yield
    except StillActive as error:
        if wait_s <= 0.0 or not sys.stdin.isatty():
            raise
        notes = list(getattr(error, "__notes__", []))
        say("; ".join([str(error), *notes]) + "\a")
        say(
            "make the machine ready: it is watched, and the old table comes back by itself as soon as that is safe; Ctrl-C ends the waiting"
        )
        try:
            done = await finish_when_safe(session.controller, store, site, limit_s=wait_s, clock=SystemClock(), notify=say)
        except asyncio.CancelledError as ended:
            ended.add_note("the unverified table is STILL ACTIVE; the next abbe command takes it back before anything else")
            raise
        except Exception as ended:
            for note in (*notes, "the unverified table may still be active; the next abbe command takes it back before anything else"):
                ended.add_note(note)
            raise
        say(f"rolled back: {done or 'nothing was left to take back'}")
        for note in notes:  # cup and bar may still hang in
            say(note)
        raise typer.Exit(1) from None


def say(text: str) -> None:
    """One line on standard error."""
    typer.echo(text, err=True)
