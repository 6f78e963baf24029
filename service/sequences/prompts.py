"""What a measurement asks a person to do where nobody sits at its console, and the word that it is done: for the prompt that stands alone.

All calls belong into the event loop of the measurement.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Prompt:
    """Something to be done by hand. ``number`` counts from 1 within one measurement, and no number comes twice."""

    number: int
    text: str


class Prompts:
    """Asks for one thing at a time."""

    def __init__(self) -> None:
        self._count = 0
        self._now: Prompt | None = None
        self._done: asyncio.Future[None] | None = None

    @property
    def now(self) -> Prompt | None:
        """What is waited for; None: nothing."""
        return self._now

    async def ask(self, text: str) -> None:
        """Wait until somebody says that it is done. Where the wait is cancelled nothing is asked for any more."""
        assert self._now is None, "one thing at a time"
        self._count += 1
        self._now, self._done = Prompt(self._count, text), asyncio.get_running_loop().create_future()
        try:
            await self._done
        finally:
            self._now = self._done = None

    def answer(self, number: int) -> bool:
        """Take the word that a prompt is done; False: it is not the one that stands, and nothing happens."""
        if self._now is None or self._done is None or self._now.number != number:
            return False
        self._now = None  # at once: the same word a second time answers nothing
        if not self._done.done():
            self._done.set_result(None)
        return True
