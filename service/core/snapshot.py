"""How things stand, as one message: what the board has heard, which job runs, what is due, what needs a person."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

from abbe.service.channel.messages import CheckNow, DeviceSeen, DueSlot, Moment
from abbe.service.clock import Clock
from abbe.service.core.jobs import JobRegistry
from abbe.service.scheduler.slots import Schedule
from abbe.service.web.core_link.board import Board

AGAIN = timedelta(minutes=1)
"""The timetable is looked at no more often than this, unless a slot has come: it changes only then."""
WORD, TEXT = 200, 4000


class SnapshotSource:
    """Makes messages of what is known.

    Parameters
    ----------
    board : Board
        Devices, broker, the running check.
    book : JobRegistry
        Which job that is.
    next_due : callable
        The timetable.
    clock : Clock
        Now.
    """

    def __init__(self, board: Board, book: JobRegistry, next_due: Callable[[], Sequence[tuple[Schedule, datetime]]], clock: Clock) -> None:
        self._board, self._book, self._next_due, self._clock = board, book, next_due, clock
        self._due: tuple[DueSlot, ...] = ()
        self._looked: datetime | None = None

    def now(self, web_restarts: int) -> Moment:
        """How things stand."""
        board = self._board
        devices = tuple(DeviceSeen(d.role[:WORD], d.url[:TEXT], d.state, d.at_utc, d.text[:TEXT]) for d in board.devices)
        attention = tuple(text[:TEXT] for text in board.attention)
        return Moment(
            "moment",
            board.changes,
            self._check(),
            devices,
            self._slots(),
            board.mqtt_connected,
            board.mqtt_dropped,
            attention,
            rss_bytes(),
            web_restarts,
        )

    def _check(self) -> CheckNow | None:
        job, running = self._board.job, self._book.running
        if job is None:
            return None
        number, state = (running.id, running.state) if running is not None else ("", "running")
        eta_s = job.eta_s if job.eta_s is not None and math.isfinite(job.eta_s) else None
        return CheckNow(
            number,
            job.schedule[:WORD],
            job.recipe[:WORD],
            job.since_utc,
            state,
            job.stage[:WORD],
            job.message[:TEXT],
            job.done if math.isfinite(job.done) else 0.0,
            job.total if math.isfinite(job.total) else 0.0,
            eta_s,
            job.step,
            job.steps,
            job.points,
            0 if running is None else running.prompt,
            "" if running is None else running.ask,
        )

    def _slots(self) -> tuple[DueSlot, ...]:
        now = self._clock.utc()
        come = any(due.slot_utc <= now for due in self._due)
        if self._looked is None or come or not self._looked <= now < self._looked + AGAIN:
            self._looked = now
            self._due = tuple(
                DueSlot(s.name[:WORD], s.cron[:WORD], s.timezone, s.recipe[:WORD], s.every_h, s.first_utc, slot)
                for s, slot in self._next_due()[:200]
            )
        return self._due


def rss_bytes() -> int:
    """Resident memory of this process; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return 0
