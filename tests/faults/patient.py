"""An event loop whose clock does not count the time that other programs took: a busy computer must not look like a silent device.

Both ends of the lines that these tests disturb live in one process. When it is not scheduled for a second, nothing happens on the line, and
the deadline of the client must not pass either. So at most 5 ms count for the work between two looks at the sockets, and waiting counts
as long as it was asked for. That holds inside the work too: a deadline that is set at the end of a long piece of work is not set later.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

WORK_S = 0.005


class PatientSelector(selectors.DefaultSelector):
    """Measures what was stolen."""

    def __init__(self) -> None:
        super().__init__()
        self.stolen_s = 0.0
        self._last_s = time.monotonic()

    def select(self, timeout: float | None = None) -> list[Any]:
        """Look at once first: what is ready was made ready by this process, and is no waiting."""
        ready = super().select(0)
        self._count(WORK_S)
        if ready or timeout == 0:
            return ready
        ready = super().select(timeout)
        self._count(WORK_S + timeout if timeout is not None and timeout > 0 else float("inf"))
        return ready

    def now_s(self) -> float:
        """Monotonic seconds without what was stolen, up to this instant of the work."""
        now_s = time.monotonic()
        return min(now_s, self._last_s + WORK_S) - self.stolen_s

    def _count(self, most_s: float) -> None:
        now_s = time.monotonic()
        self.stolen_s += max(0.0, now_s - self._last_s - most_s)
        self._last_s = now_s


class PatientLoop(asyncio.SelectorEventLoop):
    """Its time runs no faster than it is used."""

    def __init__(self) -> None:
        self._patient = PatientSelector()
        super().__init__(self._patient)

    def time(self) -> float:
        """Monotonic seconds without what was stolen."""
        return self._patient.now_s()


@contextmanager
def patience() -> Iterator[None]:
    """New event loops are patient while this lasts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.DefaultEventLoopPolicy, "_loop_factory", PatientLoop)
        yield
