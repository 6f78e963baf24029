"""Wait at the console for a safe machine when a job ends with an unverified table still active."""

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
async def rollback_when_safe(session: Session, store: Store, site: Site, wait_s: float) -> AsyncIterator[None]:
    """If a job ends in `StillActive`, wait at the console and roll back as soon as that is safe (exit code 1).

    Without a console, or with ``wait_s`` 0, the error is raised: the next start of any command rolls back first. Ctrl-C ends the wait with
    the same consequence.
    """
    from abbe.service.clock import SystemClock
    from abbe.service.compensation.recover import finish_when_safe
    from abbe.service.errors import StillActive

    try:
        yield
    except StillActive as error:
        if wait_s <= 0.0 or not sys.stdin.isatty():
            raise
        notes = list(getattr(error, "__notes__", []))
        say("; ".join([str(error), *notes]) + "\a")
        say("make the machine ready: Abbe restores the old table as soon as that is safe; Ctrl-C ends the wait")
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
        for note in notes:  # cup and bar may still be mounted
            say(note)
        raise typer.Exit(1) from None


def say(text: str) -> None:
    """Print one line on stderr."""
    typer.echo(text, err=True)
